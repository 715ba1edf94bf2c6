"""The expert: the scripted controller of all tasks. It uses closed-form kinematics.

The expert gets the same observation as a policy. For each robot it follows the task's plan, which
moves point P with trapezoidal speed, and converts each command into an action of the environment's
control. A straight move of P between safe positions is safe (see :mod:`tpm_gym.tasks.sampling`).
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


class Expert:
    """Scripted policy for an environment, or for all environments of a vector.

    Call :meth:`act` with each observation. A new episode starts a new plan.

    Args:
        env: A :class:`~tpm_gym.TPMEnv`, wrapped or not, or a :class:`~tpm_gym.TPMVectorEnv`. The
            expert uses only the environment's task, control, latency and count of episodes so far.

    Raises:
        InputError: If ``env`` is no such environment.
        ConfigurationError: If the task has no plan; :meth:`reset` and :meth:`act` raise this.
    """

    def __init__(self, env: gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any]) -> None:
        """Store the parts of the environment that the expert uses."""
        inner: Any = getattr(env, "unwrapped", None)
        if not isinstance(getattr(inner, "task", None), Task):
            raise InputError("env", env, "an environment of tpm_gym")
        self._env, self._alone = inner, isinstance(inner, gym.Env)
        self._task: Task = inner.task
        self._control, self._latency = inner.control, inner.randomisation.latency
        self._motions: dict[int, Motion] = {}
        self._plans: dict[int, Iterator[Move]] = {}
        self._moves: dict[int, Move | None] = {}
        self._episodes = np.full(np.shape(np.atleast_1d(inner.episode)), -1)

    def reset(self, observation: dict[str, Any]) -> None:
        """Start new plans for the episodes of ``observation``."""
        self._episodes[:] = -1
        self._look(observation)

    def act(self, observation: dict[str, Any]) -> NDArray[np.float32]:
        """Return the next action, with shape and range of the environment's action space.

        Raises:
            EpisodeError: If no episode is running, or a plan has no moves.
            ConfigurationError: If a plan needs the vacuum or an entry of the observation, and the
                task does not have it.
        """
        _ = self._env.state  # raises without an episode
        self._look(observation)
        count = len(self._episodes)
        moves = [self._next(row) for row in range(count)]
        machine = self._task.machine
        wanted = machine.region.project(np.array([move.point for move in moves]))
        current = np.array([self._motions[row].command for row in range(count)])
        actions = np.zeros((count, self._task.action_size), dtype=np.float32)
        actions[:, :3] = self._control.action(wanted, current)
        on = np.array([move.vacuum for move in moves])
        if self._task.vacuum:
            actions[:, 3] = np.where(on, 1.0, -1.0)
        elif on.any():
            valid = f"True: the plan of {type(self._task).__name__} switches it on"
            raise ConfigurationError("vacuum", self._task.vacuum, valid)
        if self._latency:
            for row, motion in self._motions.items():
                motion.under_way = [*motion.under_way[1:], actions[row, :3].astype(np.float64)]
        return actions[0] if self._alone else actions

    def _look(self, observation: dict[str, Any]) -> None:
        """Give each plan the observation of its robot, and start the plans of new episodes."""
        seen = self._task.decode(np.atleast_2d(observation["observation"]))
        goals = np.atleast_2d(np.asarray(observation["desired_goal"], dtype=np.float64))
        episodes = np.atleast_1d(self._env.episode)
        for row in range(len(episodes)):
            new = episodes[row] != self._episodes[row]
            if new:
                self._motions[row] = Motion(
                    self._task.machine, self._control, self._task.control_period
                )
                self._motions[row].under_way = [np.zeros(3)] * self._latency
            motion = self._motions[row]
            motion.seen = {name: values[row] for name, values in seen.items()}
            motion.goal = goals[row]
            if new:
                self._plans[row], self._moves[row] = self._task.plan(motion), None
                self._episodes[row] = episodes[row]

    def _next(self, row: int) -> Move:
        move = self._moves[row] = next(self._plans[row], self._moves[row])
        if move is None:
            raise EpisodeError(f"the plan of {type(self._task).__name__} has no moves")
        if not isinstance(move, Move):
            raise ConfigurationError("plan()", move, "an iterator of tpm_gym.tasks.Move")
        return move
