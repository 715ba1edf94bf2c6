"""Pick and place: pick up a puck with the vacuum cup and bring it to the goal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property

import numpy as np

from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics.workspace import Region
from tpm_gym.simulation.state import Block, Scene, State
from tpm_gym.tasks import rewards, sampling
from tpm_gym.tasks.motion import Motion, Move, hanging
from tpm_gym.tasks.task import Entry, Task

__all__ = ["PickAndPlace"]

CLEARANCE = 0.028
"""Height over the puck, or over its place, at which the expert arrives and leaves, m.

Not 0.030, of which a third is the tolerance: the last bit would tell whether a step is a success.
"""


class PickAndPlace(Task):
    """Pick up a puck with the vacuum cup and bring its centre to the goal.

    Half of the goals lie on the table, half in the air, away from where the puck starts; both where
    the machine is safe.
    """

    puck = Block()
    scene = Scene(objects=(puck,))
    vacuum = True
    samplings = ("sampled", "tempting")

    def sample(
        self, rng: np.random.Generator, chosen: Mapping[str, FloatArray]
    ) -> dict[str, FloatArray]:
        """See the base class."""
        # Not self's: that of a subclass may ask this.
        return sampling.first_of(PickAndPlace.sample_each(self, [rng], chosen))

    def sample_each(
        self, rngs: Sequence[np.random.Generator], chosen: Mapping[str, FloatArray]
    ) -> dict[str, FloatArray]:
        """See the base class."""
        machine, offset, count = self.machine, hanging(self.puck), len(rngs)
        to_p, from_p = machine.mount.to_paper, machine.mount.to_world
        (table, _), given = self._regions, sampling.repeated(chosen, count)
        if self.goals == "tempting":
            pairs = [sampling.tempting(rng, machine, table, self._draw_region) for rng in rngs]
            first, last = (from_p(points) - offset for points in zip(*pairs, strict=True))
            return {"object": first, "goal": last, **given}
        if "object" not in given:
            given["object"] = from_p(machine.sample(rngs, [table] * count)) - offset
        if "goal" not in given:
            start = to_p(given["object"] + offset)[:, None]
            regions = [self._draw_region(rng) for rng in rngs]
            given["goal"] = from_p(sampling.apart_from_each(start, rngs, machine, regions)) - offset
        return given

    def _draw_region(self, rng: np.random.Generator) -> Region:
        """Where P goes with the puck: half on the table, half in the air."""
        table, air = self._regions
        return table if rng.random() < 0.5 else air

    @cached_property
    def _regions(self) -> tuple[Region, Region]:
        """Of P with the puck in the cup: on the table, in the air."""
        table = self.on_table(self.puck)
        x, y, level = table.high
        return table, Region(self.machine.goal_region.low, (x, y, level - sampling.APART))

    def observed(self) -> tuple[Entry, ...]:
        """The robot, then the puck."""
        return (*self.robot_entries(), *self.object_entries())

    def achieved(self, state: State) -> FloatArray:
        """Centre of the puck."""
        return state.object_position[..., 0, :]

    def shaping(self, state: State) -> dict[str, FloatArray]:
        """Dense only: minus the distance from the cup to the puck, half as dear as the goal."""
        if self.reward == "sparse":
            return {}
        return {"approach": 0.5 * rewards.dense(rewards.distance(self.lip(state), self.top(state)))}

    # -- the expert -------------------------------------------------------------------------------

    def plan(self, motion: Motion) -> Iterator[Move]:
        """Come down on the puck, carry it, let go on the table or hold it in the air."""
        to_paper = motion.machine.mount.to_paper
        up = np.array([0.0, 0.0, -CLEARANCE])  # paper z points down
        while True:
            yield from motion.pick(self.puck, CLEARANCE)
            if not motion.holding():
                continue
            # Where the cup sits on the puck is where it took it, not the puck's middle.
            grip = motion.seen["position"] - motion.seen["object_position"]
            place = to_paper(motion.goal + grip)
            on_table = bool(motion.goal[2] < self.puck.height / 2 + 0.005)
            stops = [motion.command + up, place + up, place] if on_table else [place]
            if not on_table:
                # Off the table first, then straight on.
                stops.insert(0, motion.command + up / 2)
            yield from motion.go(stops, vacuum=True, while_holding=self.puck.name)
            if motion.holding():
                break
        yield from self._finish(motion, place, place + up, release=on_table)

    def _finish(
        self, motion: Motion, place: FloatArray, above: FloatArray, release: bool
    ) -> Iterator[Move]:
        """Let go and move away, or hold the puck in the air."""
        for _ in range(2):  # the platform lags its command
            yield Move(place, True)
        if release:
            yield Move(place, False)
            yield from motion.go([above], vacuum=False)
            place = above
        yield Move(place, not release)
