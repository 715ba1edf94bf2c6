"""PPO on the dense pick-and-place, in 256 environments of the analytic engine.

One learns to give many environments to Stable-Baselines3, by ``AnalyticVecEnv`` and the recipe for
this engine. It takes 78 s of a processor core, and reached 98.2% success.
"""

import sys
import time

import gymnasium as gym
import torch
from stable_baselines3 import PPO

import tpm_gym  # registers the ids  # noqa: F401
from tpm_gym.learning import AnalyticVecEnv, recipe

STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 900_000
ENV_ID = "TPMPickAndPlaceDense-v0"

torch.set_num_threads(1)  # small networks: more threads wait for each other
envs = gym.make_vec(
    ENV_ID,
    num_envs=256,
    engine="analytic",
    autoreset_mode="SameStep",
    stagger=True,  # else all episodes end at once, and each batch is of one part of an episode
)
model = PPO(env=AnalyticVecEnv(envs), seed=0, **recipe(ENV_ID, "ppo", engine="analytic"))
begin = time.perf_counter()
model.learn(STEPS)
print(f"{model.num_timesteps:,} steps in {time.perf_counter() - begin:.0f} s")

# One episode in each of 500 environments, with seeds that the training has not seen.
tests = gym.make_vec(ENV_ID, 500, engine="analytic", autoreset_mode="Disabled")
observation, _ = tests.reset(seed=2_000_000)
for _ in range(50):
    action, _ = model.predict(observation, deterministic=True)
    observation, _, _, _, infos = tests.step(action)
print(f"success at the end: {infos['is_success'].mean():.1%} of 500 episodes")
