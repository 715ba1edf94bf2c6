"""The scripted controller of all tasks, on closed-form kinematics.

It sees the same observation as a policy does, follows the task's plan of commands for point P with
trapezoidal speed, and turns each of them into an action of the environment's control, through the
inverse kinematics where that is joints. Between two points of the safe region its plan stays in the
safe region: y, which the conditioning follows, is changed along with x and z, never beyond both.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from tpm_gym.errors import ConfigurationError, EpisodeError, InputError
from tpm_gym.tasks.motion import Motion, Move
from tpm_gym.tasks.task import Task

__all__ = ["Expert"]


class Expert(Motion):
    """Scripted policy for one environment.

    Use it as ``expert.reset(observation)`` at the start of an episode, then
    ``action = expert.act(observation)``.

    Args:
        env: An environment of tpm_gym, wrapped or not. Its task, control and latency are taken, and
            whether it has been reset; nothing else is used.

    Raises:
        InputError: If the environment is none of tpm_gym's.
        ConfigurationError: If its task has no plan, on :meth:`reset`.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        """Take what is needed from the environment."""
        inner: Any = getattr(env, "unwrapped", None)
        if not isinstance(getattr(inner, "task", None), Task):
            raise InputError("env", env, "an environment of tpm_gym")
        super().__init__(inner.machine, inner.control)
        self._env = inner
        self._task: Task = inner.task
        self._latency: int = inner.randomisation.latency
        self._plan: Iterator[Move] | None = None
        self._move: Move | None = None
        self._episode: int | None = None

    def reset(self, observation: dict[str, Any]) -> None:
        """Plan anew for the episode that starts with ``observation``."""
        self._episode = self._env.episode
        self._under_way = [np.zeros(3)] * self._latency
        self._look(observation)
        self._plan, self._move = self._task.plan(self), None

    def act(self, observation: dict[str, Any]) -> NDArray[np.float32]:
        """The next action, shape and range of the environment's action space.

        Raises:
            EpisodeError: If the expert was not reset for this episode of its environment, there is
                none, or its plan has no moves.
            ConfigurationError: If its plan needs a vacuum, or to see, what its task has not.
        """
        _ = self._env.state  # there has to be an episode
        if self._plan is None or self._episode != self._env.episode:
            raise EpisodeError("the expert has no plan for this episode; call its reset() first")
        self._look(observation)
        self._move = move = next(self._plan, self._move)
        if move is None:
            raise EpisodeError(f"the plan of {type(self._task).__name__} has no moves")
        action = np.zeros(self._task.action_size, dtype=np.float32)
        action[:3] = self._control.action(self.machine.region.project(move.point), self.command)
        if self._task.vacuum:
            action[3] = 1.0 if move.vacuum else -1.0
        elif move.vacuum:
            valid = f"True: the plan of {type(self._task).__name__} switches it on"
            raise ConfigurationError("vacuum", self._task.vacuum, valid)
        if self._latency:
            self._under_way = [*self._under_way[1:], action[:3]]
        return action

    def _look(self, observation: dict[str, Any]) -> None:
        self.seen = self._task.decode(observation["observation"])
        self.goal = np.asarray(observation["desired_goal"], dtype=np.float64)
