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

import json
import signal
import sys
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import tyro
from rich.console import Console

from tpm_gym.learning import provenance
from tpm_gym.learning.checkpoint import CheckpointStore, Content
from tpm_gym.learning.configuration import Config, Plan, make_plan, resume_plan, run_folder
from tpm_gym.learning.errors import ConfigError, NoCheckpointError, PolicyError, TrainError
from tpm_gym.learning.policies import BEST_FILE, CONFIG_FILE, LAST_FILE
from tpm_gym.learning.rollout import SELECTION_SEED, GoalEnv
from tpm_gym.learning.run_folder import claimed, clear, description, disk_errors_named, prepare

CHECKPOINTS: Final = "checkpoints"


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
    prepare(plan.run, config.overwrite)
    store = CheckpointStore(plan.run / CHECKPOINTS)
    with claimed(plan.run), disk_errors_named(plan.run, store):
        provenance.write_json(plan.run / CONFIG_FILE, _description(plan))
        console.print(f"{plan.title}, {plan.steps:,} steps, in {plan.run}", markup=False)
        starts = int(plan.recipe.arguments.get("learning_starts", 0))
        if plan.steps <= starts:
            console.print(f"note: learning starts at step {starts:,}, so nothing will be learned")
        return _learn(plan, console, store, None)


def _resume(config: Config, console: Console) -> signal.Signals | None:
    """Go on from the last whole checkpoint of a run."""
    from tpm_gym.learning.training_state import restore_files

    if config.overwrite:
        raise ConfigError("--resume", "--overwrite", "exclude each other; choose one")
    run = run_folder(config)
    store = CheckpointStore(run / CHECKPOINTS)
    if not run.is_dir():
        raise NoCheckpointError(run / CHECKPOINTS)
    with claimed(run), disk_errors_named(run, store):
        content, stored = _load(run, store, console)
        step = content.step if content else 0
        plan = resume_plan(config, stored, step)
        if content and content.finished and step >= plan.steps:
            _say(console, f"nothing to do: {run} has finished its {step:,} steps")
            return None
        if content:
            restore_files(run, content)
        else:
            clear(run, but=CONFIG_FILE)
        provenance.write_json(run / CONFIG_FILE, _description_resumed(plan, stored, step))
        _say(console, f"{plan.title}, from step {step:,} to {plan.steps:,}, in {run}")
        return _learn(plan, console, store, content)


def _load(
    run: Path, store: CheckpointStore, console: Console
) -> tuple[Content | None, dict[str, Any]]:
    """Return the last whole checkpoint and the configuration of a run.

    A run that was killed before its first checkpoint has none, and begins again; what lies in the
    folder of another program is left alone.
    """
    try:
        content = store.load(lambda text: _say(console, f"warning: {text}"))
    except NoCheckpointError:
        stored = description(run)
        if stored is None:
            raise
        return None, stored
    return content, json.loads(content.files[CONFIG_FILE])


def _say(console: Console, text: str) -> None:
    """Print a line as it is, however long."""
    console.print(text, markup=False, soft_wrap=True)


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
        The signal that stopped the training, None if it went to its end; one that came too late
        to stop it does not count.
    """
    import torch

    from tpm_gym.learning.callbacks import ProgressBar, SignalListener, StopTrainingError
    from tpm_gym.learning.logger import make_logger

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
        stopped_by = None
        try:
            steps = plan.steps - model.num_timesteps
            model.learn(steps, callback=callbacks, reset_num_timesteps=content is None)
        except StopTrainingError:
            stopped_by = listener.received
        _keep(plan, console, LAST_FILE, model)
        if stopped_by is None:
            checkpointing.save_finished()
    _report(plan, console, store, stopped_by)
    return stopped_by


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
    from tpm_gym.learning.callbacks import Checkpointing, PeriodicEvaluation
    from tpm_gym.learning.training_state import restore

    evaluation = PeriodicEvaluation(
        evaluation_env,
        plan.eval_every,
        plan.eval_episodes,
        plan.run,
        plan.title,
        console,
        partial(_keep, plan, console, BEST_FILE),
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
    from tpm_gym.learning.demonstrations import Demonstrations

    return [Demonstrations(**plan.recipe.demonstrations)]


def _keep(plan: Plan, console: Console, name: str, model: Any) -> None:
    """Save a policy in the run folder, and export it."""
    from tpm_gym.learning.export import remove, save, save_archive

    archive = plan.run / name
    path = archive.with_suffix("")
    save_archive(model, archive)
    try:
        save(model, path, env_id=plan.env, seed=plan.seed, recipe=asdict(plan.recipe))
    except PolicyError as error:
        remove(path)
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
    from tpm_gym.learning.policies import algorithm_class

    arguments = dict(plan.recipe.arguments)
    policy_kwargs = dict(arguments.get("policy_kwargs", {}))
    if "features_extractor_class" in policy_kwargs:
        from tpm_gym.learning.features import GoalGapExtractor

        arguments["policy_kwargs"] = policy_kwargs | {"features_extractor_class": GoalGapExtractor}
    rate = arguments.get("learning_rate")
    if isinstance(rate, str):
        from stable_baselines3.common.utils import LinearSchedule

        arguments["learning_rate"] = LinearSchedule(float(rate.removeprefix("lin_")), 0.0, 1.0)
    if plan.recipe.hindsight:
        from tpm_gym.learning.hindsight import PenaltyHerReplayBuffer

        arguments["replay_buffer_class"] = PenaltyHerReplayBuffer
    algorithm: Any = algorithm_class(plan.algo)
    return algorithm(plan.recipe.policy, envs, seed=plan.seed, device=plan.device, **arguments)


def _make_training_envs(plan: Plan) -> Any:
    """Build the training environments, in processes of their own where there are several."""
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    from tpm_gym.learning.training_state import EpisodeRecorder

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
    from tpm_gym.learning.tempting import env_id_for  # registers the ids, tpm_gym's and its own

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
