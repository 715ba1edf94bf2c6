"""Crossing: pass a parallel singularity by inertia, to a goal on its other side."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.mechanism.machine import Machine
from tpm_gym.mechanism.tpm.both_sides import both_sides
from tpm_gym.simulation.state import Block, Patch, State
from tpm_gym.tasks import sampling
from tpm_gym.tasks.motion import Motion, Move
from tpm_gym.tasks.task import Task

STRIPE: Final = 0.003
"""Half width of the stripe on the table that shows the plane y = 0, m."""


class Crossing(Task):
    """Bring point P to a goal on the other side of y = 0, and stop there.

    The plane y = 0 is a parallel singularity: there, no torque of the motors acts along y. P cannot
    go around the plane, so P has to pass it by inertia. The torques stay finite only if the
    velocity along y is constant there. The mechanism changes its assembly mode, which does not end
    the episode. If P is too slow, or if commands accelerate it along y in the plane, P turns back;
    the command is then mirrored to the side of P.

    P starts at home. Goals are the mirror images of those of Reach. Only Cartesian control can name
    a side: joint positions are equal on both sides.
    """

    samplings = ("sampled", "tempting")
    controls = ("cartesian",)
    events = ("crossed",)

    def __init__(self, machine: Machine, *args: Any, **options: Any) -> None:
        """Check that the machine can pass the plane; see the base class."""
        both = both_sides(machine)
        self._axis = both.mirror_axis
        self.scene = replace(type(self).scene, patches=(_stripe(both),))
        super().__init__(both, *args, **options)

    def sample(
        self, rngs: Sequence[np.random.Generator], chosen: Mapping[str, FloatArray]
    ) -> dict[str, FloatArray]:
        """See the base class."""
        if "goal" in chosen:
            return dict(chosen)
        machine, near = self.machine, self.goals == "tempting"
        regions = {"goal": [machine.goal_region]}
        points = sampling.safe_points(rngs, machine, regions, {}, near_singularity=near)["goal"]
        points[:, self._axis] *= -1.0
        return {"goal": machine.mount.to_world(points)}

    def crossed(self, state: State) -> BoolArray:
        """Return whether P and home are on different sides of the plane, (n,)."""
        there = self.machine.mount.to_paper(state.fk_position)[:, self._axis]
        beyond: BoolArray = there * self.machine.home[self._axis] < 0
        return beyond

    def plan(self, motion: Motion) -> Iterator[Move]:
        """Move straight to the goal; the velocity is constant except near the two ends."""
        goal = motion.machine.mount.to_paper(motion.goal)
        yield from motion.go([goal], vacuum=False)
        yield Move(goal, False)


def _stripe(machine: Machine) -> Patch:
    """Return a stripe on the table where the plane y = 0 meets it."""
    ends = np.array([machine.region.low, machine.region.high])
    ends[:, machine.mirror_axis] = -STRIPE, STRIPE
    low, high = np.sort(machine.mount.to_world(ends)[:, :2], axis=0).tolist()
    return Patch(tuple(low), tuple(high), Block.colour)
