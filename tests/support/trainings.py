"""Small trainings to be killed and stopped, and the comparison of what they end in."""

import csv
import functools
import io
import json
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console

from tpm_gym.learning import ResumeConfig, TrainingConfig, resume, train
from tpm_gym.learning.callbacks import Checkpointing
from tpm_gym.learning.checkpoint import CheckpointStore, Content
from tpm_gym.learning.configuration import EnvOptions

_FOLDERS = tempfile.TemporaryDirectory()

SAC_RECIPE = """
{env}:
  n_timesteps: 300
  policy: MultiInputPolicy
  buffer_size: 230
  learning_starts: 100
  train_freq: {train_freq}
  batch_size: 16
  learning_rate: lin_0.0003
  gamma: 0.95
  ent_coef: auto_0.1
  replay_buffer_class: HerReplayBuffer
  replay_buffer_kwargs: {{n_sampled_goal: 4, goal_selection_strategy: future}}
  policy_kwargs: {{net_arch: [8], features_extractor_class: GoalGapExtractor}}
"""
PPO_RECIPE = """
{env}:
  n_timesteps: 300
  n_envs: {envs}
  policy: MultiInputPolicy
  n_steps: 40
  batch_size: 20
  n_epochs: 2
  policy_kwargs: {{net_arch: [8]}}
"""
REACH, PICK = "TPMReachDense-v0", "TPMPickAndPlaceDense-v0"
CASES = {
    "sac": ("sac", "TPMReach-v0", SAC_RECIPE.format(env="TPMReach-v0", train_freq=2)),
    "tqc": ("tqc", "TPMPickAndPlace-v0", SAC_RECIPE.format(env="TPMPickAndPlace-v0", train_freq=3)),
    "ppo": ("ppo", REACH, PPO_RECIPE.format(env=REACH, envs=1)),
    "ppo in processes": ("ppo", REACH, PPO_RECIPE.format(env=REACH, envs=2)),
    "ppo in the analytic engine": ("ppo", PICK, PPO_RECIPE.format(env=PICK, envs=3)),
    "sac in the analytic engine": (
        "sac",
        "TPMPickAndPlace-v0",
        SAC_RECIPE.format(env="TPMPickAndPlace-v0", train_freq=2)
        + "  n_envs: 2\n  demonstrations: {episodes: 2}\n",
    ),
}


class Killed(BaseException):
    """Ends a training without a chance to save anything."""


def quiet() -> Console:
    return Console(file=io.StringIO(), width=200)


def said(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def make_config(case: str, folder: Path) -> TrainingConfig:
    """A small training of which the second half learns."""
    algo, env, text = CASES[case]
    folder.mkdir(exist_ok=True)
    recipe = folder / f"{case}.yml"
    recipe.write_text(text, encoding="utf-8")
    return TrainingConfig(
        algo=algo,
        env=env,
        recipe_file=recipe,
        run=folder / "run",
        eval_episodes=1,
        eval_every=140,
        checkpoint_every=50,
        env_options=EnvOptions(engine="analytic") if "analytic" in case else EnvOptions(),
        test_episodes=1,
    )


@functools.cache
def uninterrupted(case: str) -> Path:
    """Return a run that nothing has disturbed, not even a checkpoint; not to be changed."""
    config = replace(make_config(case, Path(_FOLDERS.name, case)), checkpoint_every=10_000)
    assert train(config, quiet()) is None
    return config.run


def interrupt_at(
    monkeypatch: pytest.MonkeyPatch, step: int, interruption: Callable[[], object]
) -> None:
    """Let something happen in the middle of a step."""
    before = Checkpointing._on_step

    def on_step(self):
        if self.num_timesteps >= step:
            monkeypatch.setattr(Checkpointing, "_on_step", before)
            interruption()
        return before(self)

    monkeypatch.setattr(Checkpointing, "_on_step", on_step)


def kill_at(
    monkeypatch: pytest.MonkeyPatch, step: int, config: TrainingConfig | ResumeConfig
) -> None:
    """Train, or resume, up to a death at a step."""

    def die():
        raise Killed

    interrupt_at(monkeypatch, step, die)
    run: Callable[..., object] = resume if isinstance(config, ResumeConfig) else train
    with pytest.raises(Killed):
        run(config, quiet())


@functools.cache
def killed_half_way() -> TrainingConfig:
    """Train up to a death at step 160; the run is not to be changed."""
    config = make_config("sac", Path(_FOLDERS.name, "half"))
    with pytest.MonkeyPatch.context() as patch:
        kill_at(patch, 160, config)
    return config


# -- comparing whole trainings --------------------------------------------------------------------


def end_of(run: Path) -> Content:
    """Return the last checkpoint of a run: everything that its next step would depend on."""
    content = CheckpointStore(run / "checkpoints").load(pytest.fail)
    assert content is not None
    assert content.finished
    return content


def without_times(value: Any) -> Any:
    """Leave out what a clock has measured."""
    clocks = ("t", "seconds", "wall_seconds", "cpu_seconds")
    if isinstance(value, dict):
        return {
            name: without_times(entry)
            for name, entry in value.items()
            if name not in clocks and not name.startswith("time/")
        }
    return [without_times(entry) for entry in value] if isinstance(value, list) else value


def state_of(content: Content) -> Any:
    return without_times(json.loads(content.files["state.json"]))


def table(run: Path) -> list[dict[str, str]]:
    """Return progress.csv without its clocks."""
    with (run / "progress.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    clocks = ("time/fps", "time/time_elapsed")
    return [{k: v for k, v in row.items() if k not in clocks} for row in rows]


def evaluations(run: Path) -> Any:
    lines = (run / "evaluations.jsonl").read_text(encoding="utf-8").splitlines()
    return without_times([json.loads(line) for line in lines])


def assert_equal_runs(first: Path, second: Path) -> None:
    """Compare two finished runs: networks, optimisers, buffer, generators, episodes and logs."""
    one, other = end_of(first), end_of(second)
    assert one.arrays.keys() == other.arrays.keys()
    for name, array in one.arrays.items():
        np.testing.assert_array_equal(array, other.arrays[name], err_msg=name)
    tensors = [torch.load(io.BytesIO(end.files["torch.pt"])) for end in (one, other)]
    torch.testing.assert_close(*tensors, rtol=0, atol=0)
    assert state_of(one) == state_of(other)
    assert table(first) == table(second)
    assert evaluations(first) == evaluations(second)
