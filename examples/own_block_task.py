"""A task of one's own with a block: carry it over a wall, which is only painted on the table.

Beside ``own_task.py``, it has a scene, an event, and a plan with the vacuum cup. The expert, tested
by ``python own_block_task.py`` in 2 s of a processor core, succeeds in 100.0% of the episodes.
"""

import gymnasium as gym
import numpy as np

import tpm_gym
from tpm_gym.kinematics.workspace import Region
from tpm_gym.simulation import Block, Patch, Scene
from tpm_gym.tasks import Expert, Move, Task, dense, hanging, sampling

WALL, HALF, TOP = -0.05, 0.01, 0.06  # m: its middle along x, half its thickness, its height
UP = np.array([0.0, 0.0, -0.08])  # m, higher than the wall; the machine's z points down


class Carry(Task):
    """Bring a block over a wall."""

    block, vacuum, events = Block(), True, ("in_wall",)
    scene = Scene((block,), patches=(Patch((WALL - HALF, -0.1), (WALL + HALF, 0), block.colour),))

    def sample(self, rngs, chosen):
        """Draw places of the block and goals, (r, 3) m, on different sides of the wall."""
        mount, table, above = self.machine.mount, self.on_table(self.block), hanging(self.block)
        left = Region(table.low, (WALL - 0.05, *table.high[1:]))
        right = Region((WALL + 0.05, *table.low[1:]), table.high)
        points = sampling.safe_points(rngs, self.machine, {"object": [left], "goal": [right]}, {})
        return {name: mount.to_world(point) - above for name, point in points.items()} | chosen

    def in_wall(self, state):
        """Return whether the block is in the wall, (n,)."""
        x, _, z = state.object_position[:, 0].T
        return (abs(x - WALL) < HALF + self.block.width / 2) & (z < TOP + self.block.height / 2)

    def shaping(self, state):
        """Return the costs of a cup away from the block, if dense, and of the wall, (n,)."""
        approach = dense(self.gap(self.lip(state), self.top(state))) * (self.reward == "dense")
        return {"approach": 0.5 * approach, "wall": -5.0 * self.in_wall(state)}

    def plan(self, motion):
        """Pick the block up, carry it over the wall, and let it go."""
        yield from motion.pick(self.block, 0.03)
        place = motion.carried_to(motion.goal)
        yield from motion.go([motion.command + UP, place + UP, place], vacuum=True)
        yield from [Move(place, True), Move(place, True), Move(place, False)]


tpm_gym.register_task("Carry", Carry)

if __name__ == "__main__":
    envs = gym.make_vec("TPMCarry-v0", 200, engine="analytic", autoreset_mode="Disabled")
    expert, (observation, _), hit = Expert(envs), envs.reset(seed=0), False
    for _ in range(50):
        observation, _, _, _, infos = envs.step(expert.act(observation))
        hit |= infos["in_wall"]
    print(f"expert: {infos['is_success'].mean():.1%} of 200 episodes, in the wall {hit.mean():.1%}")
