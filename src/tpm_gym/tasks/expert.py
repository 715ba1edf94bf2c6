"""The scripted controller of all tasks, on closed-form kinematics.

It sees the same observation as a policy does, follows the task's plan of commands for point P with
trapezoidal speed, and turns each of them into an action of the environment's control, through the
inverse kinematics where that is joints. Between two points of the safe region its plan stays in the
safe region: y, which the conditioning follows, is changed along with x and z, never beyond both.
Where the plan asks more of the joints than their limit, the way cuts the corner: 6 of 1000 episodes
of TPMPickAndPlaceJoints-v0 get to conditionings of 0.055 to 0.076.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import EpisodeError, InputError
from tpm_gym.mechanism.machine import Machine
from tpm_gym.tasks.control import Control
from tpm_gym.tasks.task import Task

__all__ = ["Expert", "Move"]

RAMP = 3
"""Control steps from rest to full speed."""


class Move(NamedTuple):
    """A command for point P (3,) m, in the machine's frame, and whether the vacuum is on."""

    point: FloatArray
    vacuum: bool


class Expert:
    """Scripted policy for one environment.

    Use it as ``expert.reset(observation)`` at the start of an episode, then
    ``action = expert.act(observation)``.

    Args:
        env: An environment of tpm_gym, wrapped or not. Its task, control and latency are taken, and
            whether it has been reset; nothing else is used.

    Attributes:
        machine: The machine of the environment.
        seen: The observation in SI units, by entry, world frame.
        goal: The goal, m, world frame.

    Raises:
        InputError: If the environment is none of tpm_gym's.
        ConfigurationError: If its task has no plan, on :meth:`reset`.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        """Take what is needed from the environment."""
        inner: Any = getattr(env, "unwrapped", None)
        if not isinstance(getattr(inner, "task", None), Task):
            raise InputError("env", env, "an environment of tpm_gym")
        self._env = inner
        self._task: Task = inner.task
        self._control: Control = inner.control
        self._latency: int = inner.randomisation.latency
        self.machine: Machine = inner.machine
        self.seen: dict[str, FloatArray] = {}
        self.goal: FloatArray = np.full(self._task.goal_size, np.nan)
        self._plan: Iterator[Move] | None = None
        self._move: Move | None = None
        self._episode: int | None = None
        self._under_way: list[NDArray[Any]] = []  # actions that come late

    def reset(self, observation: dict[str, Any]) -> None:
        """Plan anew for the episode that starts with ``observation``."""
        self._episode = self._env.episode
        self._under_way = [np.zeros(3)] * self._latency
        self._look(observation)
        self._plan, self._move = self._task.plan(self), None

    def act(self, observation: dict[str, Any]) -> NDArray[np.float32]:
        """The next action, shape and range of the environment's action space.

        Raises:
            EpisodeError: If the expert was not reset for this episode of its environment, or its
                plan has no moves.
        """
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
        if self._latency:
            self._under_way = [*self._under_way[1:], action[:3]]
        return action

    # -- for plans --------------------------------------------------------------------------------

    @property
    def command(self) -> FloatArray:
        """Where P is commanded to be once the actions under way have arrived, machine's frame."""
        command = self.machine.mount.to_paper(self.seen["position"] + self.seen["command"])
        for action in self._under_way:
            command = self._control.command(action, command)
        return command

    def holding(self, name: str = "object") -> bool:
        """Whether the cup holds the object of that name."""
        return bool(self.seen[f"{name}_held"][0] > 0.5)

    def go(
        self, stops: list[FloatArray], vacuum: bool, while_holding: str | None = None
    ) -> Iterator[Move]:
        """Straight lines through ``stops`` (machine's frame), from rest to rest.

        Args:
            stops: Points (3,) m.
            vacuum: Whether the vacuum is on.
            while_holding: Name of an object; where the cup loses it the way ends early.
        """
        for stop in stops:
            start = self.command
            for fraction in self._trapezoid(start, stop):
                if while_holding is not None and not self.holding(while_holding):
                    return
                yield Move(start + fraction * (stop - start), vacuum)

    def _look(self, observation: dict[str, Any]) -> None:
        self.seen = self._task.decode(observation["observation"])
        self.goal = np.asarray(observation["desired_goal"], dtype=np.float64)

    def _trapezoid(self, start: FloatArray, stop: FloatArray) -> FloatArray:
        """Fractions of the way at the control steps from ``start`` to ``stop``.

        Speed rises over RAMP steps, holds, and falls; no axis exceeds the machine's step limit.
        """
        steps = float((np.abs(stop - start) / self.machine.step_limit).max())
        count = int(np.ceil(steps)) + RAMP - 1
        ramp = np.minimum(np.arange(1, count + 1), np.arange(count, 0, -1))
        speed = np.minimum(ramp, RAMP).astype(np.float64)
        result: FloatArray = np.cumsum(speed) / speed.sum()
        return result
