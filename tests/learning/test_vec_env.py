"""Environments of the analytic engine behind Stable-Baselines3, and policies evaluated in them."""

import copy
import json
from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from episodes import EVERYTHING, bits
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

import tpm_gym
from tpm_gym.learning import AnalyticVecEnv
from tpm_gym.learning.environments import make_envs

PICK = "TPMPickAndPlace-v0"


def vec_env(env_id: str = PICK, count: int = 3, **options: Any) -> AnalyticVecEnv:
    options = {"autoreset_mode": "SameStep", "engine": "analytic", **options}
    return AnalyticVecEnv(make_envs(env_id, count, **options))


def test_it_is_sb3s_own_vector_of_single_environments():
    theirs = DummyVecEnv([lambda: gym.make(PICK, engine="analytic", max_episode_steps=6)] * 3)
    ours = vec_env(max_episode_steps=6)
    for envs in (ours, theirs):
        envs.reset()
        envs.step(np.zeros((3, 4), np.float32))  # of an episode that the next reset ends
        envs.seed(4)
    one, other = ours.reset(), theirs.reset()
    rng, rewards = np.random.default_rng(0), []
    for _ in range(15):
        for name in one:
            np.testing.assert_array_equal(one[name], other[name])
        actions = rng.uniform(-1.0, 1.0, (3, 4)).astype(np.float32)
        (one, *got), (other, *wanted) = ours.step(actions), theirs.step(actions)
        rewards.append(got[0])
        for values, expected in zip(got[:2], wanted[:2], strict=True):
            np.testing.assert_array_equal(values, expected)
        sums = np.sum(rewards[-6:], axis=0).tolist()
        for info, expected, total in zip(got[2], wanted[2], sums, strict=True):
            last = info.get("terminal_observation")
            if last is None:
                assert "terminal_observation" not in expected
                continue
            for name, values in expected["terminal_observation"].items():
                np.testing.assert_array_equal(last[name], values)
            for name in ("TimeLimit.truncated", "is_success"):
                assert info[name] == expected[name]
            assert info["episode"] == {"r": pytest.approx(total), "l": 6}


def test_options_are_of_their_environments_and_of_the_next_reset_only():
    theirs = DummyVecEnv([lambda: gym.make(PICK, engine="analytic")] * 3)
    ours, goal = vec_env(), [0.02, -0.03, 0.05]
    for options in ({"goal": goal}, [{}, {"goal": goal}, {}], {}):
        found = []
        for envs in (ours, theirs):
            envs.seed(4)
            envs.set_options(options)
            found.append((envs.reset(), envs.reset()))
        for one, other in zip(*found, strict=True):
            for name in one:
                np.testing.assert_array_equal(one[name], other[name])


def test_robots_that_differ_go_on_equally_from_what_is_saved():
    one, other = (vec_env(max_episode_steps=12, randomisation=EVERYTHING) for _ in range(2))
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 3, 4)).astype(np.float32)
    for envs in (one, other):
        envs.reset()
    for action in actions[:7]:
        one.step(action)
    plain, arrays = copy.deepcopy(one.state())
    other.restore(json.loads(json.dumps(plain)), arrays)
    for action in actions[7:]:
        assert bits(one.step(action)) == bits(other.step(action))
        assert bits(vars(one.envs.state)) == bits(vars(other.envs.state))  # torques, too


def test_another_autoreset_is_refused():
    with pytest.raises(tpm_gym.errors.ConfigurationError, match=r"autoreset_mode='SameStep'"):
        vec_env(autoreset_mode="NextStep")
    one = gym.make(PICK, engine="analytic")
    with pytest.raises(tpm_gym.errors.ConfigurationError, match=r"gym\.make_vec"):
        AnalyticVecEnv(one)


def test_an_exported_policy_is_compared_with_it():
    with closing(VecMonitor(vec_env())) as envs:
        tpm_gym.load_policy(PICK).check(envs)
        with pytest.raises(tpm_gym.errors.PolicyMismatchError, match="control joints"):
            tpm_gym.load_policy("TPMPickAndPlaceJoints-v0").check(envs)
