"""Training repeats exactly, refuses what cannot work, and leaves a complete run folder."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from paths import ROOT
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from trainings import quiet

import tpm_gym
from tpm_gym.learning import (
    EvaluationConfig,
    GoalGapExtractor,
    ResumeConfig,
    TrainingConfig,
    evaluate,
    resume,
    train,
)
from tpm_gym.learning.algorithms import ALGORITHMS
from tpm_gym.learning.configuration import complete, resumed
from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.policies import load_model, load_policy
from tpm_gym.learning.recipes import read_recipe, read_recipes, recipe_file
from tpm_gym.learning.rollout import SELECTION_SEED, run_episodes
from tpm_gym.learning.training import make_model

SMALL = """
TPMReach-v0:
  n_timesteps: 400
  policy: MultiInputPolicy
  buffer_size: 1000
  learning_starts: 200
  train_freq: 2
  batch_size: 16
  gamma: 0.95
  replay_buffer_class: HerReplayBuffer
  replay_buffer_kwargs: {n_sampled_goal: 4, goal_selection_strategy: future}
  policy_kwargs: {net_arch: [8], features_extractor_class: GoalGapExtractor}
"""
SMALL_PPO = """
TPMReachDense-v0:
  n_timesteps: 256
  n_envs: 2
  policy: MultiInputPolicy
  n_steps: 64
  batch_size: 32
  n_epochs: 2
  policy_kwargs: {net_arch: [8]}
"""


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recipe that trains in a second or two."""
    path = tmp_path_factory.mktemp("recipes") / "small.yml"
    path.write_text(SMALL, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def run(small: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of SAC with hindsight."""
    path = tmp_path_factory.mktemp("runs") / "reach"
    config = TrainingConfig(
        recipe_file=small, run=path, eval_episodes=2, eval_every=150, checkpoint_every=200
    )
    assert train(config, quiet()) is None
    return path


def parameters(run: Path, name: str = "last.zip") -> dict[str, Any]:
    """Return every parameter of a saved policy: actor, critics and their targets."""
    unused = {"replay_buffer_class": None, "replay_buffer_kwargs": {}}
    return SAC.load(run / name, custom_objects=unused).policy.state_dict()


def equal(first: dict[str, Any], second: dict[str, Any]) -> bool:
    return all(torch.equal(value, second[name]) for name, value in first.items())


def test_same_seed_same_policy_whatever_is_evaluated(
    run: Path, small: Path, tmp_path: Path
) -> None:
    config = TrainingConfig(
        recipe_file=small, run=tmp_path / "again", eval_episodes=1, eval_every=1000
    )
    train(config, quiet())
    assert equal(parameters(run), parameters(tmp_path / "again"))
    train(replace(config, run=tmp_path / "other", seed=1, steps=60), quiet())
    assert not equal(parameters(run), parameters(tmp_path / "other"))


def test_learning_has_changed_the_policy(run: Path) -> None:
    before, after = (
        torch.load(run / "checkpoints" / step / "torch.pt")["parameters"]["policy"]
        for step in ("000000200", "000000400")
    )
    assert not equal(before, after)
    assert equal(after, parameters(run))


def test_a_learning_rate_falls_to_zero_if_asked_to(tmp_path: Path) -> None:
    recipe = tmp_path / "falling.yml"
    recipe.write_text(SMALL + "  learning_rate: lin_0.002\n", encoding="utf-8")
    config = TrainingConfig(
        recipe_file=recipe, run=tmp_path / "run", eval_episodes=1, eval_every=100
    )
    train(config, quiet())
    with (tmp_path / "run" / "progress.csv").open(encoding="utf-8") as file:
        logged = [row["train/learning_rate"] for row in csv.DictReader(file)]
    rates = [float(rate) for rate in logged if rate]
    assert 0.0005 < rates[0] < 0.0015  # about half way
    assert rates == sorted(rates, reverse=True)
    assert 0 <= rates[-1] <= 0.002 * 2 / 400  # an update takes two steps


def test_config_records_the_whole_run(run: Path, small: Path) -> None:
    text = (run / "config.json").read_text(encoding="utf-8")
    content = json.loads(text)
    assert (content["algo"], content["env"], content["seed"]) == ("sac", "TPMReach-v0", 0)
    assert (content["steps"], content["envs"], content["threads"]) == (400, 1, 1)
    assert (content["eval_every"], content["eval_episodes"]) == (150, 2)
    assert content["recipe"]["hindsight"] is True
    assert content["recipe"]["arguments"]["gamma"] == 0.95
    assert content["recipe"]["arguments"]["policy_kwargs"]["net_arch"] == [8]
    assert content["training_seeds"] == [0, 0]
    assert content["evaluation_seeds"] == [SELECTION_SEED, SELECTION_SEED + 1]
    assert content["versions"]["stable-baselines3"]
    assert content["machine"]["cpu_count"] == os.cpu_count()
    assert "git_commit" in content
    assert content["command"].startswith("python ")
    # Nothing about the machine it ran on beyond its kind.
    assert str(run.parent) not in text
    assert str(small.parent) not in text


def test_penalty_weight_and_goals_reach_every_environment_and_survive_resuming(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[gym.Env[Any, Any]] = []
    make = gym.make

    def remember(*args: Any, **options: Any) -> Any:
        made.append(make(*args, **options))
        return made[-1]

    monkeypatch.setattr(gym, "make", remember)
    recipe = tmp_path / "demonstrated.yml"
    text = small.read_text(encoding="utf-8") + "  demonstrations: {episodes: 1}\n"
    recipe.write_text(text, encoding="utf-8")
    folder = tmp_path / "run"
    config = TrainingConfig(
        recipe_file=recipe,
        run=folder,
        steps=110,
        eval_episodes=1,
        penalty_weight=0.0,
        goals="tempting",
    )
    train(config, quiet())
    content = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    assert (content["penalty_weight"], content["goals"]) == (0.0, "tempting")
    assert len(made) == 3  # training, evaluation, demonstrations
    resume(ResumeConfig(folder, steps=170), quiet())
    assert len(made) == 5
    for env in made:
        inner: Any = env.unwrapped
        assert inner.task.penalty_weight == 0.0
        assert inner.task.goals == "tempting"
    again = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    assert (again["penalty_weight"], again["goals"]) == (0.0, "tempting")
    # The exported policy is one for the id itself.
    results = evaluate(EvaluationConfig(policy=(str(folder),), episodes=1), quiet())
    assert results[0].records[0].length == 50


def test_runs_from_before_these_options_go_on_with_their_defaults(run: Path) -> None:
    stored = json.loads((run / "config.json").read_text(encoding="utf-8"))
    del stored["penalty_weight"], stored["goals"]
    config = resumed(ResumeConfig(run), stored, 0)
    assert (config.penalty_weight, config.goals) == (1.0, "sampled")


def test_evaluations_are_before_during_and_after_training(run: Path) -> None:
    lines = (run / "evaluations.jsonl").read_text(encoding="utf-8").splitlines()
    evaluations = [json.loads(line) for line in lines]
    assert [evaluation["steps"] for evaluation in evaluations] == [0, 150, 300, 400]
    for evaluation in evaluations:
        assert evaluation["first_seed"] == SELECTION_SEED
        success = evaluation["success_at_end"]
        assert 0 <= success["low"] <= success["mean"] <= success["high"] <= 1


def test_best_policy_is_the_one_evaluated_best(run: Path) -> None:
    lines = (run / "evaluations.jsonl").read_text(encoding="utf-8").splitlines()
    scores = [
        (entry["success_at_end"]["mean"], entry["return"]["mean"])
        for entry in map(json.loads, lines)
    ]
    assert score(run / "best.zip") == pytest.approx(max(scores))
    assert score(run / "last.zip") == pytest.approx(scores[-1])


def score(path: Path) -> tuple[float, float]:
    """Return success and return of a saved policy over the episodes that select."""
    env = gym.make("TPMReach-v0")
    records = run_episodes(env, load_policy(str(path), env, trust_pickle=True), 2, SELECTION_SEED)
    env.close()
    return (
        sum(record.success_at_end for record in records) / 2,
        sum(record.total_reward for record in records) / 2,
    )


def test_logs_hold_training_and_evaluation(run: Path) -> None:
    with (run / "progress.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {"time/total_timesteps", "train/critic_loss", "rollout/ep_rew_mean"} <= set(rows[-1])
    assert sum(row["eval/success_at_end"] != "" for row in rows) == 4
    assert list(run.glob("events.out.tfevents.*"))


def test_learning_curve_is_a_picture(run: Path) -> None:
    picture = imageio.imread(run / "learning_curve.png")
    assert picture.shape[:2] == (768, 1152)
    colours = np.unique(picture[::7, ::7].reshape(-1, picture.shape[2]), axis=0)
    assert len(colours) > 50


def test_both_policies_are_exported_and_nothing_is_unpickled_for_it(run: Path) -> None:
    for name in ("best", "last"):
        exported = tpm_gym.load_policy(run / name)
        saved = load_model(name, run / f"{name}.zip")
        batch = {
            key: np.stack([box.sample() for _ in range(8)])
            for key, box in saved.observation_space.items()
        }
        expected, _ = saved.predict(batch, deterministic=True)
        np.testing.assert_allclose(exported.act(batch), expected, atol=1e-6)
        config = json.loads((run / "config.json").read_text())
        assert exported.description.recipe == config["recipe"]
        assert exported.description.steps == saved.num_timesteps


def test_resuming_runs_no_pickle(small: Path, tmp_path: Path) -> None:
    """In a process of its own, which unpickling a policy would end."""
    config = TrainingConfig(recipe_file=small, run=tmp_path / "run", steps=150, eval_episodes=1)
    train(config, quiet())
    script = (
        "import sys; from pathlib import Path; from stable_baselines3 import SAC\n"
        "from tpm_gym.learning import ResumeConfig, resume\n"
        "SAC.load = lambda *a, **k: sys.exit('unpickled')\n"
        f"resume(ResumeConfig(Path({str(tmp_path / 'run')!r}), steps=200))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], check=False)
    assert done.returncode == 0
    assert tpm_gym.load_policy(tmp_path / "run" / "last").description.steps == 200


class StopAt(BaseCallback):
    """Sends the process a Ctrl-C at a step."""

    def _on_step(self) -> bool:
        if self.num_timesteps == 170:
            os.kill(os.getpid(), signal.SIGINT)
        return True


def test_interrupt_saves_and_leaves_cleanly(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learn = SAC.learn

    def interrupted(self: SAC, steps: int, callback: list[BaseCallback], **options: Any) -> SAC:
        return learn(self, steps, callback=[StopAt(), *callback], **options)

    monkeypatch.setattr(SAC, "learn", interrupted)
    handler = signal.getsignal(signal.SIGINT)
    config = TrainingConfig(recipe_file=small, run=tmp_path / "run", eval_episodes=1)
    assert train(config, quiet()) == signal.SIGINT
    assert (
        SAC.load(
            tmp_path / "run" / "last.zip",
            custom_objects={"replay_buffer_class": None, "replay_buffer_kwargs": {}},
        ).num_timesteps
        == 170
    )
    assert signal.getsignal(signal.SIGINT) is handler


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_command_line_trains_ppo_in_parallel_and_stops_when_asked_to(
    tmp_path: Path, number: signal.Signals, status: int
) -> None:
    """Signal the whole process group, workers included, as a terminal or a batch system does."""
    recipe = tmp_path / "ppo.yml"
    recipe.write_text(SMALL_PPO, encoding="utf-8")
    folder = tmp_path / "run"
    options = ["--algo", "ppo", "--env", "TPMReachDense-v0", "--steps", "1000000"]
    options += ["--eval-episodes", "1", "--checkpoint-every", "256"]
    process = subprocess.Popen(
        [
            sys.executable,
            str(ROOT / "train" / "train.py"),
            *options,
            "--recipe",
            str(recipe),
            "--run",
            str(folder),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 120
    while not (folder / "checkpoints" / "000000256").is_dir() and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    os.killpg(process.pid, number)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == status, errors
    assert "Traceback" not in errors
    assert f"stopped early by {number.name}, saved at step" in output
    assert f"tpm-gym resume {folder}" in output
    assert (folder / "last.zip").is_file()
    assert json.loads((folder / "config.json").read_text())["training_seeds"] == [0, 1]


PICK = {"env": "TPMPickAndPlace-v0", "recipe_file": recipe_file("sac")}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"algo": "dqn"}, "'dqn' is none of sac, tqc, ppo"),
        ({"steps": 0}, "--steps 0: must be at least 1"),
        ({"envs": 0}, "--envs 0"),
        ({"eval_every": 0}, "--eval-every 0"),
        ({"eval_episodes": 0}, "--eval-episodes 0"),
        ({"penalty_weight": -0.1}, "--penalty-weight -0.1"),
        ({"penalty_weight": float("nan")}, "--penalty-weight nan"),
        ({"seed": -1}, "held out"),
        ({"seed": SELECTION_SEED}, "held out"),
        ({"seed": SELECTION_SEED - 2, "envs": 3}, "held out"),
        ({"envs": 5}, "before the first episode ends"),
        ({**PICK, "steps": 20_000}, "more than the 20,000 of the recipe's demonst"),
        ({**PICK, "steps": 20_050, "envs": 3}, "the 20,100 of"),
        ({"algo": "ppo"}, "no recipe for TPMReach-v0"),
        ({"recipe_file": Path("none.yml")}, "cannot be read"),
    ],
)
def test_mistakes_are_named_before_anything_is_written(
    options: dict[str, Any], message: str, small: Path, tmp_path: Path
) -> None:
    if not {"algo", "recipe_file"} & set(options):
        options = {"recipe_file": small, **options}
    with pytest.raises(ConfigError, match=message):
        train(TrainingConfig(**{"run": tmp_path / "run", **options}), quiet())
    assert not (tmp_path / "run").exists()


SHIPPED = [
    (algorithm, env_id)
    for algorithm in ALGORITHMS
    for env_id in read_recipes(recipe_file(algorithm), algorithm)
]


def test_every_id_has_a_shipped_recipe_and_every_sparse_one_two() -> None:
    assert {env_id for _, env_id in SHIPPED} == set(tpm_gym.ENV_IDS)
    sparse = {env_id for env_id in tpm_gym.ENV_IDS if "Dense" not in env_id}
    for algorithm in ("sac", "tqc"):
        assert sparse <= {env_id for of, env_id in SHIPPED if of == algorithm}


@pytest.mark.parametrize(("algorithm", "env_id"), SHIPPED)
def test_shipped_recipes_are_arguments_of_the_algorithm_and_relabel_sparse_rewards(
    algorithm: str, env_id: str
) -> None:
    config = complete(TrainingConfig(algo=algorithm, env=env_id))
    recipe = config.recipe
    assert recipe.hindsight == ("Dense" not in env_id)
    if algorithm == "ppo":
        assert recipe.arguments["n_steps"] * config.envs % recipe.arguments["batch_size"] == 0
    else:  # a buffer of full size takes seconds to build
        recipe = replace(recipe, arguments={**recipe.arguments, "buffer_size": 100})
    envs: Any = gym.make(env_id)
    model: Any = make_model(replace(config, recipe=recipe), envs)
    assert model.gamma == recipe.arguments["gamma"]
    assert model.policy_kwargs["net_arch"] == recipe.arguments["policy_kwargs"]["net_arch"]
    envs.close()


def test_networks_see_the_gap_to_the_goal() -> None:
    env = gym.make("TPMPickAndPlace-v0")
    extractor = GoalGapExtractor(env.observation_space, unit=0.05)  # type: ignore[arg-type]
    observation, _ = env.reset(seed=0)
    batch = {name: torch.as_tensor(value)[None] for name, value in observation.items()}
    batch["desired_goal"] = batch["achieved_goal"] + torch.tensor([[0.05, -0.01, 0.1]])
    features = extractor(batch)
    assert features.shape == (1, extractor.features_dim)
    np.testing.assert_array_equal(features[0, :-3], observation["observation"])
    np.testing.assert_allclose(features[0, -3:], [1.0, -0.2, 2.0], atol=1e-5)
    env.close()


@pytest.mark.parametrize(
    ("before", "after", "key", "message"),
    [
        ("gamma: 0.95", "gama: 0.95", "TPMReach-v0.gama", "valid keys: batch_size, buffer_size"),
        ("gamma: 0.95", "gamma: 1.5", "TPMReach-v0.gamma", "less than or equal to 1, not 1.5"),
        ("gamma: 0.95", "gamma: 9e-1", "TPMReach-v0.gamma", "write 0.9"),
        ("batch_size: 16", "batch_size: 16.0", "TPMReach-v0.batch_size", "a valid integer"),
        ("batch_size: 16", "batch_size: true", "TPMReach-v0.batch_size", "a valid integer"),
        ("[8],", "'dict(net_arch=[8])',", "TPMReach-v0.policy_kwargs.net_arch", "list of positive"),
        (
            "{net_arch: [8], features_extractor_class: GoalGapExtractor}",
            "dict(net_arch=8)",
            "TPMReach-v0.policy_kwargs",
            "must be a valid dictionary",
        ),
        ("{net_arch:", "{net_arc:", "TPMReach-v0.policy_kwargs.net_arc", "valid keys: features_"),
        (
            ": future",
            ": past",
            "TPMReach-v0.replay_buffer_kwargs.goal_selection_strategy",
            "must be 'future', 'final' or 'episode', not 'past'",
        ),
        (
            "HerReplayBuffer",
            "os.system",
            "TPMReach-v0.replay_buffer_class",
            "must be 'HerReplayBuffer'",
        ),
        ("policy: MultiInputPolicy", "", "TPMReach-v0.policy", "is missing"),
        (
            "replay_buffer_class: HerReplayBuffer",
            "",
            "TPMReach-v0.replay_buffer_kwargs",
            "no effect",
        ),
        ("TPMReach-v0:", "- TPMReach-v0:", "", "one mapping per environment id"),
        ("gamma: 0.95", "gamma: [", "", "is not YAML"),
        ("gamma: 0.95", "learning_rate: lin_0", "TPMReach-v0.learning_rate", "lin_<start>"),
        ("gamma: 0.95", "learning_rate: lin_inf", "TPMReach-v0.learning_rate", "lin_<start>"),
        ("gamma: 0.95", "learning_rate: exp_1", "TPMReach-v0.learning_rate", "lin_<start>"),
        ("gamma: 0.95", "gamma: !!python/object/apply:os.getcwd []", "", "is not YAML"),
    ],
)
def test_recipe_mistakes_name_file_key_and_choice(
    before: str, after: str, key: str, message: str, tmp_path: Path
) -> None:
    assert before in SMALL
    path = tmp_path / "wrong.yml"
    path.write_text(SMALL.replace(before, after), encoding="utf-8")
    with pytest.raises(ConfigError, match=message) as caught:
        read_recipe(path, "sac", "TPMReach-v0")
    assert str(caught.value).startswith(f"{path}: {key}")


@pytest.mark.parametrize(
    "device", ["abacus", "cuda" if not torch.cuda.is_available() else "cuda:99x"]
)
def test_a_missing_device_is_refused_before_an_earlier_run_is_deleted(
    tmp_path: Path, device: str
) -> None:
    (tmp_path / "config.json").write_text("{}")
    (tmp_path / "last.zip").write_text("precious")
    config = TrainingConfig(
        env="TPMReach-v0", run=tmp_path, overwrite=True, device=device, steps=2000
    )
    with pytest.raises(ConfigError, match="--device"):
        train(config)
    assert (tmp_path / "last.zip").read_text() == "precious"
