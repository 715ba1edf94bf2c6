"""Training repeats exactly, refuses what cannot work, and leaves a complete run folder."""

import json
import os
import signal
import textwrap
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import gymnasium as gym
import numpy as np
import pytest
import torch
from paths import ROOT
from processes import PYTHON, signalled
from stable_baselines3 import SAC
from trainings import CASES, evaluations, make_config, quiet, said, table, uninterrupted

import tpm_gym
from tpm_gym.errors import TPMError
from tpm_gym.learning import (
    EnvOptions,
    EvaluationConfig,
    ResumeConfig,
    TrainingConfig,
    evaluate,
    resume,
    train,
    training,
)
from tpm_gym.learning.algorithms import ALGORITHMS
from tpm_gym.learning.configuration import complete
from tpm_gym.learning.environments import make_envs
from tpm_gym.learning.errors import ConfigError, DivergedError, RunError
from tpm_gym.learning.export import load_model
from tpm_gym.learning.policies import load_policy
from tpm_gym.learning.recipes import read_recipe, read_recipes, recipe_file
from tpm_gym.learning.rollout import SELECTION_SEED, run_episodes
from tpm_gym.learning.training import make_model
from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.simulation import Randomisation, Servo

RECIPE = CASES["sac"][2]


@pytest.fixture
def run():
    """A finished run of SAC with hindsight, not to be changed."""
    return uninterrupted("sac")


def parameters(run: Path, name: str = "last.zip") -> dict[str, Any]:
    """Return every parameter of a saved policy: actor, critics and their targets."""
    unused = {"replay_buffer_class": None, "replay_buffer_kwargs": {}}
    return SAC.load(run / name, custom_objects=unused).policy.state_dict()


def equal(first: dict[str, Any], second: dict[str, Any]) -> bool:
    return all(torch.equal(value, second[name]) for name, value in first.items())


@pytest.mark.usefixtures("no_pictures")
def test_same_seed_same_policy_whatever_is_evaluated(run, tmp_path):
    config = replace(make_config("sac", tmp_path), eval_episodes=2, eval_every=1000)
    train(config, quiet())
    assert equal(parameters(run), parameters(config.run))
    train(replace(config, run=tmp_path / "other", seed=1, steps=60), quiet())
    assert not equal(parameters(run), parameters(tmp_path / "other"))


def test_steps_are_whole_rollouts_and_no_update_is_without_a_learning_rate(tmp_path):
    """With 100 steps there are three rollouts of 40; the rate falls by a third after each."""
    config = make_config("ppo", tmp_path)
    text = config.recipe_file.read_text().replace(
        "n_epochs", "learning_rate: lin_0.003\n  n_epochs"
    )
    config.recipe_file.write_text(text)
    console = quiet()
    train(replace(config, steps=100), console)
    assert "120 steps, in" in said(console)
    assert "100 steps were asked for, and rounded up to 120: 3 rollouts of 40" in said(console)
    rows = [row["train/learning_rate"] for row in table(config.run)]
    assert [float(rate) for rate in rows if rate] == pytest.approx([0.003, 0.002, 0.001])
    assert json.loads((config.run / "config.json").read_text())["steps"] == 120
    resume(ResumeConfig(config.run, steps=121), quiet())
    assert evaluations(config.run)[-1]["steps"] == 160


def test_a_training_that_diverges_says_so(tmp_path):
    config = make_config("ppo", tmp_path)
    text = config.recipe_file.read_text().replace("n_epochs", "learning_rate: 1.0e+30\n  n_epochs")
    config.recipe_file.write_text(text)
    with pytest.raises(DivergedError, match=r"diverged before step \d+.*lower learning_rate in"):
        train(config, quiet())


def test_config_records_the_whole_run(run):
    text = (run / "config.json").read_text(encoding="utf-8")
    content = json.loads(text)
    assert (content["algo"], content["env"], content["seed"]) == ("sac", "TPMReach-v0", 0)
    assert (content["steps"], content["eval_every"], content["eval_episodes"]) == (300, 140, 1)
    assert content["recipe"]["hindsight"] is True
    assert content["recipe"]["arguments"]["gamma"] == 0.95
    assert content["training_seeds"] == [0, 0]
    assert content["evaluation_seeds"] == [SELECTION_SEED, SELECTION_SEED]
    assert content["versions"]["stable-baselines3"]
    assert content["machine"]["cpu_count"] == os.cpu_count()
    assert "git_commit" in content
    # Nothing about the machine it ran on beyond its kind; the recipe was in the folder above.
    assert str(run.parent) not in text


@pytest.mark.usefixtures("no_pictures")
def test_what_is_chosen_reaches_every_environment_and_survives_resuming(tmp_path, monkeypatch):
    snug = replace(PAPER_TPM, name="snug", table=(0.4, 0.3))
    tpm_gym.register_machine("snug", snug)
    made: list[Any] = []

    def remember(make, *args, **options):
        made.append(make(*args, **options))
        return made[-1]

    for name in ("make", "make_vec"):
        monkeypatch.setattr(gym, name, partial(remember, getattr(gym, name)))
    options = EnvOptions(machine="snug", drive="servo")
    config = replace(make_config("sac", tmp_path), steps=110, penalty_weight=0.0, goals="tempting")
    config = replace(config, env_options=options, randomisation=("latency=1", "friction=0.5:1"))
    config.recipe_file.write_text(RECIPE + "  demonstrations: {episodes: 1}\n", encoding="utf-8")
    folder = config.run
    train(config, quiet())
    content = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    changed = ("penalty_weight", "goals", "env_options", "randomisation")
    assert (content["penalty_weight"], content["goals"]) == (0.0, "tempting")
    assert content["env_options"] == {"machine": "snug", "drive": "servo"}
    assert len(made) == 4  # before all, training, evaluation, demonstrations
    resume(ResumeConfig(folder, steps=170), quiet())
    assert len(made) == 6
    for env in made:
        inner = env.unwrapped
        assert inner.task.penalty_weight == 0.0
        assert inner.task.goals == "tempting"
        assert (inner.machine, inner.drive) == (snug, Servo())
        assert inner.randomisation == Randomisation(latency=1, friction=(0.5, 1.0))
    again = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    assert [again[name] for name in changed] == [content[name] for name in changed]
    evaluate(EvaluationConfig(policy=(str(folder),), episodes=1), quiet())
    inner = made[-1].unwrapped
    assert (inner.machine, inner.drive) == (snug, Servo())


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("algo", "zzz"),
        ("goals", "zz"),
        ("env_options", None),
        ("recipe.fred", 2),
        ("steps", "abc"),
        ("recipe.arguments", {"batch_size": -3}),
        ("recipe.arguments", {"train_fred": 2}),
    ],
)
def test_a_damaged_configuration_is_named_and_left_as_it_is(name, value, run, tmp_path):
    stored = json.loads((run / "config.json").read_text(encoding="utf-8"))
    outer, _, inner = name.partition(".")
    changed = {**stored[outer], inner: value} if inner else value
    (tmp_path / "config.json").write_text(json.dumps({**stored, outer: changed}))
    before = (tmp_path / "config.json").read_bytes()
    with pytest.raises(RunError, match=r"configuration of .* is damaged: .*--overwrite") as caught:
        resume(ResumeConfig(tmp_path), quiet())
    assert name[:4] in str(caught.value)
    assert (tmp_path / "config.json").read_bytes() == before


def test_best_policy_is_the_one_evaluated_best(run):
    scores = [
        (entry["success_at_end"]["mean"], entry["return"]["mean"]) for entry in evaluations(run)
    ]
    assert score(run / "best.json") == pytest.approx(max(scores), abs=1e-3)
    assert score(run / "last.json") == pytest.approx(scores[-1], abs=1e-3)


def score(path: Path) -> tuple[float, float]:
    """Return success and return of a saved policy over the episode that selects."""
    with closing(make_envs("TPMReach-v0", 1)) as envs:
        policy = load_policy(str(path), envs)
        (record,) = run_episodes(envs, policy, 1, SELECTION_SEED)
    return record.success_at_end, record.total_reward


def test_both_policies_are_exported_and_nothing_is_unpickled_for_it(run):
    for name in ("best", "last"):
        exported = tpm_gym.load_policy(run / name)
        saved = load_model(run / f"{name}.zip", "sac")
        batch = {
            key: np.stack([box.sample() for _ in range(8)])
            for key, box in saved.observation_space.items()
        }
        expected, _ = saved.predict(batch, deterministic=True)
        np.testing.assert_allclose(exported.act(batch), expected, atol=1e-5)
        config = json.loads((run / "config.json").read_text())
        assert exported.description.recipe == config["recipe"]
        assert exported.description.steps == saved.num_timesteps


@pytest.mark.usefixtures("needs_pybullet")
@pytest.mark.parametrize(
    ("number", "status"),
    [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow)],
)
def test_command_line_trains_ppo_in_parallel_and_stops_when_asked_to(tmp_path, number, status):
    """Signal the whole process group, workers included, as a terminal or a batch system does."""
    config = make_config("ppo in processes", tmp_path)
    folder = config.run
    words = ["--algo", "ppo", "--env", config.env, "--steps", "1000000", "--run", str(folder)]
    words += ["--recipe", str(config.recipe_file), "--checkpoint-every", "80"]
    saved = folder / "checkpoints" / "000000080.checkpoint"
    command = [PYTHON, ROOT / "train" / "train.py", *words, "--eval-episodes", "1"]
    returned, output = signalled(command, saved.is_file, number)
    assert returned == status, output
    assert "Traceback" not in output
    assert f"stopped early by {number.name}, saved at step" in output
    assert f"tpm-gym resume {folder}" in output
    assert (folder / "last.zip").is_file()
    assert json.loads((folder / "config.json").read_text())["training_seeds"] == [0, 1]


PICK = {"env": "TPMPickAndPlace-v0", "recipe_file": recipe_file("sac")}


@pytest.mark.usefixtures("needs_pybullet")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"algo": "dqn"}, "'dqn' is none of sac, tqc, ppo"),
        ({"steps": 0}, "--steps 0: must be at least 1"),
        ({"penalty_weight": -0.1}, "penalty_weight = -0.1"),
        ({"recipe_file": Path("none.yml"), "env_options": EnvOptions("narrow")}, "'narrow'"),
        ({"recipe_file": Path("none.yml"), "envs": 0}, "--envs 0: must be at least 1"),
        ({"randomisation": ("block_mass",)}, "--randomisation block_mass: must be KEY=NUMBER"),
        ({"seed": SELECTION_SEED - 2, "envs": 3}, "held out"),
        ({"envs": 5}, "learning_starts: 100 is less than the 250 steps .* at most --envs 2"),
        ({"envs": 1001}, r"--envs 1001 \(n_envs of the recipe, .*at most 1,000"),
        ({"envs": 10**8, "env_options": EnvOptions(engine="analytic")}, "at most 1,000,000"),
        ({"steps": 1}, r"--steps 1: one rollout takes 2 \(1 environments x train_freq\)"),
        ({**PICK, "steps": 20_000}, "more than the 20,000 of the demonst"),
        ({**PICK, "steps": 20_050, "envs": 3}, "the 20,100 of"),
        ({**PICK, "steps": 500, "demonstrations": 10}, "the 500 of"),
        ({"demonstrations": -1}, "--demonstrations -1: must be at least 0"),
        ({"algo": "ppo", "recipe_file": None}, "no recipe of ppo for TPMReach-v0; .*--recipe FILE"),
        ({"recipe_file": Path("none.yml")}, "cannot be read"),
        ({"device": "meta"}, "--device meta"),
        ({"threads": 10**12}, "--threads 1000000000000: must be at most 1,024"),
        ({"env": ":"}, "unknown environment ':'"),
        ({"env": ":TPMReach-v0"}, "unknown environment ':TPMReach-v0'"),
        ({"env": "json:"}, "unknown environment 'json:'"),
        ({"env_options": EnvOptions(machine="narrow")}, "machine = 'narrow'"),
    ],
)
def test_mistakes_are_named_before_anything_is_written(options, message, tmp_path):
    with pytest.raises(TPMError, match=message):
        train(replace(make_config("sac", tmp_path), **options), quiet())
    assert not (tmp_path / "run").exists()


def test_demonstrations_are_counted_as_they_are_played(tmp_path):
    """Each of two environments plays two episodes of 50 steps."""
    config, console = make_config("sac in the analytic engine", tmp_path), quiet()
    train(replace(config, steps=211, demonstrations=3, test_episodes=0), console)
    assert "3 demonstrations were asked for, and rounded up to 4" in said(console)
    assert "211 steps were asked for, and rounded up to 212: 200 of dem" in said(console)
    waits = [line for line in said(console).splitlines() if line.endswith("...")]
    assert waits == [
        "playing 4 demonstrations of the expert and learning from them ...",
        "first evaluation, before training ...",
    ]
    assert said(console).index("212 steps, in") < said(console).index(waits[0])
    assert said(console).index(waits[1]) < said(console).index("200 steps   success")
    assert json.loads((config.run / "config.json").read_text())["demonstrations"] == 4
    assert complete(replace(config, envs=1)).demonstrations == 2
    assert complete(replace(config, demonstrations=0)).demonstrations == 0


@pytest.mark.parametrize(
    ("env", "engine", "algo", "written_for"),
    [
        ("TPMReach-v0", None, "sac", "TPMReach-v0"),
        ("TPMReachDense-v0", None, "ppo", "TPMReachDense-v0"),
        ("TPMPickAndPlaceDense-v0", None, "sac", "TPMPickAndPlaceDense-v0"),
        ("TPMPickAndPlaceDense-v0", "analytic", "ppo", "TPMPickAndPlaceDense-v0"),
        ("TPMCrossing-v0", "analytic", "ppo", "TPMCrossing-v0"),
        ("TPMStackDense-v0", "analytic", "ppo", "TPMPickAndPlaceDense-v0"),
        ("TPMThrow-v0", None, "sac", "TPMPickAndPlace-v0"),
    ],
)
def test_without_an_algorithm_one_that_has_a_recipe_is_taken(env, engine, algo, written_for):
    config = complete(TrainingConfig(env=env, env_options=EnvOptions(engine=engine)))
    assert (config.algo, config.recipe.written_for) == (algo, written_for)
    assert config.run == Path(f"runs/{env}-{algo}-s0")


def test_a_recipe_of_another_task_is_announced_with_that_of_the_id(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "_Session", Mock())
    config, console = TrainingConfig("sac", "TPMReachDense-v0", run=tmp_path / "run"), quiet()
    train(replace(config, steps=60_000), console)
    assert (
        "note: the recipe of sac is that of TPMPickAndPlaceDense-v0; the id has one with --algo "
        "ppo; give your own with --recipe FILE"
    ) in said(console)


def test_demonstrations_are_as_many_as_asked_for(tmp_path):
    config = replace(make_config("sac", tmp_path), **PICK)
    for count, found in {None: 400, 10: 10, 0: None}.items():
        recipe = complete(replace(config, steps=30_000, demonstrations=count)).recipe
        assert recipe.demonstrations.get("episodes") == found
        assert recipe.demonstrations.get("noise") == (0.3 if found else None)
    cloned = complete(replace(make_config("ppo", tmp_path), demonstrations=1)).recipe
    assert cloned.demonstrations == {"episodes": 1}
    recipe = RECIPE + "  demonstrations: {episodes: 1, epochs: 3}\n"
    (tmp_path / "own.yml").write_text(recipe, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"demonstrations.epochs"):  # nothing is fitted to them
        complete(replace(make_config("sac", tmp_path), recipe_file=tmp_path / "own.yml"))


@pytest.mark.parametrize(
    ("case", "before", "after", "message"),
    [
        *(
            ("sac", "buffer_size: 230", f"buffer_size: {size}", "buffer_size")
            for size in (49, 99, 10**12, 10**30)
        ),
        ("ppo", "batch_size: 20", "batch_size: 1", "batch_size: 1: advantages of one step cannot"),
        ("ppo", "n_steps: 40", "n_steps: 1", "n_steps: 1: advantages of one step cannot"),
        ("ppo", "n_steps: 40", "n_steps: 301", "--steps 300: one rollout takes 301 .*--envs"),
        (
            "ppo",
            "n_steps: 40",
            f"n_steps: {10**12}",
            r"takes 1,000,000,000,000 \(1 environments x n_s",
        ),
        ("ppo", "n_steps: 40", f"n_steps: {10**12}\n  n_timesteps: {10**15}", f"n_steps {10**12}:"),
    ],
)
def test_sizes_that_cannot_be_are_one_line_before_anything_is_written(
    case, before, after, message, tmp_path
):
    config = make_config(case, tmp_path)
    text = config.recipe_file.read_text()
    assert before in text
    if "n_timesteps" in after:
        text = text.replace("  n_timesteps: 300\n", "")
    config.recipe_file.write_text(text.replace(before, after))
    with pytest.raises(ConfigError, match=message) as caught:
        train(config, quiet())
    assert "\n" not in str(caught.value)
    assert not config.run.exists()


SHIPPED = [
    (algorithm, env_id)
    for algorithm in ALGORITHMS
    for env_id in read_recipes(recipe_file(algorithm), algorithm)
]


@pytest.mark.parametrize(("algorithm", "env_id"), SHIPPED)
def test_shipped_recipes_are_arguments_of_the_algorithm_and_relabel_sparse_rewards(
    algorithm, env_id
):
    config = complete(TrainingConfig(algo=algorithm, env=env_id))
    recipe = config.recipe
    assert recipe.hindsight == ("Dense" not in env_id)
    if algorithm == "ppo":
        assert recipe.arguments["n_steps"] * config.envs % recipe.arguments["batch_size"] == 0
    else:  # a buffer of full size takes seconds to build
        recipe = replace(recipe, arguments={**recipe.arguments, "buffer_size": 100})
    envs = gym.make(env_id)
    model = make_model(replace(config, recipe=recipe), envs)
    assert model.gamma == recipe.arguments["gamma"]
    assert model.policy_kwargs["net_arch"] == recipe.arguments["policy_kwargs"]["net_arch"]
    envs.close()


def test_recipes_of_the_analytic_engine_are_for_many_environments_and_every_id():
    options = EnvOptions(engine="analytic")
    without = "Stack", "Throw", "Conve", "Cross", "Cycle"
    for algorithm, env_id in product(ALGORITHMS, tpm_gym.ENV_IDS):
        if ("Dense" in env_id) == (algorithm == "ppo") and env_id[3:8] not in without:
            config = complete(TrainingConfig(algo=algorithm, env=env_id, env_options=options))
            assert config.envs > 1
            assert config.recipe.hindsight == ("Dense" not in env_id)
            known = read_recipes(recipe_file(algorithm, "analytic"), algorithm)
            assert env_id in known or "Push" in env_id or "Stack" in env_id


def test_one_file_has_recipes_of_several_algorithms(tmp_path):
    texts = {algorithm: textwrap.indent(CASES[algorithm][2], "  ") for algorithm in ("sac", "ppo")}
    path = tmp_path / "both.yml"
    path.write_text("".join(f"{name}:{text}" for name, text in texts.items()), encoding="utf-8")
    assert read_recipe(path, "sac", "TPMReach-v0").hindsight
    assert read_recipe(path, "ppo", "TPMReachDense-v0").arguments["n_steps"] == 40
    with pytest.raises(ConfigError, match="no recipe of tqc for TPMReach-v0; it has none"):
        read_recipe(path, "tqc", "TPMReach-v0")


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("[8],", "[1000000, 1000000],", "policy_kwargs.net_arch.*less than or equal to 4096"),
        ("[8],", "'dict(net_arch=[8])',", "policy_kwargs.net_arch.*a valid list"),
        ("{net_arch:", "{net_arc:", "policy_kwargs.net_arc: .*not permitted"),
        ("gamma: 0.95", "gama: 0.95", "gama: unknown key; valid keys: batch_size, buffer_size"),
        ("gamma: 0.95", "gamma: 1.5", "gamma: .*less than or equal to 1, not 1.5"),
        ("gamma: 0.95", "gamma: 9e-1", "gamma: .*valid number, not '9e-1'"),
        ("gamma: 0.95", "gamma: [", "is not YAML"),
        ("gamma: 0.95", "gamma: !!python/object/apply:os.getcwd []", "is not YAML"),
        ("batch_size: 16", "batch_size: true", "batch_size: .*a valid integer"),
        (": future", ": past", "goal_selection_strategy: .*'future', 'final' or 'episode'"),
        ("HerReplayBuffer", "os.system", "replay_buffer_class: .*'HerReplayBuffer'"),
        ("policy: MultiInputPolicy", "", "policy: Field required"),
        ("replay_buffer_class: HerReplayBuffer", "", "replay_buffer_kwargs: no effect"),
        (
            "features_extractor_class: GoalGapExtractor",
            "features_extractor_kwargs: {unit: 0.1}",
            "features_extractor_kwargs: no effect",
        ),
        ("[8],", "{pi: [8]},", r"net_arch.*Field required \(qf\)"),
        ("[8],", "{pi: [8], qf: [8], vf: [8]},", r"net_arch.*not permitted \(vf\)"),
        ("TPMReach-v0:", "- TPMReach-v0:", "valid dictionary"),
        ("lin_0.0003", "lin_0", r"learning_rate.*\^lin_"),
        ("lin_0.0003", "lin_inf", r"learning_rate.*\^lin_"),
    ],
)
def test_recipe_mistakes_name_file_key_and_choice(before, after, message, tmp_path):
    assert before in RECIPE
    path = tmp_path / "wrong.yml"
    path.write_text(RECIPE.replace(before, after), encoding="utf-8")
    with pytest.raises(ConfigError, match=message) as caught:
        read_recipe(path, "sac", "TPMReach-v0")
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize(("dropped", "quantiles"), [(25, None), (5, 5), (2, 2)])
def test_a_recipe_of_tqc_that_drops_all_quantiles_is_refused(dropped, quantiles, tmp_path):
    path = tmp_path / "wrong.yml"
    given = "" if quantiles is None else f"n_quantiles: {quantiles}, "
    text = RECIPE.replace("{net_arch", f"{{{given}net_arch")
    path.write_text(f"{text}  top_quantiles_to_drop_per_net: {dropped}\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=f"must be less than n_quantiles, .*not {dropped}"):
        read_recipe(path, "tqc", "TPMReach-v0")
