"""Searches with the real Optuna and Ray Tune."""

import json
from unittest.mock import Mock

import pytest
import yaml
from processes import PYTHON, printed_by

from tpm_gym.learning import provenance
from tpm_gym.learning.command_line import main
from tpm_gym.learning.configuration import EnvOptions, TrainingConfig, complete
from tpm_gym.learning.run_folder import evaluations

ANALYTIC = EnvOptions(engine="analytic")


@pytest.mark.slow
def test_the_best_of_a_search_is_a_recipe_that_trains(tmp_path):
    """In a process of its own: Ray does not start twice in one with two folders."""
    folder = tmp_path / "tuned"
    words = "tune --env TPMReachDense-v0 --engine analytic --trials 3 --steps 8192 --jobs 2"
    words += " --shield --randomisation friction=0.5:1"
    said = printed_by(
        PYTHON, "-m", "tpm_gym.learning", *words.split(), "--folder", folder, cwd=tmp_path
    )
    assert f"3 trainings of 8,192 steps; their logs: {folder}/NNN.log" in said
    score = {}
    for number in range(3):
        recipe = yaml.safe_load((folder / f"{number:03d}.yml").read_text())
        last = evaluations(folder / f"{number:03d}")[-3:]
        success = sum(e["success_at_end"]["mean"] for e in last) / len(last)
        returned = sum(e["return"]["mean"] for e in last) / len(last)
        score[success + returned / 1000] = recipe
        assert json.loads((folder / f"{number:03d}/config.json").read_text())["seed"] == number
    assert len({str(recipe) for recipe in score.values()}) == 3
    assert yaml.safe_load((folder / "recipe.yml").read_text()) == score[max(score)]
    complete(TrainingConfig("ppo", "TPMReachDense-v0", recipe_file=folder / "recipe.yml"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--trials", "0"], "--trials 0: must be at least 1"),
        (["--folder", "."], "exists; give another"),
        (["--env", "TPMReach-v0"], "no recipe of ppo for TPMReach-v0"),
        (["--engine", "no"], "engine = 'no' is not possible"),
        (["--seed", "999971", "--engine", "analytic"], "--seed 999971: must lie in 0 ... 999715"),
        (["--jobs", "10001"], "--jobs 10001: must be at most 10,000"),
    ],
)
def test_mistakes_are_named_before_ray_starts(words, message):
    with pytest.raises(SystemExit, match=message):
        main(["tune", *words])


def test_a_missing_package_is_named_before_anything_is_said(monkeypatch, capsys):
    monkeypatch.setattr(provenance, "find_spec", lambda name: None)
    with pytest.raises(SystemExit, match=r"needs ray, .*'tpm-gym\[cluster\]'"):
        main(["tune", "--engine", "analytic"])
    assert capsys.readouterr().out == ""


def test_a_cluster_is_joined_with_the_cores_that_it_has(tmp_path, monkeypatch):
    """Ray refuses a number of cores for a cluster that is there."""
    monkeypatch.setenv("RAY_ADDRESS", "10.0.0.1:6379")
    join = Mock(side_effect=ConnectionError("no cluster"))
    monkeypatch.setattr("ray.init", join)  # imported here: Ray keeps the settings of its import
    words = ["tune", "--engine", "analytic", "--jobs", "2", "--folder", str(tmp_path / "tuned")]
    with pytest.raises(SystemExit, match=r"RAY_ADDRESS 10\.0\.0\.1:6379: no cluster; start Ray"):
        main(words)
    assert "num_cpus" not in join.call_args.kwargs


@pytest.mark.usefixtures("registries")
def test_a_task_of_the_users_gets_the_recipe_of_pick_and_place(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "hovering.py").write_text(
        "import tpm_gym\nfrom tpm_gym.tasks import Reach\n\n\nclass Hover(Reach):\n    pass\n\n\n"
        "tpm_gym.register_task('Hover', Hover)\n"
    )
    for algorithm, suffix, like in (
        ("ppo", "Dense-v0", "TPMPickAndPlaceDense-v0"),
        ("ppo", "JointsDense-v0", "TPMPickAndPlaceJointsDense-v0"),
        ("sac", "-v0", "TPMPickAndPlace-v0"),
    ):
        options = ANALYTIC if algorithm == "ppo" else EnvOptions()
        config = TrainingConfig(algorithm, f"hovering:TPMHover{suffix}", env_options=options)
        recipe = complete(config).recipe
        assert recipe.written_for == like
        assert not recipe.demonstrations
