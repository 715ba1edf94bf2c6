"""The published policies load without trust, fit, and repeat their evaluations."""

import json
from contextlib import closing
from typing import Any

import pytest

import tpm_gym
from tpm_gym.learning import policies
from tpm_gym.learning.environments import make_envs
from tpm_gym.learning.rollout import TEST_SEED, run_episodes
from tpm_gym.resources import POLICIES

NAMES = sorted(path.stem for path in POLICIES.glob("*.safetensors"))
PROMISED = {"TPMReach-v0": 1.0, "TPMPickAndPlace-v0": 0.99, "TPMPickAndPlaceJoints-v0": 0.98}
"""Least success rate of 1000 held-out episodes."""


def evaluation(name: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((POLICIES / f"{name}.evaluation.json").read_text())
    return content


def test_all_that_are_promised_are_there():
    assert set(NAMES) >= set(PROMISED)


@pytest.mark.parametrize("name", NAMES)
def test_the_evaluation_is_of_this_policy_on_held_out_episodes(name):
    content = evaluation(name)
    trained_in = tpm_gym.load_policy(POLICIES / name).description.env_id
    assert content["env"] == name == trained_in.replace("Dense", "")  # for the same spaces
    assert content["policy"] == f"train/policies/{name}.json"
    assert content["episodes"] == len(content["records"]) >= 1000
    assert content["seed"] >= TEST_SEED
    assert content["success_at_end"]["mean"] >= PROMISED.get(name, 0.95)


@pytest.mark.parametrize("name", NAMES)
def test_its_episodes_repeat(name):
    content = evaluation(name)
    with closing(make_envs(name, 1)) as envs:
        policy = policies.load_policy(str(POLICIES / f"{name}.json"), envs)
        records = run_episodes(envs, policy, 5, content["seed"])
    for found, published in zip(records, content["records"], strict=False):
        assert found.seed == published["seed"]
        assert found.success_at_end == published["success_at_end"]
        # Torch's arithmetic differs between machines: success may come a step sooner or later.
        assert found.total_reward == pytest.approx(published["return"], abs=2.0)
        assert found.conditioning_min == pytest.approx(published["conditioning_min"], abs=0.01)


@pytest.mark.parametrize("name", [name for name in NAMES if "Pick" in name])
def test_its_motors_need_the_same_torque_in_both_engines(name):
    torques = []
    for engine in ("pybullet", "mujoco"):
        with closing(make_envs(name, 1, engine=engine)) as envs:
            policy = policies.load_policy(str(POLICIES / f"{name}.json"), envs)
            torques += [[r.torque_rms for r in run_episodes(envs, policy, 20, TEST_SEED)]]
    pybullet, mujoco = (sum(one) for one in torques)
    assert mujoco == pytest.approx(pybullet, rel=0.02)
