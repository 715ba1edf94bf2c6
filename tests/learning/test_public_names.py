"""The package's names are there without the cost of what is behind them."""

import pytest

from tpm_gym import TPMError, learning
from tpm_gym.errors import ConfigurationError
from tpm_gym.learning import errors
from tpm_gym.learning.command_line import main


def test_every_name_is_there_and_unknown_ones_are_not():
    for name in learning.__all__:
        assert getattr(learning, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        learning.nonsense  # noqa: B018


@pytest.mark.parametrize("command", ["train", "resume", "evaluate", "export", "collect", "tune"])
def test_every_command_has_its_help(command, capsys):
    with pytest.raises(SystemExit) as caught:
        main([command, "--help"])
    assert caught.value.code == 0
    shown = capsys.readouterr().out
    assert f"usage: tpm-gym {command}" in shown
    assert "None" not in shown
    assert len(shown.splitlines()) < 75


@pytest.mark.parametrize(
    "words",
    [
        ["train", "--env", "TPMReech-v0"],
        ["resume", "nowhere"],
        ["collect", "--env", "TPMReach-v0", "--kind", "replay", "--steps", "1"],
        ["tune", "--env", "TPMReech-v0"],
    ],
)
def test_a_command_says_that_it_loads_pytorch(words, capsys, tmp_path, monkeypatch):
    if words[0] in (needed := {"collect": "minari", "tune": "ray"}):
        pytest.importorskip(needed[words[0]])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="error: "):
        main(words)
    assert capsys.readouterr().out == "loading PyTorch ...\n"


def test_one_root_catches_every_error():
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type)]
    assert len(kinds) > 5
    assert all(issubclass(kind, TPMError) for kind in kinds)


def test_a_recipe_is_ready_for_stable_baselines():
    keywords = learning.recipe("TPMPickAndPlace-v0", "tqc")
    assert keywords["replay_buffer_class"] is learning.PenaltyHerReplayBuffer
    extractor = keywords["policy_kwargs"]["features_extractor_class"]
    assert extractor is learning.GoalGapExtractor
    assert keywords["learning_rate"](0.5) == pytest.approx(0.0005)
    assert not {"demonstrations", "n_timesteps", "n_envs"} & set(keywords)
    with pytest.raises(errors.ConfigError, match="no recipe of ppo for TPMReach-v0"):
        learning.recipe("TPMReach-v0", "ppo")
    with pytest.raises(errors.ConfigError, match="--engine analytic has one"):
        learning.recipe("TPMPickAndPlaceDense-v0", "ppo")
    with pytest.raises(errors.ConfigError, match="none of sac, tqc, ppo"):
        learning.recipe("TPMReach-v0", "dqn")
    with pytest.raises(ConfigurationError, match="engine = 'analytik'"):
        learning.recipe("TPMReachDense-v0", "ppo", engine="analytik")
