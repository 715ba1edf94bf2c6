"""Building blocks of plans: the observation of one robot, and moves of point P."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.state import CONTROL_PERIOD, Block
from tpm_gym.tasks.control import Control

RAMP = 0.120
"""Time from rest to full speed, s."""
ROUNDING = 1e-5
"""Tolerance for rounding errors, as a fraction of a control step.

It is larger than the error of single precision, 1e-6.
"""
SEALING = 0.160
"""Time to wait for the cup to seal before giving up, s."""
SLOW_ABOVE = CUP.seal_gap + 0.001
"""Height of the lip above a block, m; a gentle pick moves slowly below this height."""
SLOW_SPEED = 0.025
"""Speed of a gentle pick, m/s, while the lip is less than ``SLOW_ABOVE`` above the block."""


def hanging(block: Block) -> FloatArray:
    """Return the vector (3,) m from the centre of a block in the cup to point P.

    Raises:
        ConfigurationError: If ``block`` is no Block, such as a name.
    """
    if not isinstance(block, Block):
        raise ConfigurationError("block", block, "a tpm_gym.simulation.Block, not its name")
    return np.array([0.0, 0.0, block.height / 2 + CUP.length])


class Move(NamedTuple):
    """A command for point P (3,) m, in the machine's frame, and whether the vacuum is on."""

    point: FloatArray
    vacuum: bool


class Motion:
    """Observation of one robot for its plan, and methods that yield the commands of a motion of P.

    A :class:`Move` has the command of one control step. In a motion, the speed of P rises, holds
    and falls (see :meth:`trapezoid`).

    Attributes:
        machine: The machine that moves.
        period: Control period, s.
        seen: The observation in SI units, by entry, world frame.
        goal: The goal, m, world frame.
        under_way: Actions (3,) that the environment's latency holds back, oldest first.
    """

    def __init__(self, machine: Machine, control: Control, period: float = CONTROL_PERIOD) -> None:
        """Start without an observation."""
        self.machine, self._control, self.period = machine, control, period
        self._reach = np.array(machine.step_limit) * (period / CONTROL_PERIOD)
        self._ramp, self._sealing = (max(1, round(time / period)) for time in (RAMP, SEALING))
        self.seen: dict[str, FloatArray] = {}
        self.goal: FloatArray = np.empty(0)
        self.under_way: list[FloatArray] = []

    @property
    def command(self) -> FloatArray:
        """Command for P after all actions that latency holds back, machine's frame, m."""
        command = self.machine.mount.to_paper(self.seen["position"] + self.seen["command"])
        for action in self.under_way:
            command = self._control.command(action[None], command[None])[0]
        return command

    def holding(self, name: str | None = None) -> bool:
        """Return whether the cup holds the object ``name``; None for the only object.

        Raises:
            ConfigurationError: If the task does not observe the object, or has several and ``name``
                is None.
        """
        return bool(self._see(name, "held")[0] > 0.5)

    def carried_to(self, place: FloatArray, name: str | None = None) -> FloatArray:
        """Return the position (3,) m of P, machine's frame, that puts the held object at ``place``.

        ``place`` is the goal of the object's centre, (3,) m, world frame. The object's centre is
        not exactly below the cup's centre. Name and errors are as in :meth:`holding`.
        """
        grip = self.seen["position"] - self._see(name, "position")
        return self.machine.mount.to_paper(place + grip)

    def _see(self, name: str | None, what: str) -> FloatArray:
        if name is None:
            names = [entry[: -len("_held")] for entry in self.seen if entry.endswith("_held")]
            if len(names) > 1:
                raise ConfigurationError("name", name, f"one of {', '.join(names)}")
            name = names[0] if names else "object"
        if (entry := f"{name}_{what}") not in self.seen:
            valid = f"entries with {entry!r}; add object_entries(i) of that object"
            raise ConfigurationError("observed()", list(self.seen), valid)
        return self.seen[entry]

    def go(
        self,
        stops: list[FloatArray],
        vacuum: bool,
        while_holding: str | None = None,
        rounded: bool = False,
    ) -> Iterator[Move]:
        """Move in straight lines through ``stops`` (machine's frame), from rest to rest.

        Args:
            stops: Points (3,) m.
            vacuum: Whether the vacuum is on.
            while_holding: Name of an object; the motion ends early if the cup loses this object.
            rounded: Whether P cuts the corners at the stops instead of coming to rest there.
        """
        for part in [stops] if rounded else [[stop] for stop in stops]:
            points = np.array([self.command, *part])
            ways = [self.trapezoid(*ends) for ends in pairwise(points)]
            for fractions in self._overlapped(ways):
                if while_holding is not None and not self.holding(while_holding):
                    return
                yield Move(points[0] + fractions @ np.diff(points, axis=0), vacuum)

    def meet(
        self, target: Callable[[], FloatArray], step: FloatArray, above: FloatArray
    ) -> Iterator[Move]:
        """Approach a moving target, come down on it with vacuum, and end at rest relative to it.

        Args:
            target: Function that returns the command (3,) m that would meet the target at the end
                of this control step, machine's frame.
            step: Displacement (3,) m of the target in a control step.
            above: Vector (3,) m from the target to the place from which P comes down.
        """
        start, place = self.command, target()
        way = place + above - step - start
        # Following the target needs a part of P's speed, so that the relative way takes longer.
        spare = 1 - np.abs(step) / self._reach
        across = self.trapezoid(start, start + way / spare)
        for done, down in self._overlapped([across, self.trapezoid(place + above, place)]):
            yield Move(target() + (1 - down) * above - (1 - done) * way, bool(down > 0))

    def _overlapped(self, ways: list[FloatArray]) -> FloatArray:
        """Return (n, k): the fraction of each of k ways that P has covered after n control steps.

        P follows the ways one after the other. Each way begins while P slows down on the previous
        way. The sum of the speeds of these two ways does not exceed the largest speed of one way.

        Args:
            ways: For each way, the fractions that :meth:`trapezoid` returns.
        """
        lengths = np.array([len(way) for way in ways])
        begins = np.cumsum([0, *np.maximum(lengths[:-1] - self._ramp + 1, 0)])
        steps = np.arange((begins + lengths).max())
        columns = [
            np.r_[0.0, way][np.clip(steps - begin + 1, 0, len(way))]
            for begin, way in zip(begins, ways, strict=True)
        ]
        return np.stack(columns, axis=1)

    def pick(self, block: Block, clearance: float, gently: bool = False) -> Iterator[Move]:
        """Come down on a block from ``clearance`` (m) above it, and wait for the seal.

        Args:
            clearance: Height of the lip above the block when P begins to come down, m.
            gently: Whether P stops above the block, and then comes down slowly until the cup seals.
                Otherwise the cup presses the block against the table.

        Raises:
            ConfigurationError: If the task does not observe the block.
        """
        yield from self.go([self._above(block, clearance)], vacuum=False)
        height, step = SLOW_ABOVE if gently else 0.0, SLOW_SPEED * self.period
        yield from self.go([self._above(block, height)], vacuum=True)
        # The wait begins on the block, which P reaches after the actions that latency holds back.
        for _ in range(math.ceil(height / step) + self._sealing + len(self.under_way)):
            if self.holding(block.name):
                return
            height = max(height - step, 0.0)
            yield Move(self._above(block, height), True)

    def _above(self, block: Block, clearance: float) -> FloatArray:
        """Return P (3,) m, machine's frame, at which the lip is ``clearance`` m above a block."""
        place = hanging(block) + self._see(block.name, "position")
        return self.machine.mount.to_paper(place + (0.0, 0.0, clearance))

    def trapezoid(self, start: FloatArray, stop: FloatArray) -> FloatArray:
        """Return the fractions (n,) of the way from ``start`` to ``stop`` after each control step.

        Speed rises over RAMP, holds, and falls. Neither P nor a controlled joint exceeds its
        limit. Rounding of the observation (float32) does not add a step.
        """
        steps = self._control.steps(stop, start)
        count = int(np.ceil(steps - ROUNDING)) + self._ramp - 1
        ramp = np.minimum(np.arange(1, count + 1), np.arange(count, 0, -1))
        speed = np.minimum(ramp, self._ramp).astype(np.float64)
        result: FloatArray = np.cumsum(speed) / speed.sum()
        return result
