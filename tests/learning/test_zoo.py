"""rl-baselines3-zoo trains with our recipes."""

import pytest
import yaml
from processes import PYTHON, printed_by

import tpm_gym
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
    ("algorithm", "env_id", "steps"),
    [
        ("sac", "TPMReach-v0", 120),
        pytest.param("ppo", "TPMReachDense-v0", 1, marks=pytest.mark.slow),
    ],
)
def test_the_zoo_runs_them(algorithm, env_id, steps, tmp_path):
    pytest.importorskip("rl_zoo3")
    words = ["--algo", algorithm, "--env", env_id, "--n-timesteps", str(steps)]
    words += ["--gym-packages", "tpm_gym", "--conf-file", "tpm_gym.learning.zoo"]
    words += ["--eval-freq", "-1", "--log-folder", str(tmp_path / "logs"), "--num-threads", "1"]
    if algorithm == "sac":  # it learns after 1,000 steps otherwise
        words += ["--hyperparams", "learning_starts:100"]
    printed_by(PYTHON, "-m", "rl_zoo3.train", *words, cwd=tmp_path)
    assert list((tmp_path / "logs" / algorithm).glob(f"{env_id}_1/*.zip"))
