"""A scripted controller for all tasks, on analytic kinematics.

It sees the same observation as a policy does, plans straight paths for the command of point P with
trapezoidal speed, and turns each step of them into an action of the environment's control, through
the inverse kinematics where that is joints. Between two points of the safe region it stays in the
safe region: y, which the conditioning follows, is changed along with x and z, never beyond both.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from tpm_gym.kinematics.workspace import TASK_REGION
from tpm_gym.mechanism.tree import CUP_LENGTH, DEFAULT_MOUNT
from tpm_gym.simulation.state import Puck
from tpm_gym.tasks.control import STEP_LIMIT
from tpm_gym.tasks.task import PickAndPlace, Task

__all__ = ["Expert"]

FloatArray = NDArray[np.float64]

CLEARANCE = 0.030
"""Height over the puck, or over its place, at which the expert arrives and leaves, m."""
RAMP = 3
"""Control steps from rest to full speed."""
SEAL_STEPS = 4
"""Control steps to wait for the cup to seal before trying again."""


class Expert:
    """Scripted policy for one environment.

    Args:
        env: An environment of tpm_gym, wrapped or not.

    Use it as ``expert.reset(observation)`` at the start of an episode, then
    ``action = expert.act(observation)``.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        """Take the task, the control and the latency from the environment; nothing else is used."""
        unwrapped: Any = env.unwrapped
        self._task: Task = unwrapped.task
        self._control = unwrapped.control
        self._size = self._task.action_size
        self._plan: Iterator[tuple[FloatArray, bool]] = iter(())
        self._seen: dict[str, FloatArray] = {}
        self._latency: int = unwrapped.randomisation.latency
        self._under_way: list[FloatArray] = []

    def reset(self, observation: dict[str, Any]) -> None:
        """Plan anew for the episode that starts with ``observation``."""
        self._under_way = [np.zeros(3)] * self._latency
        self._look(observation)
        placing = isinstance(self._task, PickAndPlace)
        self._plan = self._pick_and_place(self._task.scene.puck) if placing else self._reach()

    def act(self, observation: dict[str, Any]) -> NDArray[np.float32]:
        """The next action, shape and range of the environment's action space."""
        self._look(observation)
        wanted, vacuum = next(self._plan)
        action = np.zeros(self._size, dtype=np.float32)
        action[:3] = self._control.action(TASK_REGION.project(wanted), self._command)
        if self._size > 3:
            action[3] = 1.0 if vacuum else -1.0
        if self._latency:
            self._under_way = [*self._under_way[1:], action[:3]]
        return action

    # -- what the expert knows ------------------------------------------------------------------

    def _look(self, observation: dict[str, Any]) -> None:
        """Read the observation; positions in the paper frame from here on."""
        self._seen = self._task.decode(observation["observation"])
        self._goal = np.asarray(observation["desired_goal"], dtype=np.float64)

    @property
    def _command(self) -> FloatArray:
        """Where point P is commanded to be once the actions under way have arrived, paper frame."""
        command = DEFAULT_MOUNT.to_paper(self._seen["position"] + self._seen["command"])
        for action in self._under_way:
            command = self._control.command(action, command)
        return command

    @property
    def _holding(self) -> bool:
        return bool(self._seen["holding"][0] > 0.5)

    # -- plans: streams of (command for P in the paper frame, vacuum) ------------------------------

    def _reach(self) -> Iterator[tuple[FloatArray, bool]]:
        goal = DEFAULT_MOUNT.to_paper(self._goal)
        yield from self._go([goal], vacuum=False)
        while True:
            yield goal, False

    def _pick_and_place(self, puck: Puck | None) -> Iterator[tuple[FloatArray, bool]]:
        if puck is None:
            raise TypeError("PickAndPlace without a puck")
        up = np.array([0.0, 0.0, -CLEARANCE])  # paper z points down
        while True:
            yield from self._pick(up)
            if not self._holding:
                continue
            # Where the cup sits on the puck is where it took it, not the puck's middle.
            grip = self._seen["position"] - self._seen["object_position"]
            place = DEFAULT_MOUNT.to_paper(self._goal + grip)
            on_table = self._goal[2] < puck.height / 2 + 0.005
            stops = [self._command + up, place + up, place] if on_table else [place]
            if not on_table:
                # Off the table first, then straight on.
                stops.insert(0, self._command + up / 2)
            yield from self._go(stops, vacuum=True, while_holding=True)
            if self._holding:
                break
        yield from self._finish(place, place + up, release=on_table)

    def _pick(self, up: FloatArray) -> Iterator[tuple[FloatArray, bool]]:
        """Come down on the puck and wait for the seal."""
        yield from self._go([self._above_puck() + up], vacuum=False)
        yield from self._go([self._above_puck()], vacuum=True)
        for _ in range(SEAL_STEPS):
            if self._holding:
                return
            yield self._above_puck(), True

    def _finish(
        self, place: FloatArray, above: FloatArray, release: bool
    ) -> Iterator[tuple[FloatArray, bool]]:
        """Let go and move away, or hold the puck in the air."""
        for _ in range(2):  # the platform lags its command
            yield place, True
        if release:
            yield place, False
            yield from self._go([above], vacuum=False)
            place = above
        while True:
            yield place, not release

    def _above_puck(self) -> FloatArray:
        """Point P when the cup touches the puck where it stands now."""
        half_height = PickAndPlace.puck.height / 2
        top = self._seen["object_position"] + (0.0, 0.0, half_height + CUP_LENGTH)
        return DEFAULT_MOUNT.to_paper(top)

    def _go(
        self, stops: list[FloatArray], vacuum: bool, while_holding: bool = False
    ) -> Iterator[tuple[FloatArray, bool]]:
        """Straight lines through ``stops``, from rest to rest; ends early if a puck is lost."""
        for stop in stops:
            start = self._command
            for fraction in _trapezoid(start, stop):
                if while_holding and not self._holding:
                    return
                yield start + fraction * (stop - start), vacuum


def _trapezoid(start: FloatArray, stop: FloatArray) -> FloatArray:
    """Fractions of the way at the control steps from ``start`` to ``stop``.

    Speed rises over RAMP steps, holds, and falls; no axis exceeds its STEP_LIMIT.
    """
    steps = float((np.abs(stop - start) / STEP_LIMIT).max())
    count = int(np.ceil(steps)) + RAMP - 1
    ramp = np.minimum(np.arange(1, count + 1), np.arange(count, 0, -1))
    speed = np.minimum(ramp, RAMP).astype(np.float64)
    result: FloatArray = np.cumsum(speed) / speed.sum()
    return result
