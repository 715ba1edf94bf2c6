"""Sort: a task with two objects, in one file outside the package."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

import tpm_gym
from tpm_gym.arrays import FloatArray
from tpm_gym.simulation import Block, Scene, State
from tpm_gym.tasks import Motion, Move, Task, hanging, sampling

CLEARANCE = 0.045  # m; a block that is carried passes over one that stands
APART = 0.045  # m between the middles of what stands on the table


class Sort(Task):
    """Put the red block and the blue block on their places."""

    red = Block("red", colour=(0.8, 0.1, 0.1, 1.0))
    blue = Block("blue", height=0.036, mass=0.060, colour=(0.1, 0.2, 0.8, 1.0))
    scene = Scene(objects=(red, blue), markers=2)
    vacuum = True
    goal_size = 6
    max_episode_steps = 100

    def sample(
        self, rngs: Sequence[np.random.Generator], chosen: Mapping[str, FloatArray]
    ) -> dict[str, FloatArray]:
        """Blocks and goals stand on the table, apart from each other."""
        mount = self.machine.mount
        blocks = {"red": self.red, "blue": self.blue, "goal_red": self.red, "goal_blue": self.blue}
        parts = dict(chosen)
        if "goal" in parts:
            parts["goal_red"], parts["goal_blue"] = np.split(parts.pop("goal"), 2, axis=1)
        known = {name: mount.to_paper(parts[name] + hanging(blocks[name])) for name in parts}
        tables = {name: [self.on_table(block)] for name, block in blocks.items()}
        points = sampling.safe_points(rngs, self.machine, tables, known, APART)
        places = {name: mount.to_world(points[name]) - hanging(blocks[name]) for name in blocks}
        goal = np.concatenate([places.pop("goal_red"), places.pop("goal_blue")], axis=1)
        return {**places, "goal": goal, **chosen}

    def gap(self, achieved: ArrayLike, desired: ArrayLike) -> FloatArray:
        """That of the block that is farther from its place."""
        ends = (np.reshape(goal, (*np.shape(goal)[:-1], 2, 3)) for goal in (achieved, desired))
        largest: FloatArray = super().gap(*ends).max(axis=-1)
        return largest

    def shaping(self, state: State) -> dict[str, FloatArray]:
        """Dense only: tilted blocks are dear, and so is an empty cup."""
        if self.reward == "sparse":
            return {}
        tilt = np.linalg.norm(state.object_axis[..., :2], axis=-1).max(axis=-1)
        return {"tilt": -tilt, "empty": -0.1 * (state.held < 0)}

    def plan(self, motion: Motion) -> Iterator[Move]:
        """Each block to its place, and up."""
        up = np.array([0.0, 0.0, -CLEARANCE])  # z points down in the machine's frame
        for block, goal in zip(self.scene.objects, motion.goal.reshape(2, 3), strict=True):
            while not motion.holding(block.name):
                yield from motion.pick(block, CLEARANCE)
            place = motion.carried_to(goal, block.name)
            yield from motion.go([motion.command + up, place + up, place], vacuum=True)
            yield from [Move(place, True), Move(place, True), Move(place, False)]
            yield from motion.go([place + up], vacuum=False)


IDS = tpm_gym.register_task("Sort", Sort)
