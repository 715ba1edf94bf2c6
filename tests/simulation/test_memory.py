"""Environments and copies that are dropped without close() leave no memory behind."""

from pathlib import Path

import pytest
from processes import PYTHON, printed_by

SCRIPT = """
import copy, ctypes, gc, os
import gymnasium as gym, tpm_gym
def memory():
    gc.collect()
    getattr(ctypes.CDLL(None), "malloc_trim", print)(0)
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
def drop(count):
    for _ in range(count):
        env = gym.make("TPMPickAndPlace-v0", {options})
        env.reset(seed=0)
        copy.deepcopy(env).step(env.action_space.sample())
drop(10)
before = memory()
for _ in range(10):
    drop(10)
    if memory() > before + 100:
        break
print(memory() - before)
"""


@pytest.mark.slow  # half a minute each
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs Linux")
@pytest.mark.parametrize(
    ("options", "megabytes"),
    [
        ("randomisation={'length_error': 1e-4}", 20),
        ("engine='mujoco', randomisation={'length_error': 1e-4}", 10),
    ],
)
def test_200_environments_and_copies_are_given_back(options, megabytes):
    said = printed_by(PYTHON, "-c", SCRIPT.replace("{options}", options))
    assert float(said.split()[-1]) < megabytes


OPEN = """
import os
import gymnasium as gym, tpm_gym
def memory():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
def opened():
    size = {"width": 64, "height": 48}
    env = gym.make("TPMPickAndPlace-v0", engine="mujoco", render_mode="rgb_array", **size)
    env.reset(seed=0)
    env.render()
    return env
envs = [opened()]
before = memory()
envs += [opened() for _ in range(6)]
print((memory() - before) / 6)
"""


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs Linux")
def test_an_environment_that_draws_small_pictures_in_mujoco_takes_little_memory():
    assert float(printed_by(PYTHON, "-c", OPEN).split()[-1]) < 40  # 13; 77 with a map for shadows
