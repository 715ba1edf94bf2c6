"""Train a policy with Stable-Baselines3 and leave everything about the run in one folder.

    python train/train.py --env TPMReach-v0 --algo sac --seed 0

The run folder holds ``config.json`` (the full configuration, versions and seeds), ``progress.csv``
and TensorBoard events, ``evaluations.jsonl`` and ``learning_curve.png``, ``checkpoints/``,
``best.zip`` (the policy with the best periodic evaluation) and ``last.zip``, and both exported as
safetensors. A run that was stopped or killed goes on from its last checkpoint with

    python train/train.py --run runs/TPMReach-v0-sac-s0 --resume

Ctrl-C saves a checkpoint and stops; a second one leaves at once.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import tyro
from rich.console import Console

import provenance
from checkpoint import CheckpointStore, Content
from errors import (
    ConfigError,
    NoCheckpointError,
    NotARunError,
    PolicyError,
    RunBusyError,
    RunExistsError,
    RunWriteError,
    TrainError,
)
from plan import Config, Plan, make_plan, resume_plan, run_folder
from policies import CONFIG_FILE, LAST_FILE
from rollout import SELECTION_SEED, GoalEnv

CHECKPOINTS: Final = "checkpoints"

_DISK_ERRORS: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)


def train(config: Config, console: Console | None = None) -> signal.Signals | None:
    """Train as configured and leave the run folder.

    Args:
        config: The configuration.
        console: Where progress is shown; by default the standard output.

    Returns:
        None when training went to its end; the signal that stopped it (Ctrl-C or SIGTERM), with a
        checkpoint saved.

    Raises:
        TrainError: The configuration is not valid, the run folder is taken or cannot be written,
            or there is no whole checkpoint to resume from.
    """
    console = console or Console()
    if config.resume:
        return _resume(config, console)
    plan = make_plan(config)
    _prepare_folder(plan.run, config.overwrite)
    store = CheckpointStore(plan.run / CHECKPOINTS)
    with _claimed(plan.run), _disk_errors_named(plan.run, store):
        provenance.write_json(plan.run / CONFIG_FILE, _description(plan))
        console.print(f"{plan.title}, {plan.steps:,} steps, in {plan.run}", markup=False)
        starts = int(plan.recipe.arguments.get("learning_starts", 0))
        if plan.steps <= starts:
            console.print(f"note: learning starts at step {starts:,}, so nothing will be learned")
        return _learn(plan, console, store, None)


def _resume(config: Config, console: Console) -> signal.Signals | None:
    """Go on from the last whole checkpoint of a run."""
    from export import remove_exports
    from snapshot import restore_files

    if config.overwrite:
        raise ConfigError("--resume", "--overwrite", "exclude each other; choose one")
    run = run_folder(config)
    store = CheckpointStore(run / CHECKPOINTS)
    if not run.is_dir():
        raise NoCheckpointError(run / CHECKPOINTS)
    with _claimed(run), _disk_errors_named(run, store):
        content = store.load(lambda text: _say(console, f"warning: {text}"))
        stored = json.loads(content.files[CONFIG_FILE])
        plan = resume_plan(config, stored, content.step)
        if content.finished and content.step >= plan.steps:
            _say(console, f"nothing to do: {run} has finished its {content.step:,} steps")
            return None
        restore_files(run, content)
        remove_exports(run)
        provenance.write_json(run / CONFIG_FILE, _description_resumed(plan, stored, content.step))
        _say(console, f"{plan.title}, from step {content.step:,} to {plan.steps:,}, in {run}")
        return _learn(plan, console, store, content)


def _say(console: Console, text: str) -> None:
    """Print a line as it is, however long."""
    console.print(text, markup=False, soft_wrap=True)


@contextmanager
def _claimed(run: Path) -> Iterator[None]:
    """Keep other processes out of a run; the system ends this however the process ends."""
    if sys.platform == "win32":
        yield
        return
    import fcntl

    handle = os.open(run, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RunBusyError(run) from error
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(handle)


@contextmanager
def _disk_errors_named(run: Path, store: CheckpointStore) -> Iterator[None]:
    """Turn the errors of a full or broken disk into one that says how to go on.

    Training without its logs would be of no use, so it ends; only a checkpoint may fail.
    """
    before = threading.excepthook

    def hook(failed: threading.ExceptHookArgs) -> None:
        # TensorBoard's thread fails as well, and its traceback would bury the error's one line.
        if not _is_disk_error(failed.exc_value):
            before(failed)

    threading.excepthook = hook
    try:
        yield
    except OSError as error:
        if not _is_disk_error(error):
            raise
        raise RunWriteError(run, error.strerror or str(error), store.newest) from error
    finally:
        threading.excepthook = before


def _is_disk_error(error: BaseException | None) -> bool:
    return isinstance(error, OSError) and error.errno in _DISK_ERRORS


def _prepare_folder(run: Path, overwrite: bool) -> None:
    """Make the run folder, empty."""
    if run.exists() and (not run.is_dir() or any(run.iterdir())):
        if not overwrite:
            raise RunExistsError(run)
        # Deleting is for folders that this script has written, whatever --run was set to.
        if not (run / CONFIG_FILE).is_file():
            raise NotARunError(run, CONFIG_FILE)
        with _claimed(run):
            pass
        shutil.rmtree(run)
    run.mkdir(parents=True, exist_ok=True)


def _description(plan: Plan) -> dict[str, Any]:
    """Return what config.json records."""
    return {
        # Folders outside the run say nothing about it; names do.
        **asdict(replace(plan, run=Path(plan.run.name), recipe_file=Path(plan.recipe_file.name))),
        "run": plan.run.name,
        "recipe_file": plan.recipe_file.name,
        "training_seeds": [plan.seed, plan.seed + plan.envs - 1],
        "evaluation_seeds": [SELECTION_SEED, SELECTION_SEED + plan.eval_episodes - 1],
        "versions": provenance.versions(),
        "git_commit": provenance.git_commit(),
        "machine": provenance.machine(),
        "command": provenance.command_line(),
    }


def _description_resumed(plan: Plan, stored: dict[str, Any], step: int) -> dict[str, Any]:
    """Return what config.json records of a resumed run: its beginning, and every resumption."""
    now = _description(plan)
    changeable = ("steps", "eval_every", "checkpoint_every", "threads", "device")
    about = ("versions", "git_commit", "machine", "command")
    resumed = {"from_step": step, **{name: now[name] for name in about}}
    return {
        **stored,
        **{name: now[name] for name in changeable},
        "resumed": [*stored.get("resumed", []), resumed],
    }


def _learn(
    plan: Plan, console: Console, store: CheckpointStore, content: Content | None
) -> signal.Signals | None:
    """Build everything, learn from the beginning or from a checkpoint, and save.

    Returns:
        The signal that stopped the training, None if it went to its end.
    """
    import torch

    from callbacks import ProgressBar, SignalListener, StopTrainingError, save_model
    from logs import make_logger

    torch.set_num_threads(plan.threads)
    bar, listener = ProgressBar(console), SignalListener()
    with ExitStack() as stack:
        training_envs = _make_training_envs(plan)
        stack.callback(training_envs.close)
        evaluation_env = make_env(**_env_options(plan))
        stack.callback(evaluation_env.close)
        stack.callback(bar.close)
        model = _make_model(plan, training_envs)
        logger = make_logger(plan.run, None if content is None else content.step)
        stack.callback(logger.close)
        model.set_logger(logger)
        evaluation, checkpointing = _make_callbacks(
            plan, console, store, content, model, evaluation_env, listener
        )
        # Checkpointing sets the clock of those after it.
        callbacks = [checkpointing, *_demonstrations(plan), bar, evaluation]
        stack.enter_context(listener.listening())
        try:
            steps = plan.steps - model.num_timesteps
            model.learn(steps, callback=callbacks, reset_num_timesteps=content is None)
        except StopTrainingError:
            pass
        save_model(model, plan.run / LAST_FILE)
        _export(plan.run, console)
        if listener.received is None:
            checkpointing.save_finished()
    _report(plan, console, store, listener.received)
    return listener.received


def _make_callbacks(
    plan: Plan,
    console: Console,
    store: CheckpointStore,
    content: Content | None,
    model: Any,
    evaluation_env: GoalEnv,
    listener: Any,
) -> tuple[Any, Any]:
    """Build evaluation and checkpointing; put everything back if there is a checkpoint."""
    from callbacks import Checkpointing, PeriodicEvaluation
    from snapshot import restore

    evaluation = PeriodicEvaluation(
        evaluation_env, plan.eval_every, plan.eval_episodes, plan.run, plan.title, console
    )
    seconds = 0.0
    if content is not None:
        extra, notes = restore(model, content)
        evaluation.restore(extra["evaluation"])
        seconds = extra["seconds"]
        for note in notes:
            _say(console, f"note: {note}; the run goes on, but not exactly as it would have")
    checkpointing = Checkpointing(
        store, evaluation, listener, plan.checkpoint_every, plan.run, console, seconds
    )
    return evaluation, checkpointing


def _demonstrations(plan: Plan) -> list[Any]:
    """What fills the replay buffer before training starts, if the recipe asks for it."""
    if not plan.recipe.demonstrations:
        return []
    from demonstrations import Demonstrations

    return [Demonstrations(**plan.recipe.demonstrations)]


def _export(run: Path, console: Console) -> None:
    """Export the policies of a run that has ended or was stopped."""
    from export import export_run

    try:
        export_run(run)
    except PolicyError as error:
        _say(console, f"warning: not exported: {error}")


def _report(
    plan: Plan, console: Console, store: CheckpointStore, received: signal.Signals | None
) -> None:
    """Say in one line how the training ended, and how it can go on."""
    if received is None:
        _say(console, f"finished: {plan.run}")
    elif store.newest is None:
        _say(console, f"stopped early by {received.name}, without a checkpoint: {plan.run}")
    else:
        _say(
            console,
            f"stopped early by {received.name}, saved at step {store.newest:,}; continue with: "
            f"python train/train.py --run {plan.run} --resume",
        )


def _make_model(plan: Plan, envs: Any) -> Any:
    """Build the algorithm of a plan."""
    from policies import algorithm_class

    arguments = dict(plan.recipe.arguments)
    policy_kwargs = dict(arguments.get("policy_kwargs", {}))
    if "features_extractor_class" in policy_kwargs:
        from features import GoalGapExtractor

        arguments["policy_kwargs"] = policy_kwargs | {"features_extractor_class": GoalGapExtractor}
    rate = arguments.get("learning_rate")
    if isinstance(rate, str):
        from stable_baselines3.common.utils import LinearSchedule

        arguments["learning_rate"] = LinearSchedule(float(rate.removeprefix("lin_")), 0.0, 1.0)
    if plan.recipe.hindsight:
        from her import PenaltyHerReplayBuffer

        arguments["replay_buffer_class"] = PenaltyHerReplayBuffer
    algorithm: Any = algorithm_class(plan.algo)
    return algorithm(plan.recipe.policy, envs, seed=plan.seed, device=plan.device, **arguments)


def _make_training_envs(plan: Plan) -> Any:
    """Build the training environments, in processes of their own where there are several."""
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    from snapshot import EpisodeRecorder

    several = plan.envs > 1
    return make_vec_env(
        make_env,
        n_envs=plan.envs,
        seed=plan.seed,
        wrapper_class=EpisodeRecorder,
        env_kwargs={**_env_options(plan), "in_worker": several},
        vec_env_cls=SubprocVecEnv if several else DummyVecEnv,
    )


def _env_options(plan: Plan) -> dict[str, Any]:
    """Which environment a plan trains and evaluates in, as arguments of :func:`make_env`."""
    return {"env_id": plan.env, "penalty_weight": plan.penalty_weight, "goals": plan.goals}


def make_env(
    env_id: str, in_worker: bool = False, penalty_weight: float = 1.0, goals: str = "sampled"
) -> GoalEnv:
    """Make an environment of tpm_gym.

    Args:
        env_id: The registered id.
        in_worker: Whether this runs in a process of its own, which has to outlive the signal that
            a terminal or a batch system sends to all processes, until the main one has saved.
        penalty_weight: Weight of the singularity penalty.
        goals: ``sampled`` or ``tempting``.
    """
    from tempting import env_id_for  # registers the ids, tpm_gym's and its own

    if in_worker:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
    return gym.make(env_id_for(env_id, goals), penalty_weight=penalty_weight)


def main() -> None:
    """Run the command line."""
    from tpm_gym import TPMError

    config = tyro.cli(Config, description=__doc__)
    try:
        received = train(config)
    except (TrainError, TPMError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)
    if received is not None:
        sys.exit(128 + received)


if __name__ == "__main__":
    main()
