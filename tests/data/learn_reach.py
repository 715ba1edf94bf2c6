"""What the README shows: Stable-Baselines3 learns Reach with what tpm_gym.learning offers."""

import gymnasium as gym
from stable_baselines3 import SAC

from tpm_gym.learning import recipe

env = gym.make("TPMReach-v0")
model = SAC(env=env, seed=0, **recipe("TPMReach-v0"))
model.learn(5_000)

reached = 0
for seed in range(2_000_000, 2_000_100):  # never trained on
    observation, done = env.reset(seed=seed)[0], False
    while not done:
        action, _ = model.predict(observation, deterministic=True)
        observation, _, _, done, info = env.step(action)
    reached += info["is_success"]
print(f"{reached} of 100")
