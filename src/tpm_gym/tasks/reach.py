"""Reach: bring the platform to a point."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from tpm_gym.arrays import FloatArray
from tpm_gym.tasks import sampling
from tpm_gym.tasks.motion import Motion, Move
from tpm_gym.tasks.task import Task


class Reach(Task):
    """Bring point P of the platform to a point in the workspace.

    Goals are uniform over the safe part of the machine's goal region, away from home.
    """

    samplings = ("sampled", "tempting")

    def sample(
        self, rngs: Sequence[np.random.Generator], chosen: Mapping[str, FloatArray]
    ) -> dict[str, FloatArray]:
        """See the base class."""
        machine, home, regions = self.machine, self.machine.home, [self.machine.goal_region]
        if "goal" in chosen:
            return dict(chosen)
        if self.goals == "tempting":
            _, goals = sampling.tempting(rngs, machine, home, regions)
        else:
            drawn = sampling.safe_points(rngs, machine, {"goal": regions}, {"home": home})
            goals = drawn["goal"]
        return {"goal": machine.mount.to_world(goals)}

    def plan(self, motion: Motion) -> Iterator[Move]:
        """Move straight to the goal."""
        goal = motion.machine.mount.to_paper(motion.goal)
        yield from motion.go([goal], vacuum=False)
        yield Move(goal, False)
