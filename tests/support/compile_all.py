"""Compile what the engines compile, once, so that no test has to wait for it.

python tests/support/compile_all.py
"""

import gymnasium as gym

import tpm_gym  # noqa: F401  registers the ids

for engine in ("mujoco", "analytic"):
    for drive in ("ideal", "servo"):
        env = gym.make("TPMPickAndPlaceJoints-v0", engine=engine, drive=drive)
        env.reset(seed=0)
        env.step(env.action_space.sample())
        env.close()
