"""A training that was killed or stopped ends, once resumed, as if nothing had happened."""

from __future__ import annotations

import csv
import errno
import io
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from rich.console import Console
from stable_baselines3 import SAC
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import callbacks
import train
from callbacks import Checkpointing, SignalListener
from checkpoint import CheckpointStore, Content
from errors import (
    CheckpointWriteError,
    ConfigError,
    NoCheckpointError,
    NoWholeCheckpointError,
    ResumeConflictError,
    RunBusyError,
    RunWriteError,
)
from plan import Config
from policies import load_policy
from rollout import TEST_SEED, run_episodes
from snapshot import EpisodeRecorder, restore

SCRIPT = Path(train.__file__)
SAC_RECIPE = """
{env}:
  n_timesteps: 300
  policy: MultiInputPolicy
  buffer_size: 230
  learning_starts: 100
  train_freq: {train_freq}
  batch_size: 16
  gamma: 0.95
  ent_coef: auto_0.1
  replay_buffer_class: HerReplayBuffer
  replay_buffer_kwargs: {{n_sampled_goal: 4, goal_selection_strategy: future}}
  policy_kwargs: {{net_arch: [8], features_extractor_class: GoalGapExtractor}}
"""
PPO_RECIPE = """
TPMReachDense-v0:
  n_timesteps: 300
  n_envs: {envs}
  policy: MultiInputPolicy
  n_steps: 40
  batch_size: 20
  n_epochs: 2
  policy_kwargs: {{net_arch: [8]}}
"""
CASES = {
    "sac": ("sac", "TPMReach-v0", SAC_RECIPE.format(env="TPMReach-v0", train_freq=2)),
    "tqc": (
        "tqc",
        "TPMPickAndPlace-v0",
        SAC_RECIPE.format(env="TPMPickAndPlace-v0", train_freq=3),
    ),
    "ppo": ("ppo", "TPMReachDense-v0", PPO_RECIPE.format(envs=1)),
    "ppo in processes": ("ppo", "TPMReachDense-v0", PPO_RECIPE.format(envs=2)),
}


class Killed(BaseException):
    """Ends a training without a chance to save anything."""


@pytest.fixture(autouse=True)
def _no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes longer than all the rest of these trainings."""
    monkeypatch.setattr(callbacks, "draw_learning_curve", lambda *args: None)


def quiet() -> Console:
    return Console(file=io.StringIO(), width=200)


def said(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def make_config(case: str, folder: Path) -> Config:
    """A small training of which the second half learns."""
    algo, env, text = CASES[case]
    recipe = folder / f"{case}.yml"
    recipe.write_text(text, encoding="utf-8")
    return Config(
        algo=algo,  # type: ignore[arg-type]
        env=env,
        recipe=recipe,
        run=folder / "run",
        eval_episodes=1,
        eval_every=70,
        checkpoint_every=50,
    )


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Runs by case that nothing has disturbed, not even a checkpoint."""
    done: dict[str, Path] = {}

    def run(case: str) -> Path:
        if case not in done:
            folder = tmp_path_factory.mktemp("uninterrupted")
            config = replace(make_config(case, folder), checkpoint_every=10_000)
            assert train.train(config, quiet()) is None
            done[case] = folder / "run"
        return done[case]

    return run


def interrupt_at(
    monkeypatch: pytest.MonkeyPatch, step: int, interruption: Callable[[], object]
) -> None:
    """Let something happen in the middle of a step."""
    before = Checkpointing._on_step

    def on_step(self: Checkpointing) -> bool:
        if self.num_timesteps >= step:
            monkeypatch.setattr(Checkpointing, "_on_step", before)
            interruption()
        return before(self)

    monkeypatch.setattr(Checkpointing, "_on_step", on_step)


def kill_at(monkeypatch: pytest.MonkeyPatch, step: int, config: Config) -> None:
    """Train, from a checkpoint if the configuration says so, up to a death at a step."""

    def die() -> None:
        raise Killed

    interrupt_at(monkeypatch, step, die)
    with pytest.raises(Killed):
        train.train(config, quiet())


def resumed(config: Config) -> Config:
    return Config(run=config.run, resume=True)


# -- comparing whole trainings --------------------------------------------------------------------


def end_of(run: Path) -> Content:
    """Return the last checkpoint of a run: everything that its next step would depend on."""
    content = CheckpointStore(run / "checkpoints").load(pytest.fail)
    assert content.finished
    return content


def without_times(value: Any) -> Any:
    """Leave out what a clock has measured."""
    clocks = ("t", "seconds", "wall_seconds")
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
    """Return progress.csv without its clocks and without PPO's count of iterations a process."""
    with (run / "progress.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    unequal = ("time/fps", "time/time_elapsed", "time/iterations")
    return [{k: v for k, v in row.items() if k not in unequal} for row in rows]


def evaluations(run: Path) -> Any:
    lines = (run / "evaluations.jsonl").read_text(encoding="utf-8").splitlines()
    return without_times([json.loads(line) for line in lines])


def assert_equal_tensors(first: Any, second: Any) -> None:
    assert type(first) is type(second)
    if isinstance(first, torch.Tensor):
        assert torch.equal(first, second)
    elif isinstance(first, Mapping):
        assert first.keys() == second.keys()
        for name in first:
            assert_equal_tensors(first[name], second[name])
    elif isinstance(first, list | tuple):
        for one, other in zip(first, second, strict=True):
            assert_equal_tensors(one, other)
    else:
        assert first == second


def assert_equal_runs(first: Path, second: Path) -> None:
    """Compare two finished runs: networks, optimisers, buffer, generators, episodes and logs."""
    one, other = end_of(first), end_of(second)
    assert one.arrays.keys() == other.arrays.keys()
    for name, array in one.arrays.items():
        np.testing.assert_array_equal(array, other.arrays[name], err_msg=name)
    tensors = [torch.load(io.BytesIO(end.files["torch.pt"])) for end in (one, other)]
    assert_equal_tensors(*tensors)
    assert state_of(one) == state_of(other)
    assert table(first) == table(second)
    assert evaluations(first) == evaluations(second)


# -- killed ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("case", "step"),
    [
        *[("sac", step) for step in (51, 149, 233)],
        *[pytest.param("sac", step, marks=pytest.mark.slow) for step in (1, 50, 99, 201, 299)],
        ("tqc", 271),
        *[pytest.param("tqc", step, marks=pytest.mark.slow) for step in (60, 161)],
        ("ppo", 241),
        *[pytest.param("ppo", step, marks=pytest.mark.slow) for step in (39, 95)],
        ("ppo in processes", 201),
    ],
)
def test_a_killed_run_ends_as_if_nothing_had_happened(
    case: str,
    step: int,
    uninterrupted: Callable[[str], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = make_config(case, tmp_path)
    kill_at(monkeypatch, step, config)
    assert train.train(resumed(config), quiet()) is None
    assert_equal_runs(uninterrupted(case), tmp_path / "run")


def test_a_run_killed_again_and_again_ends_the_same(
    uninterrupted: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = make_config("sac", tmp_path)
    for step in (70, 40, 120, 170, 101, 260):  # some before the step that was reached already
        kill_at(monkeypatch, step, config)
        config = resumed(config)
    assert train.train(config, quiet()) is None
    assert_equal_runs(uninterrupted("sac"), tmp_path / "run")
    resumptions = json.loads((tmp_path / "run" / "config.json").read_text())["resumed"]
    steps = [resumption["from_step"] for resumption in resumptions]
    assert steps == sorted(steps)
    assert steps[-1] == 250


def test_nothing_is_counted_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = replace(make_config("sac", tmp_path), checkpoint_every=200)
    kill_at(monkeypatch, 290, config)
    run = tmp_path / "run"
    assert [line["steps"] for line in evaluations(run)] == [0, 70, 140, 210, 280]
    train.train(resumed(config), quiet())
    steps = [int(row["time/total_timesteps"]) for row in table(run) if row["time/total_timesteps"]]
    assert steps == [200]  # logged every four episodes
    assert [line["steps"] for line in evaluations(run)] == [0, 70, 140, 210, 280, 300]
    events = EventAccumulator(str(run))
    events.Reload()
    logged = [event.step for event in events.Scalars("eval/success_at_end")]
    assert logged == [0, 70, 140, 210, 280, 300]


def test_logs_of_a_torn_write_are_put_right(
    uninterrupted: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = make_config("sac", tmp_path)
    kill_at(monkeypatch, 240, config)
    run = tmp_path / "run"
    for name in ("progress.csv", "evaluations.jsonl", "best.zip", "config.json"):
        os.truncate(run / name, (run / name).stat().st_size // 2)
    train.train(resumed(config), quiet())
    assert_equal_runs(uninterrupted("sac"), run)
    assert (run / "best.zip").read_bytes() == end_of(run).files["best.zip"]


def test_a_damaged_checkpoint_costs_only_time(
    uninterrupted: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = make_config("sac", tmp_path)
    kill_at(monkeypatch, 240, config)
    damaged = tmp_path / "run" / "checkpoints" / "000000200" / "arrays.npz"
    os.truncate(damaged, damaged.stat().st_size - 1)
    console = quiet()
    train.train(resumed(config), console)
    assert f"warning: damaged checkpoint: {damaged}" in said(console)
    assert "from step 150 to 300" in said(console)
    assert_equal_runs(uninterrupted("sac"), tmp_path / "run")


def test_all_checkpoints_damaged_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = make_config("sac", tmp_path)
    kill_at(monkeypatch, 120, config)
    for path in (tmp_path / "run" / "checkpoints").glob("*/torch.pt"):
        path.write_bytes(b"")
    with pytest.raises(NoWholeCheckpointError, match=r"torch\.pt"):
        train.train(resumed(config), quiet())


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


def fails(self: EpisodeRecorder, episode: dict[str, Any]) -> Any:
    return None


@pytest.mark.parametrize("replay", [takes_another_course, fails])
def test_an_episode_that_cannot_go_on_is_ended_and_not_joined_to_another(
    replay: Callable[..., Any],
    uninterrupted: Callable[[str], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert_whole_episodes(end_of(uninterrupted("sac")))
    config = replace(make_config("sac", tmp_path), checkpoint_every=130)
    kill_at(monkeypatch, 140, config)
    monkeypatch.setattr(EpisodeRecorder, "replay", replay)
    config, console = replace(resumed(config), steps=220), quiet()
    train.train(config, console)
    assert "could not be repeated exactly, so new ones begin" in said(console)
    end = end_of(tmp_path / "run")
    assert_whole_episodes(end)
    last = 129  # of the third episode, 100 to 129 is what there was
    assert end.arrays["buffer/ep_length"][last, 0] == 30
    assert end.arrays["buffer/timeouts"][last, 0] == 1


def test_resuming_does_not_act_at_random_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = make_config("sac", tmp_path)
    kill_at(monkeypatch, 180, config)
    random_actions = []
    sample = gym.spaces.Box.sample

    def counted(self: gym.spaces.Box, *args: Any, **kwargs: Any) -> Any:
        random_actions.append(1)
        return sample(self, *args, **kwargs)

    monkeypatch.setattr(gym.spaces.Box, "sample", counted)
    train.train(resumed(config), quiet())
    assert not random_actions


def test_saving_changes_nothing_and_the_optimiser_moves_what_was_restored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An optimiser that holds other tensors than the networks would train nothing."""
    config = make_config("sac", tmp_path)
    kill_at(monkeypatch, 260, config)
    content = CheckpointStore(tmp_path / "run" / "checkpoints").load(pytest.fail)
    plan = train.make_plan(replace(config, run=tmp_path / "other"))
    envs = train._make_training_envs(plan)
    model = train._make_model(plan, envs)
    model.set_logger(train_logger(tmp_path))
    restore(model, content)
    assert isinstance(model, SAC)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    entropy = model.log_ent_coef.item()
    model.train(3, 16)
    moved = [
        name for name, value in model.policy.state_dict().items() if (value != before[name]).any()
    ]
    assert len(moved) == len(before)
    assert model.log_ent_coef.item() != entropy
    model.logger.close()
    envs.close()


def train_logger(folder: Path) -> Any:
    from logs import make_logger

    (folder / "log").mkdir()
    return make_logger(folder / "log")


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
    uninterrupted: Callable[[str], Path],
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
    uninterrupted: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
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
    uninterrupted: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
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


def test_options_that_agree_are_accepted(
    half: Config, uninterrupted: Callable[[str], Path], tmp_path: Path
) -> None:
    assert half.run is not None
    shutil.copytree(half.run, tmp_path / "run")
    config = replace(half, run=tmp_path / "run", resume=True, checkpoint_every=1000)
    assert train.train(config, quiet()) is None
    assert_equal_runs(uninterrupted("sac"), tmp_path / "run")


def test_a_finished_run_has_nothing_to_do_unless_it_is_to_take_more_steps(
    uninterrupted: Callable[[str], Path], tmp_path: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(uninterrupted("sac"), run)
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    console = quiet()
    assert train.train(Config(run=run, resume=True), console) is None
    assert f"nothing to do: {run} has finished its 300 steps" in said(console)
    assert before == {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    assert train.train(Config(run=run, resume=True, steps=360), quiet()) is None
    assert [line["steps"] for line in evaluations(run)][-2:] == [300, 360]
    assert json.loads((run / "config.json").read_text())["steps"] == 360


def test_nothing_to_resume_is_an_error_that_says_so(tmp_path: Path) -> None:
    for run in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(NoCheckpointError, match="leave out --resume"):
            train.train(Config(run=run, resume=True), quiet())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such locks")
def test_two_processes_cannot_train_in_one_folder(half: Config) -> None:
    assert half.run is not None
    with train._claimed(half.run), pytest.raises(RunBusyError, match="another process"):
        train.train(resumed(half), quiet())
    with train._claimed(half.run), pytest.raises(RunBusyError, match="another process"):
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


# -- real kills -----------------------------------------------------------------------------------


def kill_beyond(run: Path, step: int, arguments: list[str], delay: float = 0.0) -> int:
    """Start train.py and kill -9 it once it has saved a step; return its exit status."""
    process = subprocess.Popen(
        [sys.executable, str(SCRIPT), "--run", str(run), *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    assert process.stdout is not None
    process.stdout.readline()  # so that the imports are done
    while process.poll() is None and newest(run) < step:
        time.sleep(0.001)
    time.sleep(delay)
    process.kill()
    process.communicate()
    return process.returncode


def newest(run: Path) -> int:
    names = [path.name for path in run.glob("checkpoints/*")]
    return max((int(name) for name in names if name.isdigit()), default=-1)


def test_kill_9_costs_nothing(uninterrupted: Callable[[str], Path], tmp_path: Path) -> None:
    config = make_config("sac", tmp_path)
    run = tmp_path / "run"
    arguments = ["--recipe", str(config.recipe), "--eval-episodes", "1", "--eval-every", "70"]
    arguments += ["--checkpoint-every", "1"]
    assert kill_beyond(run, 120, arguments) == -signal.SIGKILL
    assert CheckpointStore(run / "checkpoints").load(pytest.fail).step < 300
    assert train.train(Config(run=run, resume=True, checkpoint_every=1000), quiet()) is None
    assert_equal_runs(uninterrupted("sac"), run)


def success(run: Path, episodes: int) -> float:
    """Return the success rate of the last policy on the seeds that evaluate.py uses."""
    env = gym.make("TPMReach-v0")
    policy = load_policy(str(run / "last.zip"), env, trust_pickle=True)
    records = run_episodes(env, policy, episodes, TEST_SEED)
    env.close()
    return sum(record.success_at_end for record in records) / episodes


@pytest.mark.slow
def test_ten_kills_at_random_moments_change_nothing(tmp_path: Path) -> None:
    arguments = ["--eval-episodes", "5", "--checkpoint-every", "100"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    command = [sys.executable, str(SCRIPT), "--run"]
    subprocess.run([*command, str(whole), *arguments], check=True, capture_output=True)
    draw = random.Random(0)
    for step in sorted(draw.sample(range(4500), 10)):  # of 5000
        status = kill_beyond(killed, step, arguments, delay=draw.uniform(0.0, 1.0))
        assert status == -signal.SIGKILL
        arguments = ["--resume"]
    subprocess.run([*command, str(killed), "--resume"], check=True, capture_output=True)
    resumptions = json.loads((killed / "config.json").read_text())["resumed"]
    assert len(resumptions) > 5  # those between the same two checkpoints count once
    assert_equal_runs(whole, killed)
    assert success(killed, 100) == success(whole, 100)
    assert success(killed, 100) > 0.9
