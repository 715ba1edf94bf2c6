"""Push: shove a block over the table to the goal, without vacuum."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.errors import ConfigurationError, ResetOptionError
from tpm_gym.mechanism.cup import CUP
from tpm_gym.simulation.state import CONTROL_PERIOD, Block, Scene, State
from tpm_gym.tasks import sampling
from tpm_gym.tasks.motion import Motion, Move, hanging
from tpm_gym.tasks.task import Entry, Task, dense

CLEARANCE: Final = 0.008
"""Gap between lip and block, m: first above the block's top, then beside the pushed face."""
SHORTEST: Final = 0.060
LONGEST: Final = 0.240
"""Bounds (SHORTEST, LONGEST) of the block's displacement along the pushed face's normal, m."""
SLOPE: Final = 0.10
"""Largest tangent of the angle between the block's path and the normal of the pushed face."""
PACE: Final = 0.014
"""Distance that the expert moves the lip in 40 ms while it pushes, m."""
SIDEWAYS: Final = 0.15
"""Largest tangent of the angle between the expert's push and the line from start to goal."""
CLOSE: Final = 0.001
"""Remaining distance to the goal at which the expert stops, m."""
UPRIGHT: Final = math.cos(math.radians(45))
"""Smallest z of a standing block's axis, the unit vector from its centre to its top."""

_ATTEMPTS: Final = 1000
_DRAWS: Final = 8


class Push(Task):
    """Shove a block over the table with the lip of the cup to the goal; the vacuum stays off.

    The block has to move by 60 to 240 mm, nearly along the normal of the pushed face. The robot can
    reach the place behind the block. The workspace of the paper's machine is thin in y, so with
    this machine the block moves along x.
    """

    block = Block(height=0.040)
    scene = Scene(objects=(block,))
    samplings = ("sampled", "tempting")
    events = ("toppled",)

    def sample(
        self, rngs: Sequence[np.random.Generator], chosen: Mapping[str, FloatArray]
    ) -> dict[str, FloatArray]:
        """See the base class; a chosen start or goal must leave room for a push."""
        ways = np.empty((len(rngs), 2, 3))  # start and goal
        rows = np.arange(0 if len(chosen) == 2 else len(rngs))
        for _ in range(_ATTEMPTS):
            if not len(rows):
                return {"object": ways[:, 0], "goal": ways[:, 1]} | dict(chosen)
            drawn = np.array([self._draw(rngs[row]) for row in rows.tolist()])
            drawn = self.machine.mount.to_world(drawn) - hanging(self.block)
            for end, name in enumerate(("object", "goal")):
                if name in chosen:
                    drawn[:, :, end] = chosen[name][rows, None]
            fits = self._can_push(drawn)
            ways[rows] = drawn[np.arange(len(rows)), fits.argmax(axis=1)]
            rows = rows[~fits.any(axis=1)]
        if chosen:
            name, places = next(iter(chosen.items()))
            valid = f"a place with room for a way of {SHORTEST} m or more that the robot can push"
            raise ResetOptionError(name, places[rows[0]].tolist(), valid)
        valid = f"one in which a block can be pushed by {SHORTEST} m from its place to the goal"
        raise ConfigurationError("goal_region", self.machine.goal_region, valid)

    def _draw(self, rng: np.random.Generator) -> FloatArray:
        """Draw pairs of start and goal (k, 2, 3) m, as positions of P in the machine's frame."""
        table = self.on_table(self.block)
        if self.goals == "tempting":
            points = sampling.at_threshold(rng, self.machine, table, 2 * _DRAWS)
            return points.reshape(_DRAWS, 2, 3)
        return rng.uniform(table.low, table.high, (_DRAWS, 2, 3))

    def _can_push(self, ways: FloatArray) -> BoolArray:
        """Return an array (...,): whether pairs of start and goal (..., 2, 3) m allow a push."""
        machine, along = self.machine, np.diff(ways, axis=-2)
        across, distance = np.moveaxis(np.sort(np.abs(along[..., 0, :2])), -1, 0)
        square = (distance >= SHORTEST) & (distance <= LONGEST) & (across <= SLOPE * distance)
        places = machine.mount.to_paper(self.behind(ways, along, CLEARANCE))
        inside = (machine.region.project(places) == places).all(axis=-1)
        safe = machine.conditioning_at(places) >= machine.safe_conditioning
        fits: BoolArray = square & (inside & safe).all(axis=-1)
        return fits

    def behind(self, place: FloatArray, way: FloatArray, gap: float) -> FloatArray:
        """Return where P has to be, (..., 3) m, world, so that the lip can push along ``way``.

        The lip is then behind the block, and P is as low as the region allows.

        Args:
            place: Centres (..., 3) m of the blocks.
            way: Directions (..., 3).
            gap: Distance between lip and face, m.
        """
        ahead = way / np.linalg.norm(way, axis=-1, keepdims=True)
        point: FloatArray = place - (self.block.width / 2 + CUP.radius + gap) * ahead
        point[..., 2] = self.machine.mount.to_world(self.machine.region.high)[2]
        return point

    def observed(self) -> tuple[Entry, ...]:
        """Return the entries of the observation: the robot's, then the block's with rotation."""
        return (*self.robot_entries(), *self.object_entries(turn=True))

    def shaping(self, state: State) -> dict[str, FloatArray]:
        """Return minus half the distance from cup to block / 0.1 m, for a dense reward only."""
        if self.reward == "sparse":
            return {}
        return {"approach": 0.5 * dense(self.gap(self.lip(state), state.object_position[:, 0]))}

    def toppled(self, state: State) -> BoolArray:
        """Return whether the block lies on a side, (n,)."""
        fallen: BoolArray = state.object_axis[:, 0, 2] < UPRIGHT
        return fallen

    def plan(self, motion: Motion) -> Iterator[Move]:
        """Come down behind the block, push it to the goal, and stay."""
        to_paper = motion.machine.mount.to_paper
        start, pace = motion.seen["object_position"], PACE * motion.period / CONTROL_PERIOD
        way = (motion.goal - start) * (1.0, 1.0, 0.0)
        ahead = way / np.linalg.norm(way)
        low = to_paper(self.behind(start, way, CLEARANCE))
        over = to_paper(start + hanging(self.block) + (0.0, 0.0, CLEARANCE))
        yield from motion.go([np.array([*low[:2], over[2]]), low], vacuum=False)
        while True:
            place = motion.seen["object_position"]
            left = (motion.goal - place) * (1.0, 1.0, 0.0)
            remaining = float(left @ ahead)
            if remaining < CLOSE:
                break
            # The lip pushes at a small angle, which corrects the sideways error of the block.
            across = left - remaining * ahead
            tilt = SIDEWAYS / max(SIDEWAYS, float(np.linalg.norm(across)) / remaining)
            step = min(pace, remaining) * ahead
            aims = (remaining * ahead + tilt * across, way)
            points = [to_paper(self.behind(place, aim, 0.0) + step) for aim in aims]
            safe = self.machine.conditioning_at(points[0]) >= self.machine.safe_conditioning
            yield Move(points[0 if safe else 1], False)
        yield Move(motion.command, False)
