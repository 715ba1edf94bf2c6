"""Push: a block that is struck low stays on its base, and one that is struck high topples."""

import gymnasium as gym
import numpy as np
import pytest
from episodes import expert_episode
from scipy.spatial.transform import Rotation
from states import random_state

from tpm_gym import PAPER_TPM
from tpm_gym.mechanism.cup import CUP
from tpm_gym.tasks.push import Push

START = {"object": (0.0, -0.03, 0.02), "goal": (0.1, -0.033, 0.02)}


def struck(engine: str, height: float) -> tuple[list[bool], list[float]]:
    """``toppled`` and the z of the block's axis in each step; the lip hits it at full speed."""
    env = gym.make("TPMPush-v0", engine=engine)
    env.reset(seed=0, options=START)
    inner, toppled, upright = env.unwrapped, [], []
    behind = np.array([-0.09, -0.03, height + CUP.length])
    for wanted in [behind] * 12 + [behind + (0.12, 0.0, 0.0)] * 14:
        place, current = (inner.machine.mount.to_paper(p) for p in (wanted, inner.state.command))
        action = inner.control.action(place[None], current[None])[0]
        *_, info = env.step(action)
        toppled.append(bool(info["toppled"]))
        upright.append(float(inner.state.object_axis[0, 2]))
    return toppled, upright


@pytest.mark.parametrize("engine", ["pybullet", "mujoco", "analytic"])
def test_a_block_that_is_struck_high_topples_and_info_says_so(engine):
    """In all engines: PyBullet alone would strike a low lip's block at its upper edge."""
    for height, falls in ((0.027, False), (0.034, True)):
        toppled, upright = struck(engine, height)
        assert toppled == [z < np.sqrt(0.5) for z in upright]
        assert not toppled[0]
        assert toppled[-1] == falls
        assert (upright[-1] < 0.1) == falls


def test_the_expert_topples_no_block():
    env = gym.make("TPMPush-v0", engine="analytic")
    for seed in range(20):
        assert not any(info["toppled"] for *_, info in expert_episode(env, seed))


def test_the_yaw_of_the_block_is_observed_up_to_quarter_turns():
    task, state = Push(PAPER_TPM), random_state(np.random.default_rng(0), (50,))
    yaw = Rotation.from_quat(state.object_quaternion[:, 0]).as_euler("ZYX")[:, 0]
    found = task.decode(task.observe(state))["object_turn"]
    np.testing.assert_allclose(found.T, (np.cos(4 * yaw), np.sin(4 * yaw)), atol=1e-9)
