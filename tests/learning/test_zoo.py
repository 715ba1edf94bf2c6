"""rl-baselines3-zoo trains with our recipes."""

import shlex

import pytest
import yaml
from pages import DOCS, blocks
from processes import PYTHON, printed_by

import tpm_gym
from tpm_gym import load_policy
from tpm_gym.learning.export import convert
from tpm_gym.learning.features import GoalGapExtractor
from tpm_gym.learning.hindsight import PenaltyHerReplayBuffer
from tpm_gym.learning.zoo import hyperparameters
from tpm_gym.resources import RECIPES


@pytest.mark.parametrize("algorithm", ["sac", "tqc", "ppo"])
def test_every_recipe_is_handed_over_with_classes_for_their_names(algorithm):
    recipes = yaml.safe_load((RECIPES / f"{algorithm}.yml").read_text(encoding="utf-8"))
    translated = hyperparameters(algorithm)
    assert set(translated) == set(recipes) <= set(tpm_gym.ENV_IDS)
    for env_id, entries in translated.items():
        source = recipes[env_id]
        assert entries["n_timesteps"] == source["n_timesteps"]
        assert "demonstrations" not in entries
        assert ("callback" in entries) == ("demonstrations" in source)
        if "replay_buffer_class" in source:
            assert entries["replay_buffer_class"] is PenaltyHerReplayBuffer
        if "features_extractor_class" in source.get("policy_kwargs", {}):
            assert entries["policy_kwargs"]["features_extractor_class"] is GoalGapExtractor


@pytest.mark.usefixtures("needs_pybullet")
@pytest.mark.parametrize(
    ("changed", "steps"),
    [
        ({}, 120),
        pytest.param({"sac": "ppo", "TPMReach-v0": "TPMReachDense-v0"}, 1, marks=pytest.mark.slow),
    ],
)
def test_the_command_of_the_page_runs_and_its_model_can_be_exported(changed, steps, tmp_path):
    pytest.importorskip("rl_zoo3")
    (command,) = (block for block in blocks(DOCS / "training.md", "bash") if "rl_zoo3" in block)
    python, *words = (changed.get(word, word) for word in shlex.split(command))
    assert python == "python"
    algorithm, env_id = (words[words.index(option) + 1] for option in ("--algo", "--env"))
    words += ["--n-timesteps", str(steps), "--eval-freq", "-1", "--num-threads", "1"]
    if algorithm == "sac":  # it learns after 1,000 steps otherwise
        words += ["--hyperparams", "learning_starts:100"]
    printed_by(PYTHON, *words, cwd=tmp_path)
    (model,) = (tmp_path / "logs" / algorithm).glob(f"{env_id}_1/{env_id}.zip")
    policy = convert(model, tmp_path / "policy", trust_pickle=True, env_id=env_id)
    assert load_policy(policy).description.algorithm == algorithm
