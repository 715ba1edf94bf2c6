"""A training stops when asked to, outlives a full disk, and refuses to go on as another one."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from trainings import (
    assert_equal_runs,
    evaluations,
    interrupt_at,
    kill_at,
    make_config,
    quiet,
    resumed,
    said,
    uninterrupted,
)

from tpm_gym.learning import callbacks, train
from tpm_gym.learning.callbacks import Checkpointing, SignalListener
from tpm_gym.learning.checkpoint import CheckpointStore, Content
from tpm_gym.learning.configuration import Config
from tpm_gym.learning.errors import (
    CheckpointWriteError,
    ConfigError,
    NoCheckpointError,
    ResumeConflictError,
    RunBusyError,
    RunWriteError,
)
from tpm_gym.learning.run_folder import claimed


@pytest.fixture(autouse=True)
def _no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes longer than all the rest of these trainings."""
    monkeypatch.setattr(callbacks, "draw_learning_curve", lambda *args: None)


# -- stopped --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("case", "step", "number"),
    [
        ("sac", 1, signal.SIGINT),
        ("sac", 187, signal.SIGINT),
        ("tqc", 200, signal.SIGTERM),
        ("ppo", 95, signal.SIGINT),
    ],
)
def test_a_stopped_run_saves_and_goes_on(
    case: str,
    step: int,
    number: signal.Signals,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = replace(make_config(case, tmp_path), checkpoint_every=10_000)
    interrupt_at(monkeypatch, step, lambda: os.kill(os.getpid(), number))
    handler, console = signal.getsignal(number), quiet()
    assert train.train(config, console) == number
    assert signal.getsignal(number) is handler
    store = CheckpointStore(tmp_path / "run" / "checkpoints")
    saved = store.load(pytest.fail).step
    # PPO goes back to the beginning of its rollout of 40 steps, the others end theirs of 2 or 3.
    assert saved == {"sac": step + 1, "tqc": 201, "ppo": 80}[case]
    assert f"saved at step {saved}" in said(console)
    assert f"--run {tmp_path / 'run'} --resume" in said(console)
    assert (tmp_path / "run" / "last.zip").is_file()
    assert train.train(resumed(config), quiet()) is None
    assert_equal_runs(uninterrupted(case), tmp_path / "run")


@pytest.mark.parametrize("case", ["sac", "ppo"])
def test_a_signal_after_the_last_step_stops_nothing(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = callbacks.PeriodicEvaluation._on_training_end

    def interrupted(self: callbacks.PeriodicEvaluation) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        ends(self)

    monkeypatch.setattr(callbacks.PeriodicEvaluation, "_on_training_end", interrupted)
    console = quiet()
    assert train.train(make_config(case, tmp_path), console) is None
    assert f"finished: {tmp_path / 'run'}" in said(console)
    assert_equal_runs(uninterrupted(case), tmp_path / "run")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_leaves_at_once(number: signal.Signals) -> None:
    listener = SignalListener()
    with listener.listening():
        os.kill(os.getpid(), number)
        assert listener.received == number
        with pytest.raises(SystemExit) as caught:
            signal.raise_signal(number)
    assert caught.value.code == 128 + number


# -- full disks -----------------------------------------------------------------------------------


def test_training_goes_on_without_room_for_checkpoints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save = CheckpointStore.save

    def full(self: CheckpointStore, content: Content) -> None:
        if 150 <= content.step < 300:
            raise CheckpointWriteError(Path("x"), "No space left on device", self.newest)
        save(self, content)

    monkeypatch.setattr(CheckpointStore, "save", full)
    config, console = make_config("sac", tmp_path), quiet()
    assert train.train(config, console) is None
    warnings = [line for line in said(console).splitlines() if "warning:" in line]
    assert len(warnings) == 3  # at 150, 200 and 250: it is tried again
    assert all("No space left on device; that of step 100 stays" in line for line in warnings)
    assert_equal_runs(uninterrupted("sac"), tmp_path / "run")


def test_a_full_disk_ends_the_run_with_its_last_checkpoint_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*args: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    config, console = make_config("sac", tmp_path), quiet()
    interrupt_at(
        monkeypatch, 205, lambda: monkeypatch.setattr(callbacks.PeriodicEvaluation, "_record", full)
    )
    with monkeypatch.context() as patched:
        patched.setattr(
            callbacks.PeriodicEvaluation, "_record", callbacks.PeriodicEvaluation._record
        )
        with pytest.raises(RunWriteError, match=r"from step 200 with --run .* --resume"):
            train.train(config, console)
    assert train.train(resumed(config), quiet()) is None
    assert_equal_runs(uninterrupted("sac"), tmp_path / "run")


# -- options --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def half(tmp_path_factory: pytest.TempPathFactory) -> Config:
    """A run that was killed half way; not to be changed."""
    config = make_config("sac", tmp_path_factory.mktemp("half"))
    with pytest.MonkeyPatch.context() as monkeypatch:
        kill_at(monkeypatch, 160, config)
    return config


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seed": 7}, "--seed is 7, but the run to be resumed has 0"),
        ({"env": "TPMPickAndPlace-v0"}, "--env is TPMPickAndPlace-v0, .* has TPMReach-v0"),
        ({"algo": "tqc"}, "--algo is tqc, .* has sac"),
        ({"envs": 2}, "--envs is 2, .* has 1"),
        ({"eval_episodes": 3}, "--eval-episodes is 3, .* has 1"),
    ],
)
def test_options_that_contradict_the_run_are_refused(
    half: Config, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ResumeConflictError, match=message):
        train.train(replace(resumed(half), **options), quiet())


def test_a_recipe_that_contradicts_the_run_is_refused(half: Config, tmp_path: Path) -> None:
    assert half.recipe is not None
    path = tmp_path / "other.yml"
    path.write_text(half.recipe.read_text().replace("gamma: 0.95", "gamma: 0.9"))
    with pytest.raises(ResumeConflictError, match=r"gamma is 0\.9, .* has 0\.95"):
        train.train(replace(resumed(half), recipe=path), quiet())


def test_fewer_steps_than_taken_and_overwriting_are_refused(half: Config) -> None:
    with pytest.raises(ConfigError, match="--steps 140: the run has already taken 150"):
        train.train(replace(resumed(half), steps=140), quiet())
    with pytest.raises(ConfigError, match="exclude each other"):
        train.train(replace(resumed(half), overwrite=True), quiet())
    with pytest.raises(ConfigError, match="--eval-every 0"):
        train.train(replace(resumed(half), eval_every=0), quiet())


def test_options_that_agree_are_accepted(half: Config, tmp_path: Path) -> None:
    assert half.run is not None
    shutil.copytree(half.run, tmp_path / "run")
    config = replace(half, run=tmp_path / "run", resume=True, checkpoint_every=1000)
    assert train.train(config, quiet()) is None
    assert_equal_runs(uninterrupted("sac"), tmp_path / "run")


def test_a_finished_run_has_nothing_to_do_unless_it_is_to_take_more_steps(tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(uninterrupted("sac"), run)
    (run / "tests").mkdir()
    (run / "tests" / "nominal.json").write_text("{}")
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    console = quiet()
    assert train.train(Config(run=run, resume=True), console) is None
    assert f"nothing to do: {run} has finished its 300 steps" in said(console)
    assert before == {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    assert train.train(Config(run=run, resume=True, steps=360), quiet()) is None
    assert [line["steps"] for line in evaluations(run)][-2:] == [300, 360]
    assert json.loads((run / "config.json").read_text())["steps"] == 360
    assert not (run / "tests").exists()  # they were of the policy of step 300


def test_nothing_to_resume_is_an_error_that_says_so(tmp_path: Path) -> None:
    for run in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(NoCheckpointError, match="leave out --resume"):
            train.train(Config(run=run, resume=True), quiet())
    assert list(tmp_path.iterdir()) == []
    for text in ('{"model_type": "bert"}', "{", "[]"):  # another program's
        (tmp_path / "config.json").write_text(text)
        with pytest.raises(NoCheckpointError):
            train.train(Config(run=tmp_path, resume=True), quiet())
        assert (tmp_path / "config.json").read_text() == text


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such locks")
def test_two_processes_cannot_train_in_one_folder(half: Config) -> None:
    assert half.run is not None
    with claimed(half.run), pytest.raises(RunBusyError, match="another process"):
        train.train(resumed(half), quiet())
    with claimed(half.run), pytest.raises(RunBusyError, match="another process"):
        train.train(replace(half, overwrite=True), quiet())
    assert (half.run / "config.json").is_file()


def test_checkpoints_take_a_fiftieth_of_the_time_at_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a clock that only checkpoints (3 s) and rollouts of two steps (2 s) move."""
    clock, saved = [0.0], []

    class Clock:
        perf_counter = staticmethod(lambda: clock[0])
        time_ns = staticmethod(lambda: int(clock[0] * 1e9))

    def save(self: CheckpointStore, content: Content) -> None:
        clock[0] += 3.0
        saved.append(content.step)

    rollout_start = Checkpointing._on_rollout_start

    def tick(self: Checkpointing) -> None:
        clock[0] += 2.0
        rollout_start(self)

    monkeypatch.setattr(callbacks, "time", Clock)
    monkeypatch.setattr(CheckpointStore, "save", save)
    monkeypatch.setattr(Checkpointing, "_on_rollout_start", tick)
    config = replace(make_config("sac", tmp_path), checkpoint_every=None, eval_every=1000)
    train.train(replace(config, steps=330), quiet())
    assert saved == [0, 150, 300, 330]  # the last is the end
