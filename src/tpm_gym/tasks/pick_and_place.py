"""Pick and place: pick up a block with the vacuum cup and bring it to the goal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property

import numpy as np

from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics.workspace import Region
from tpm_gym.simulation.state import Block, Scene, State
from tpm_gym.tasks import sampling
from tpm_gym.tasks.motion import Motion, Move, hanging
from tpm_gym.tasks.task import Task, dense

CLEARANCE = 0.028
"""Height over start and goal, m: the cup comes down from this height, and goes up to it again.

The height is no multiple of the tolerance, so that rounding errors do not decide about success.
"""
RELEASE_HEIGHT = 0.0005
"""Commanded height of the block over a goal on the table, m, when the expert releases the block.

The weight stretches the cup by 0.4 to 0.5 mm, so that the block is let go just above the table.
A block that is pressed on the table has forces of friction that each engine computes differently
(docs/compare.md).
"""


class PickAndPlace(Task):
    """Pick up a block with the vacuum cup and bring the block's centre to the goal.

    Half of the goals lie on the table, half in the air, away from the start of the block. Goals and
    starts lie where the machine is safe.
    """

    block = Block()
    scene = Scene(objects=(block,))
    vacuum = True
    samplings = ("sampled", "tempting")

    def sample(
        self, rngs: Sequence[np.random.Generator], chosen: Mapping[str, FloatArray]
    ) -> dict[str, FloatArray]:
        """See the base class."""
        machine, offset, regions = self.machine, hanging(self.block), self._regions
        if self.goals == "tempting":
            ends = sampling.tempting(rngs, machine, regions["object"][0], regions["goal"])
            points = dict(zip(regions, ends, strict=True))
        else:
            known = {name: machine.mount.to_paper(place + offset) for name, place in chosen.items()}
            points = sampling.safe_points(rngs, machine, regions, known)
        places = {name: machine.mount.to_world(point) - offset for name, point in points.items()}
        return places | dict(chosen)

    @cached_property
    def _regions(self) -> dict[str, list[Region]]:
        """Regions of P with the block in the cup: key "object" for starts, key "goal" for goals."""
        table = self.on_table(self.block)
        x, y, level = table.high
        air = Region(self.machine.goal_region.low, (x, y, level - sampling.APART))
        return {"object": [table], "goal": [table, air]}

    def shaping(self, state: State) -> dict[str, FloatArray]:
        """Return minus half the distance from cup to block / 0.1 m, for a dense reward only."""
        if self.reward == "sparse":
            return {}
        return {"approach": 0.5 * dense(self.gap(self.lip(state), self.top(state)))}

    # -- the expert -------------------------------------------------------------------------------

    def plan(self, motion: Motion) -> Iterator[Move]:
        """Come down on the block, carry it, release it on the table or hold it in the air."""
        up = np.array([0.0, 0.0, -CLEARANCE])  # paper z points down
        while True:
            yield from motion.pick(self.block, CLEARANCE, gently=True)
            if not motion.holding():
                continue
            on_table = bool(motion.goal[2] < self.block.height / 2 + 0.005)
            height = RELEASE_HEIGHT if on_table else 0.0
            place = motion.carried_to(motion.goal + (0.0, 0.0, height))
            if on_table:
                stops = [motion.command + up, place + up, place]
            else:
                # Lift the block off the table first, then move in a straight line.
                stops = [motion.command + up / 2, place]
            yield from motion.go(stops, vacuum=True, while_holding=self.block.name)
            if motion.holding():
                break
        for _ in range(2):  # the platform lags its command
            yield Move(place, True)
        if on_table:
            yield Move(place, False)
            place = place + up
            yield from motion.go([place], vacuum=False)
        yield Move(place, not on_table)
