"""SAC with hindsight on the sparse Reach, by Stable-Baselines3 and the shipped recipe.

One learns that an environment of this package is an ordinary one, and that the recipe brings the
replay buffer that keeps the singularity penalty. It needs the installed package with the extra
``train`` and nothing of the repository.
It takes 47 s of a processor core, and reached 100.0% success.
"""

import sys

import gymnasium as gym
import torch
from stable_baselines3 import SAC

import tpm_gym  # registers the ids  # noqa: F401
from tpm_gym.learning import PenaltyHerReplayBuffer, recipe

STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 5_000
ENV_ID = "TPMReach-v0"

torch.set_num_threads(1)  # small networks: more threads wait for each other
env = gym.make(ENV_ID, engine="analytic")  # or "pybullet" (the default), "mujoco"
arguments = recipe(ENV_ID, "sac")
assert arguments["replay_buffer_class"] is PenaltyHerReplayBuffer
model = SAC(env=env, seed=0, **arguments)
model.learn(STEPS, log_interval=20)

# One episode in each of 200 environments, with seeds that the training has not seen.
envs = gym.make_vec(ENV_ID, 200, engine="analytic", autoreset_mode="Disabled")
observation, _ = envs.reset(seed=2_000_000)
unsafe = 0.0
for _ in range(50):
    action, _ = model.predict(observation, deterministic=True)
    observation, _, _, _, infos = envs.step(action)
    unsafe += (infos["singularity_penalty"] > 0).mean() / 50
print(f"success at the end: {infos['is_success'].mean():.1%} of 200 episodes")
print(f"time near the singularity: {unsafe:.2%}")
