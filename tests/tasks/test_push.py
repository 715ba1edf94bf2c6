"""Push: a block that is struck low stays on its base, and one that is struck high topples."""

import gymnasium as gym
import numpy as np
import pytest
from episodes import expert_episode
from scipy.spatial.transform import Rotation
from states import random_state

from tpm_gym import PAPER_TPM
from tpm_gym.mechanism.cup import CUP
from tpm_gym.tasks.motion import hanging
from tpm_gym.tasks.push import CLEARANCE, Push
from tpm_gym.tasks.sampling import BAND

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


@pytest.mark.parametrize("goals", ["sampled", "tempting"])
def test_blocks_are_to_be_pushed_where_the_robot_is_safe(goals):
    task, machine = Push(PAPER_TPM, goals=goals), PAPER_TPM
    drawn = task.start([np.random.default_rng(seed) for seed in range(300)])
    ends = np.stack([drawn["object"], drawn["goal"]], axis=1)
    along = np.abs(np.diff(ends, axis=1)[:, 0, :2]).max(axis=1)
    assert 0.06 <= along.min() <= along.max() <= 0.24
    behind = machine.mount.to_paper(task.behind(ends, np.diff(ends, axis=1), CLEARANCE))
    assert (machine.conditioning_at(behind) >= machine.safe_conditioning).all()
    held = machine.conditioning_at(machine.mount.to_paper(ends + hanging(task.block)))
    assert (held.max() < machine.safe_conditioning + BAND) == (goals == "tempting")


@pytest.mark.parametrize("goals", ["sampled", "tempting"])
def test_the_expert_topples_no_block_and_stays_almost_safe(goals):
    env = gym.make("TPMPush-v0", engine="analytic", goals=goals)
    for seed in range(12):
        infos = [info for *_, info in expert_episode(env, seed)]
        assert not any(info["toppled"] for info in infos)
        least = min(info["conditioning"] for info in infos)
        assert least > 0.9 * PAPER_TPM.safe_conditioning


def test_the_yaw_of_the_block_is_observed_up_to_quarter_turns():
    task, state = Push(PAPER_TPM), random_state(np.random.default_rng(0), (50,))
    yaw = Rotation.from_quat(state.object_quaternion[:, 0]).as_euler("ZYX")[:, 0]
    found = task.decode(task.observe(state))["object_turn"]
    np.testing.assert_allclose(found.T, (np.cos(4 * yaw), np.sin(4 * yaw)), atol=1e-9)
