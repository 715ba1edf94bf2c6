"""A task of one's own in one file: lower the cup onto a place, straight down at the end.

One learns what a task has to say: starts and goals, what is compared with the goal, a reward term,
and the expert's plan. ``python own_task.py`` tests the expert, which takes 8 s of
a processor core; it succeeds in 100.0% of the episodes. In this folder,
``tpm-gym train --env own_task:TPMLandDense-v0 --algo ppo --engine analytic --steps 200000
--run runs/land`` trains a policy.
"""

import gymnasium as gym
import numpy as np

import tpm_gym
from tpm_gym.kinematics.workspace import Region
from tpm_gym.tasks import Expert, Task, sampling

NEAR = 0.05  # m above the goal, where moving sideways begins to cost


class Land(Task):
    """Bring point P to a place on the lowest level of the goals, without a sideways arrival."""

    def sample(self, rngs, chosen):
        """Draw a goal for each episode, (r, 3) m in the world frame."""
        x, y, _ = zip(self.machine.goal_region.low, self.machine.goal_region.high, strict=True)
        z = self.machine.goal_region.high[2]  # the machine's z points down
        regions = {"goal": [Region(low=(x[0], y[0], z), high=(x[1], y[1], z))]}
        known = {"home": self.machine.home}  # the goal is apart from it
        points = sampling.safe_points(rngs, self.machine, regions, known)
        return {"goal": self.machine.mount.to_world(points["goal"]), **chosen}

    def shaping(self, state):
        """Return the cost of sideways speed near the level of the goals, (n,)."""
        level = self.machine.mount.to_world(self.machine.goal_region.high)[2]
        near = np.clip(1 - (state.fk_position[:, 2] - level) / NEAR, 0, 1)
        return {"sideways": -near * np.linalg.norm(state.fk_velocity[:, :2], axis=-1)}

    def plan(self, motion):
        """Move over the goal, then down."""
        goal = self.machine.mount.to_paper(motion.goal)
        yield from motion.go([goal - (0.0, 0.0, NEAR), goal], vacuum=False)


tpm_gym.register_task("Land", Land)

if __name__ == "__main__":
    envs = gym.make_vec("TPMLand-v0", 200, engine="analytic", autoreset_mode="Disabled")
    expert, (observation, _), sideways = Expert(envs), envs.reset(seed=0), 0.0
    for _ in range(50):
        observation, _, _, _, infos = envs.step(expert.act(observation))
        sideways += infos["reward_terms"]["sideways"].mean()
    print(f"expert: {infos['is_success'].mean():.1%} of 200 episodes, sideways {sideways:.3f}")
