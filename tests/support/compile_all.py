"""Compile what the engines compile, once, so that no test has to wait for it.

python tests/support/compile_all.py
"""

import gymnasium as gym

import tpm_gym  # noqa: F401  registers the ids

for machine in ("paper", "delta"):
    for engine in ("mujoco", "analytic"):
        for drive in ("ideal", "servo"):
            env = gym.make(
                "TPMPickAndPlaceJoints-v0",
                engine=engine,
                machine=machine,
                drive=drive,
                shield=drive == "ideal",
            )
            env.reset(seed=0)
            env.step(env.action_space.sample())
            env.close()
