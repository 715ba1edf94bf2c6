"""A training that was killed ends, once resumed, as if nothing had happened."""

import json
import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from processes import TPM_GYM, signalled
from sb3_contrib import TQC
from stable_baselines3 import PPO, SAC
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from trainings import (
    Killed,
    assert_equal_runs,
    end_of,
    evaluations,
    kill_at,
    make_config,
    quiet,
    said,
    table,
    uninterrupted,
)

import tpm_gym
from tpm_gym.learning import ResumeConfig, TrainingConfig, resume, train
from tpm_gym.learning.checkpoint import CheckpointStore, Content
from tpm_gym.learning.errors import CheckpointError
from tpm_gym.learning.training_state import EpisodeRecorder

pytestmark = pytest.mark.usefixtures("no_pictures")


# -- killed ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("case", "step"),
    [
        ("sac", 149),
        *[pytest.param("sac", step, marks=pytest.mark.slow) for step in (1, 50, 51, 233, 299)],
        ("tqc", 271),
        *[pytest.param("tqc", step, marks=pytest.mark.slow) for step in (60, 161)],
        ("ppo", 241),
        *[pytest.param("ppo", step, marks=pytest.mark.slow) for step in (39, 95)],
        pytest.param("ppo in processes", 201, marks=pytest.mark.slow),
        ("ppo in the analytic engine", 251),
        ("sac in the analytic engine", 251),
    ],
)
def test_a_killed_run_ends_as_if_nothing_had_happened(case, step, killed, monkeypatch):
    expected, run = uninterrupted(case), killed(step, case).run
    for kind in (SAC, TQC, PPO):
        monkeypatch.setattr(kind, "load", None)  # nothing is unpickled
    if step > 100:  # nor does it act at random again
        monkeypatch.setattr(gym.spaces.Box, "sample", None)
    assert resume(ResumeConfig(run), quiet()) is None
    assert_equal_runs(expected, run)


def test_a_run_killed_again_and_again_ends_the_same(tmp_path, monkeypatch):
    config: TrainingConfig | ResumeConfig = make_config("sac", tmp_path)
    for step in (70, 40, 120, 170, 101, 260):  # some before the step that was reached already
        kill_at(monkeypatch, step, config)
        config = ResumeConfig(config.run)
    assert resume(config, quiet()) is None
    assert_equal_runs(uninterrupted("sac"), tmp_path / "run")
    resumptions = json.loads((tmp_path / "run" / "config.json").read_text())["resumed"]
    steps = [resumption["from_step"] for resumption in resumptions]
    assert steps == sorted(steps)
    assert steps[-1] == 250


def test_a_run_killed_before_its_first_checkpoint_begins_again(tmp_path, monkeypatch):
    config = make_config("sac", tmp_path)

    def die(*args):
        raise Killed

    with monkeypatch.context() as patched:
        patched.setattr(CheckpointStore, "save", die)
        with pytest.raises(Killed):
            train(config, quiet())
    part = tmp_path / "run" / "checkpoints" / "000000000.checkpoint.tmp"
    part.parent.mkdir()
    part.write_text("")
    console = quiet()
    assert resume(ResumeConfig(config.run), console) is None
    assert "from step 0 to 300" in said(console)
    assert_equal_runs(uninterrupted("sac"), tmp_path / "run")


def test_nothing_is_counted_twice(killed):
    run = killed(290, checkpoint_every=200).run
    assert [line["steps"] for line in evaluations(run)] == [0, 140, 280]
    resume(ResumeConfig(run), quiet())
    steps = [int(row["time/total_timesteps"]) for row in table(run) if row["time/total_timesteps"]]
    assert steps == [200]  # logged every four episodes
    assert [line["steps"] for line in evaluations(run)] == [0, 140, 280, 300]
    events = EventAccumulator(str(run))
    events.Reload()
    logged = [event.step for event in events.Scalars("eval/success_at_end")]
    assert logged == [0, 140, 280, 300]


def test_torn_writes_of_logs_and_of_a_checkpoint_cost_only_time(killed):
    run = killed(290).run
    damaged = run / "checkpoints" / "000000250.checkpoint"
    os.truncate(damaged, damaged.stat().st_size - 1)
    torn = ("progress.csv", "evaluations.jsonl", "best.zip", "best.json", "config.json")
    for name in torn:
        os.truncate(run / name, (run / name).stat().st_size // 2)
    (run / "last.json").write_text('{"form')
    console = quiet()
    resume(ResumeConfig(run), console)
    assert said(console).count("warning") == 1
    assert f"warning: damaged checkpoint: {damaged}" in said(console)
    assert "from step 200 to 300" in said(console)
    tpm_gym.load_policy(run / "last.json")
    assert_equal_runs(uninterrupted("sac"), run)
    for name in ("best.zip", "best.json", "best.safetensors"):
        assert (run / name).read_bytes() == end_of(run).files[name]


def test_a_checkpoint_that_no_training_wrote_is_refused_and_changes_nothing(half):
    run = half.run
    store = CheckpointStore(run / "checkpoints")
    content = store.load(print)
    assert content is not None
    state = json.loads(content.files["state.json"])
    changes = {"counters": {}, "log": [], "seconds": "long", "statistics": [[{}], []]}
    states = [json.dumps({**state, name: value}).encode() for name, value in changes.items()]
    forged = {
        "state.json": (b"{}", b"[]", b"[" * 100_000, *states),
        "torch.pt": (b"", b"{}"),
        "config.json": (b"null", b"[" * 100_000),
        "evaluations.jsonl": (b"[\n", b"{}\n", b"\xff\n"),
        "progress.csv": (b"\xff",),
    }
    arrays = (
        {"last/observation": None},
        {"last/more": np.zeros(3)},
        {"episode_starts": np.zeros(7)},
        {"log/train/loss": np.zeros(2)},
    )
    (run / "last.zip").write_text("precious")
    before = {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()}
    for name, texts in forged.items():
        for text in texts:
            store.save(replace(content, files={**content.files, name: text}, finished=True))
            with pytest.raises(CheckpointError, match="start the run anew with --overwrite"):
                resume(ResumeConfig(run), quiet())
    for change in arrays:
        found = {k: v for k, v in {**content.arrays, **change}.items() if v is not None}
        store.save(replace(content, arrays=found, finished=True))
        with pytest.raises(CheckpointError, match="start the run anew with --overwrite"):
            resume(ResumeConfig(run), quiet())
    assert before == {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()}


# -- hindsight over the seam -----------------------------------------------------------------------


def assert_whole_episodes(content: Content) -> None:
    """Every episode that can be sampled has one goal, follows on itself, and has 50 steps at most.

    An episode that goes on as another one after resuming is what makes hindsight teach goals that
    were never reached.
    """
    rows = {name.removeprefix("buffer/"): array for name, array in content.arrays.items()}
    length, start = rows["ep_length"][:, 0], rows["ep_start"][:, 0]
    size = len(length)
    assert length.max() <= 50
    for first in {int(value) for value in start[length > 0]}:
        places = (first + np.arange(int(length[first]))) % size
        goals = rows["observations/desired_goal"][places, 0]
        assert (goals == goals[0]).all()
        after = rows["next_observations/observation"][places[:-1], 0]
        np.testing.assert_array_equal(after, rows["observations/observation"][places[1:], 0])


REPLAY = EpisodeRecorder.replay


def takes_another_course(self: EpisodeRecorder, episode: dict[str, Any]) -> Any:
    """Replay as another version of the physics might."""
    actions = [[-value for value in action] for action in episode["actions"]]
    return REPLAY(self, {**episode, "actions": actions})


@pytest.mark.parametrize("replay", [takes_another_course, lambda self, episode: None])
def test_episodes_are_whole_and_a_run_whose_episode_does_not_repeat_is_refused(
    replay, killed, monkeypatch
):
    assert_whole_episodes(end_of(uninterrupted("sac")))
    run = killed(140, checkpoint_every=130).run
    monkeypatch.setattr(EpisodeRecorder, "replay", replay)
    with pytest.raises(CheckpointError, match=r"do not repeat.*equal versions.*--overwrite"):
        resume(ResumeConfig(run), quiet())


# -- real kills -----------------------------------------------------------------------------------


def kill_beyond(run: Path, step: int, words: list[str]) -> None:
    """Start a command and kill -9 it once it has saved a step."""
    command = [*TPM_GYM, *words]
    status, output = signalled(command, lambda: newest(run) >= step, signal.SIGKILL)
    assert status == -signal.SIGKILL, output


def newest(run: Path) -> int:
    return max(CheckpointStore(run / "checkpoints").steps(), default=-1)


@pytest.mark.usefixtures("needs_pybullet")
def test_kill_9_costs_nothing(tmp_path):
    config = make_config("sac", tmp_path)
    run = tmp_path / "run"
    words = ["train", "--run", str(run), "--recipe", str(config.recipe_file)]
    words += ["--eval-episodes", "1", "--eval-every", "140", "--checkpoint-every", "1"]
    kill_beyond(run, 120, words)
    assert newest(run) < 300
    assert resume(ResumeConfig(run, checkpoint_every=1000), quiet()) is None
    assert_equal_runs(uninterrupted("sac"), run)
