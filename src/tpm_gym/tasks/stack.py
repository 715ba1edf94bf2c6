"""Stack: put a block on the goal, and another one on top of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray
from tpm_gym.simulation.state import Block, Scene, State
from tpm_gym.tasks import sampling
from tpm_gym.tasks.motion import Motion, Move, hanging
from tpm_gym.tasks.task import Task, dense

CLEARANCE: Final = 0.045
"""Height over start and goal, m: the cup comes down from this height, and goes up to it again.

At this height, a carried block passes above a standing block.
"""
APART: Final = 0.045
"""Smallest distance between any two of lower block, upper block and goal (their centres), m."""
CLEAR: Final = 0.0005
"""Smallest gap between the two blocks at the start, m."""


class Stack(Task):
    """Put the red block on the goal, and the blue block on top of it.

    The goal has six numbers: the centre of the lower block, then that of the upper block. The
    block that is farther from its goal decides about success.
    """

    lower = Block("lower")
    upper = Block("upper", colour=(0.16, 0.36, 0.80, 1.0))
    scene = Scene(objects=(lower, upper), markers=2)
    vacuum = True
    goal_size = 6
    max_episode_steps = 100
    samplings = ("sampled", "tempting")
    tower = np.array([0.0, 0.0, (lower.height + upper.height) / 2])
    """Vector (3,) m from the centre of the lower block to the centre of the upper block."""

    def sample(
        self, rngs: Sequence[np.random.Generator], chosen: Mapping[str, FloatArray]
    ) -> dict[str, FloatArray]:
        """See the base class."""
        mount, offset = self.machine.mount, hanging(self.lower)
        known = {name: mount.to_paper(place[:, :3] + offset) for name, place in chosen.items()}
        table = self.on_table(self.lower)
        regions = {name: [table] for name in ("lower", "upper", "goal")}
        # Blocks that touch at their corners are a diagonal apart, or less on a shallow table.
        sides = np.minimum(self.lower.width, np.subtract(table.high, table.low)[:2])
        apart = max(APART, float(np.hypot(*sides)) + CLEAR)
        points = sampling.safe_points(
            rngs, self.machine, regions, known, apart, self.goals == "tempting"
        )
        places = {name: mount.to_world(point) - offset for name, point in points.items()}
        goal = np.concatenate([places["goal"], places["goal"] + self.tower], axis=1)
        return {**places, "goal": goal, **chosen}

    def gap(self, achieved: ArrayLike, desired: ArrayLike) -> FloatArray:
        """Return the larger distance of the two blocks to their goals, (...,) m."""
        ends = (np.reshape(goal, (*np.shape(goal)[:-1], 2, 3)) for goal in (achieved, desired))
        largest: FloatArray = super().gap(*ends).max(axis=-1)
        return largest

    def shaping(self, state: State) -> dict[str, FloatArray]:
        """Return minus half the distance from cup to upper block / 0.1 m, for a dense reward."""
        if self.reward == "sparse":
            return {}
        return {"approach": 0.5 * dense(super().gap(self.lip(state), self.top(state, 1)))}

    def plan(self, motion: Motion) -> Iterator[Move]:
        """Carry the lower block to its place, then the upper block on top of it."""
        up = np.array([0.0, 0.0, -CLEARANCE])  # paper z points down
        for block, goal in zip(self.scene.objects, motion.goal.reshape(2, 3), strict=True):
            while True:
                if not motion.holding(block.name):  # a restored episode may begin with it held
                    yield from motion.pick(block, CLEARANCE)
                place = motion.carried_to(goal, block.name)
                way = [motion.command + up, place + up, place]
                yield from motion.go(way, vacuum=True, while_holding=block.name)
                if motion.holding(block.name):
                    break
            yield Move(place, False)
            yield from motion.go([place + up], vacuum=False)
