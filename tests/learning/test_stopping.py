"""A training stops when asked to, outlives a full disk, and refuses to go on as another one."""

import errno
import json
import os
import shutil
import signal
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
from trainings import (
    Killed,
    assert_equal_runs,
    evaluations,
    interrupt_at,
    make_config,
    quiet,
    said,
    uninterrupted,
)

import tpm_gym
from tpm_gym.learning import ResumeConfig, callbacks, curve, export, resume, train, training
from tpm_gym.learning.callbacks import Checkpointing
from tpm_gym.learning.checkpoint import CheckpointStore
from tpm_gym.learning.errors import ConfigError, RunError
from tpm_gym.learning.run_folder import claimed
from tpm_gym.learning.signals import SignalListener

pytestmark = pytest.mark.usefixtures("no_pictures")


# -- stopped --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("case", "step", "number"),
    [("sac", 1, signal.SIGINT), ("sac", 187, signal.SIGTERM), ("ppo", 95, signal.SIGINT)],
)
def test_a_stopped_run_saves_and_goes_on(case, step, number, tmp_path, monkeypatch):
    config = replace(make_config(case, tmp_path), checkpoint_every=10_000)
    interrupt_at(monkeypatch, step, lambda: os.kill(os.getpid(), number))
    handler, console = signal.getsignal(number), quiet()
    assert train(config, console) == number
    assert signal.getsignal(number) is handler
    store = CheckpointStore(tmp_path / "run" / "checkpoints")
    content = store.load(pytest.fail)
    assert content is not None
    saved = content.step
    # At the end of a rollout, of 2 or 40 steps
    assert saved == {"sac": step + 1, "ppo": 120}[case]
    assert f"saved at step {saved}" in said(console)
    assert f"tpm-gym resume {tmp_path / 'run'}" in said(console)
    assert (tmp_path / "run" / "last.zip").is_file()
    taken = tpm_gym.load_policy(tmp_path / "run" / "last").description.steps
    assert taken == saved
    assert resume(ResumeConfig(config.run), quiet()) is None
    assert_equal_runs(uninterrupted(case), tmp_path / "run")


def test_a_signal_after_the_last_step_stops_nothing(tmp_path, monkeypatch):
    ends = callbacks.PeriodicEvaluation._on_training_end

    def interrupted(self):
        os.kill(os.getpid(), signal.SIGINT)
        ends(self)

    monkeypatch.setattr(callbacks.PeriodicEvaluation, "_on_training_end", interrupted)
    console = quiet()
    assert train(make_config("sac", tmp_path), console) is None
    assert f"finished: {tmp_path / 'run'}" in said(console)
    assert_equal_runs(uninterrupted("sac"), tmp_path / "run")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_leaves_at_once(number):
    listener = SignalListener()
    with listener.listening():
        os.kill(os.getpid(), number)
        assert listener.received == number
        with pytest.raises(SystemExit) as caught:
            signal.raise_signal(number)
    assert caught.value.code == 128 + number


def test_a_worker_that_dies_ends_the_training(tmp_path, monkeypatch):
    """Closing the environments would wait for it forever."""
    config, made = make_config("ppo in processes", tmp_path), []
    make = training.make_training_envs
    monkeypatch.setattr(training, "make_training_envs", lambda c: made.append(make(c)) or made[0])
    interrupt_at(monkeypatch, 161, lambda: made[0].processes[1].kill())
    message = f"a worker or .* has ended .*; put that right, then .*tpm-gym resume {config.run}"
    with pytest.raises(RunError, match=message):
        train(config, quiet())
    assert not any(process.is_alive() for process in made[0].processes)
    monkeypatch.undo()
    assert resume(ResumeConfig(config.run), quiet()) is None
    assert_equal_runs(uninterrupted("ppo in processes"), config.run)


NO_SPACE = os.strerror(errno.ENOSPC)

# -- full disks -----------------------------------------------------------------------------------


def test_training_goes_on_without_room_for_checkpoints(tmp_path, monkeypatch):
    save = CheckpointStore.save

    def full(self, content):
        with monkeypatch.context() as patched:
            if 150 <= content.step < 300:
                patched.setattr(os, "fsync", Mock(side_effect=OSError(errno.ENOSPC, NO_SPACE)))
            save(self, content)

    monkeypatch.setattr(CheckpointStore, "save", full)
    config, console = make_config("sac", tmp_path), quiet()
    assert train(config, console) is None
    warnings = [line for line in said(console).splitlines() if "warning:" in line]
    assert len(warnings) == 3  # at 150, 200 and 250: it is tried again
    assert all("No space left on device; that of step 100 stays" in line for line in warnings)
    assert_equal_runs(uninterrupted("sac"), tmp_path / "run")


def test_a_full_disk_ends_the_run_with_its_last_checkpoint_whole(tmp_path, monkeypatch):
    def full(*args):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    config, console = make_config("sac", tmp_path), quiet()
    interrupt_at(
        monkeypatch, 255, lambda: monkeypatch.setattr(callbacks.PeriodicEvaluation, "_record", full)
    )
    with monkeypatch.context() as patched:
        patched.setattr(
            callbacks.PeriodicEvaluation, "_record", callbacks.PeriodicEvaluation._record
        )
        with pytest.raises(RunError, match=r"from step 250 with: tpm-gym resume .*run"):
            train(config, console)
    assert resume(ResumeConfig(config.run), quiet()) is None
    assert_equal_runs(uninterrupted("sac"), tmp_path / "run")


# -- what a resumption may change, and what it may not delete --------------------------------------


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def finished(tmp_path):
    """A run that went to its end, with a test of its policy."""
    run = tmp_path / "run"
    shutil.copytree(uninterrupted("sac"), run)
    (run / "tests").mkdir()
    test = {"env": "TPMReach-v0", "episodes": 1, "command": "tpm-gym evaluate"}
    (run / "tests" / "nominal.json").write_text(json.dumps(test))
    return run


def test_fewer_steps_than_taken_and_numbers_that_cannot_work_are_refused(half):
    before = contents(half.run)
    with pytest.raises(ConfigError, match="--steps 140: the run has already taken 150"):
        resume(ResumeConfig(half.run, steps=140), quiet())
    with pytest.raises(ConfigError, match="--eval-every 0"):
        resume(ResumeConfig(half.run, eval_every=0), quiet())
    assert contents(half.run) == before


def test_a_finished_run_has_nothing_to_do_unless_it_is_to_take_more_steps(finished):
    before, console = contents(finished), quiet()
    assert resume(ResumeConfig(finished), console) is None
    assert f"nothing to do: {finished} has finished its 300 steps" in said(console)
    assert before == contents(finished)
    assert resume(ResumeConfig(finished, steps=360), quiet()) is None
    assert [line["steps"] for line in evaluations(finished)][-2:] == [300, 360]
    assert json.loads((finished / "config.json").read_text())["steps"] == 360
    assert not (finished / "tests").exists()  # they were of the policy of step 300


def test_steps_that_were_added_are_not_forgotten_by_a_kill(finished, monkeypatch):
    """Nor does the last policy of fewer steps pass for the end of the run."""
    save = export.save

    def killed_at_the_end(model, path, **options):
        if path.name == "last":
            raise Killed
        return save(model, path, **options)

    with monkeypatch.context() as patched:
        patched.setattr(export, "save", killed_at_the_end)
        patched.setattr(CheckpointStore, "save", lambda self, content: None)
        with pytest.raises(Killed):
            resume(ResumeConfig(finished, steps=360, eval_every=20), quiet())
    assert not (finished / "last.zip").exists()
    assert resume(ResumeConfig(finished), quiet()) is None
    assert [line["steps"] for line in evaluations(finished)][-4:] == [300, 320, 340, 360]
    assert tpm_gym.load_policy(finished / "last").description.steps == 360


@pytest.mark.usefixtures("needs_pybullet")
def test_a_kill_after_the_last_step_leaves_out_no_test(tmp_path, monkeypatch):
    config = make_config("ppo in the analytic engine", tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr(training, "evaluate", Mock(side_effect=Killed))
        with pytest.raises(Killed):
            train(config, quiet())
    drawn = Mock()
    monkeypatch.setattr(curve, "draw_learning_curve", drawn)
    console = quiet()
    assert resume(ResumeConfig(config.run), console) is None
    assert "success in the analytic engine and PyBullet" in said(console)
    lines = evaluations(config.run)
    best = max(lines, key=lambda line: (line["success_at_end"]["mean"], line["return"]["mean"]))
    assert f"testing the best policy, of step {best['steps']}, in 1 held-out" in said(console)
    assert [line["steps"] for line in drawn.call_args.args[2]] == [0, 141, 282, 360]
    assert {path.stem for path in config.run.glob("tests/*.json")} == {"analytic", "pybullet"}
    before, console = contents(config.run), quiet()
    assert resume(ResumeConfig(config.run), console) is None
    assert "nothing to do" in said(console)
    assert contents(config.run) == before


def test_a_finished_run_is_finished_without_its_checkpoints(finished):
    shutil.rmtree(finished / "checkpoints")
    before, console = contents(finished), quiet()
    assert resume(ResumeConfig(finished), console) is None
    assert "nothing to do" in said(console)
    with pytest.raises(RunError, match="holds a policy, but no checkpoint"):
        resume(ResumeConfig(finished, steps=360), quiet())
    assert contents(finished) == before


def test_a_policy_is_never_replaced_by_beginning_again(half):
    shutil.rmtree(half.run / "checkpoints")
    for policy in ("best.zip", "last.zip", "best.json", "last.safetensors"):
        for path in (*half.run.glob("best.*"), *half.run.glob("last.*")):
            path.unlink()
        (half.run / policy).write_text("precious")
        before = contents(half.run)
        with pytest.raises(RunError, match="holds a policy, but no checkpoint"):
            resume(ResumeConfig(half.run), quiet())
        assert contents(half.run) == before


def test_nothing_to_resume_is_an_error_that_says_so(tmp_path):
    for run in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(RunError, match="tpm-gym train"):
            resume(ResumeConfig(run), quiet())
    assert list(tmp_path.iterdir()) == []
    for text in ('{"model_type": "bert"}', "{", "[]"):  # another program's
        (tmp_path / "config.json").write_text(text)
        with pytest.raises(RunError, match="holds no run"):
            resume(ResumeConfig(tmp_path), quiet())
        assert (tmp_path / "config.json").read_text() == text


@pytest.mark.parametrize("name", ["evaluations.jsonl", "progress.csv"])
def test_a_folder_in_the_place_of_a_file_is_named(half, name):
    (half.run / name).unlink(missing_ok=True)
    (half.run / name).mkdir()
    with pytest.raises(
        RunError, match=rf"Is a directory: .*{name}.*; put that right, then continue"
    ):
        resume(ResumeConfig(half.run), quiet())


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such locks")
def test_two_processes_cannot_train_in_one_folder(half):
    before = contents(half.run)
    with claimed(half.run), pytest.raises(RunError, match="another process"):
        resume(ResumeConfig(half.run), quiet())
    with claimed(half.run), pytest.raises(RunError, match="another process"):
        train(replace(half, overwrite=True), quiet())
    assert contents(half.run) == before


def test_checkpoints_take_a_fiftieth_of_the_time_at_most(tmp_path, monkeypatch):
    """With a clock that only checkpoints (3 s) and rollouts of two steps (2 s) move."""
    clock, saved = [0.0], []

    class Clock:
        perf_counter = process_time = staticmethod(lambda: clock[0])
        time_ns = staticmethod(lambda: int(clock[0] * 1e9))

    def save(self, content):
        clock[0] += 3.0
        saved.append(content.step)

    rollout_start = Checkpointing._on_rollout_start

    def tick(self):
        clock[0] += 2.0
        rollout_start(self)

    monkeypatch.setattr(callbacks, "time", Clock)
    monkeypatch.setattr(CheckpointStore, "save", save)
    monkeypatch.setattr(Checkpointing, "_on_rollout_start", tick)
    config = replace(make_config("sac", tmp_path), checkpoint_every=None, eval_every=1000)
    train(replace(config, steps=330), quiet())
    assert saved == [0, 148, 298, 330]  # the last is the end
