"""Train a policy with Stable-Baselines3 and leave everything about the run in one folder.

The run folder holds ``config.json`` (the full configuration, versions and seeds), ``progress.csv``
and TensorBoard events, ``evaluations.jsonl`` and ``learning_curve.png``, ``checkpoints/``,
``best.zip`` (the policy with the best periodic evaluation) and ``last.zip``, and both exported as
safetensors. A run that was stopped or killed goes on from its last checkpoint. Ctrl-C saves a
checkpoint and stops; a second one leaves at once.
"""

from __future__ import annotations

import json
import signal
from contextlib import ExitStack, closing
from dataclasses import asdict, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import flatdim
from rich.console import Console

from tpm_gym.learning import provenance, run_folder
from tpm_gym.learning.algorithms import ALGORITHMS
from tpm_gym.learning.checkpoint import CheckpointStore, Content
from tpm_gym.learning.configuration import (
    UNSET,
    ResumeConfig,
    TrainingConfig,
    complete,
    resumed,
)
from tpm_gym.learning.environments import check_env_id, make_env, make_envs
from tpm_gym.learning.errors import ConfigError, PolicyError, RunError
from tpm_gym.learning.estimates import Estimate
from tpm_gym.learning.evaluation import EvaluationConfig, evaluate
from tpm_gym.learning.rollout import BATCH, SELECTION_SEED, GoalEnv
from tpm_gym.learning.run_folder import CHECKPOINTS, CONFIG_FILE, TESTS, is_finished

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import VecEnv

    from tpm_gym.envs.vector import TPMVectorEnv
    from tpm_gym.learning.callbacks import PeriodicEvaluation


def train(config: TrainingConfig, console: Console | None = None) -> signal.Signals | None:
    """Train as configured and leave the run folder; progress is shown on ``console``.

    Returns:
        None when training went to its end; the signal that stopped it (Ctrl-C or SIGTERM), with a
        checkpoint saved.

    Raises:
        LearningError: The configuration is not valid, or the run folder is taken or not writable.
        ConfigurationError: There is no such environment.
    """
    console = console or Console()
    config = complete(config)
    with closing(make_env(**_env_options(config))) as env:  # refused before anything is deleted
        _require_room(config, flatdim(env.observation_space))
    run_folder.prepare(config.run, config.overwrite)
    store = CheckpointStore(config.run / CHECKPOINTS)
    with run_folder.disk_errors_named(config.run, store), run_folder.claimed(config.run):
        provenance.write_json(config.run / CONFIG_FILE, _description(config))
        console.print(f"{config.title}, {config.steps:,} steps, in {config.run}", markup=False)
        starts = int(config.recipe.arguments.get("learning_starts", 0))
        if config.steps <= starts:
            console.print(f"note: learning starts at step {starts:,}, so nothing will be learned")
        return _learn_and_test(config, console, store, None)


def resume(config: ResumeConfig, console: Console | None = None) -> signal.Signals | None:
    """Go on with a run from its last whole checkpoint.

    One that was killed before its first checkpoint begins again; one that is finished stays as it
    is, unless it is to take more steps. What is returned is as for :func:`train`.

    Raises:
        LearningError: There is no such run, no whole checkpoint to resume it from although there is
            a policy that beginning again would replace, or a change is not valid.
    """
    from tpm_gym.learning.training_state import restore_files

    console = console or Console()
    run = config.run
    store = CheckpointStore(run / CHECKPOINTS)
    if not run.is_dir():
        raise RunError(f"there is no folder {run}; start a run with tpm-gym train")
    with run_folder.disk_errors_named(run, store), run_folder.claimed(run):
        stored = run_folder.description(run)
        if stored is not None and is_finished(run) and config.steps in (UNSET, stored["steps"]):
            resumed(config, stored, 0)  # to check it
            _say(console, f"nothing to do: {run} has finished its {stored['steps']:,} steps")
            return None
        content = store.load(lambda text: _say(console, f"warning: {text}"))
        if content:
            stored = json.loads(content.files[CONFIG_FILE])
        elif stored is None:
            raise RunError(f"{run} holds no run of tpm_gym; start one with tpm-gym train")
        elif run_folder.holds_policy(run):
            raise RunError(
                f"{run} holds a policy, but no checkpoint to go on from, and beginning again would "
                "replace it; train into another --run, or here with tpm-gym train --overwrite"
            )
        step = content.step if content else 0
        changed = resumed(config, stored, step)
        description = _description_resumed(changed, stored, step)
        if content:
            restore_files(run, content)
        else:
            run_folder.clear(run)
        provenance.write_json(run / CONFIG_FILE, description)
        _say(console, f"{changed.title}, from step {step:,} to {changed.steps:,}, in {run}")
        return _learn_and_test(changed, console, store, content)


def _say(console: Console, text: str) -> None:
    console.print(text, markup=False, soft_wrap=True)


def _description(config: TrainingConfig) -> dict[str, Any]:
    return {
        **config.record(),
        "training_seeds": [config.seed, config.seed + config.envs - 1],
        "evaluation_seeds": [SELECTION_SEED, SELECTION_SEED + config.eval_episodes - 1],
        **provenance.origin(),
    }


def _description_resumed(
    config: TrainingConfig, stored: dict[str, Any], step: int
) -> dict[str, Any]:
    resumption = {"from_step": step, **provenance.origin()}
    changeable = [field.name for field in fields(ResumeConfig) if field.name != "run"]
    return {
        **stored,
        **{name: getattr(config, name) for name in changeable},
        "resumed": [*stored.get("resumed", []), resumption],
    }


def _learn_and_test(
    config: TrainingConfig, console: Console, store: CheckpointStore, content: Content | None
) -> signal.Signals | None:
    """Learn; then test what was learned in closed form in PyBullet too."""
    stopped_by = _learn(config, console, store, content)
    if stopped_by is None and config.in_batches and config.test_episodes:
        rates = [_test(config, engine) for engine in ("analytic", "pybullet")]
        told = ", ".join(f"{rate.mean:.1%} [{rate.low:.1%}, {rate.high:.1%}]" for rate in rates)
        _say(console, f"success in closed form and in PyBullet, held-out episodes: {told}")
    return stopped_by


def _test(config: TrainingConfig, engine: str) -> Estimate:
    """Success of the best policy in an engine, of which the run keeps the test."""
    (result,) = evaluate(
        EvaluationConfig(
            policy=(str(config.run),),
            env=config.env,
            episodes=config.test_episodes,
            goals=config.goals,
            penalty_weight=config.penalty_weight,
            env_options=replace(config.env_options, engine=engine),
            json=config.run / TESTS / f"{engine}.json",
        ),
        Console(quiet=True),
    )
    return result.metrics["success_at_end"]


def _learn(
    config: TrainingConfig, console: Console, store: CheckpointStore, content: Content | None
) -> signal.Signals | None:
    """Build everything, learn from the beginning or from a checkpoint, and save.

    A signal that came too late to stop the training is not returned.
    """
    import torch

    from tpm_gym.learning.callbacks import (
        Checkpointing,
        PeriodicEvaluation,
        ProgressBar,
        StopTrainingError,
    )
    from tpm_gym.learning.demonstrations import Demonstrations
    from tpm_gym.learning.logger import make_logger
    from tpm_gym.learning.signals import SignalListener

    torch.set_num_threads(config.threads)
    bar, listener = ProgressBar(console), SignalListener()
    with ExitStack() as stack:
        training_envs = make_training_envs(config)
        stack.callback(training_envs.close)
        evaluation_env: GoalEnv | TPMVectorEnv
        if config.in_batches:
            count = min(config.eval_episodes, BATCH)
            evaluation_env = make_envs(count=count, **_env_options(config))
        else:
            evaluation_env = make_env(**_env_options(config))
        stack.callback(evaluation_env.close)
        stack.callback(bar.close)
        model = make_model(config, training_envs)
        logger = make_logger(config.run, None if content is None else content.step)
        stack.callback(logger.close)
        model.set_logger(logger)
        keep = partial(_keep, config, console, run_folder.BEST_FILE)
        evaluation = PeriodicEvaluation(config, evaluation_env, console, keep)
        seconds = _restore(model, evaluation, content, console) if content else 0.0
        checkpointing = Checkpointing(config, store, evaluation, listener, console, seconds)
        # Checkpointing sets the clock of those after it.
        callbacks: list[BaseCallback] = [checkpointing, bar, evaluation]
        if config.recipe.demonstrations:
            callbacks.insert(1, Demonstrations(**config.recipe.demonstrations))
        stack.enter_context(listener.listening())
        stopped_by = None
        try:
            steps = config.steps - model.num_timesteps
            model.learn(steps, callback=callbacks, reset_num_timesteps=content is None)
        except StopTrainingError:
            stopped_by = listener.received
        _keep(config, console, run_folder.LAST_FILE, model)
        if stopped_by is None:
            checkpointing.save_finished()
    _report(config.run, console, store, stopped_by)
    return stopped_by


def _restore(
    model: BaseAlgorithm, evaluation: PeriodicEvaluation, content: Content, console: Console
) -> float:
    """Put everything back to a checkpoint; return the seconds that the run had trained."""
    from tpm_gym.learning.training_state import restore

    extra, notes = restore(model, content)
    evaluation.restore(extra["evaluation"])
    for note in notes:
        _say(console, f"note: {note}; the run goes on, but not exactly as it would have")
    return float(extra["seconds"])


def _keep(config: TrainingConfig, console: Console, name: str, model: BaseAlgorithm) -> None:
    """Export a policy to the run folder and save it; what is saved is complete."""
    from tpm_gym.learning.export import remove, save, save_archive

    archive = config.run / name
    path = archive.with_suffix("")
    try:
        save(model, path, env_id=config.env, seed=config.seed, recipe=asdict(config.recipe))
    except PolicyError as error:
        remove(path)
        _say(console, f"warning: not exported: {error}")
    save_archive(model, archive)


def _report(
    run: Path, console: Console, store: CheckpointStore, received: signal.Signals | None
) -> None:
    """Say in one line how the training ended, and how it can go on."""
    if received is None:
        _say(console, f"finished: {run}")
    elif store.newest is None:
        _say(console, f"stopped early by {received.name}, without a checkpoint: {run}")
    else:
        where = f"saved at step {store.newest:,}; continue with: tpm-gym resume {run}"
        _say(console, f"stopped early by {received.name}, {where}")


def make_model(config: TrainingConfig, envs: VecEnv) -> BaseAlgorithm:
    """Build the algorithm of a completed configuration."""
    kind = ALGORITHMS[config.algo].load_class()
    return kind(env=envs, seed=config.seed, device=config.device, **config.recipe.keywords())


def _require_room(config: TrainingConfig, numbers: int) -> None:
    """Refuse a replay buffer for which there is no memory; a step has two observations in it.

    Args:
        numbers: In an observation.
    """
    size = int(config.recipe.arguments.get("buffer_size", 0))
    try:
        np.empty((size, 2, numbers), np.float32)
    except (MemoryError, ValueError) as error:  # more than there are addresses is a ValueError
        raise ConfigError(f"--recipe {config.recipe_file}: buffer_size {size}: {error}") from error


def make_training_envs(config: TrainingConfig) -> VecEnv:
    """Build the training environments.

    Where there are several, those in closed form are computed at a time, others run in processes of
    their own.
    """
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    from tpm_gym.learning.training_state import EpisodeRecorder
    from tpm_gym.learning.vec_env import AnalyticVecEnv

    several = config.envs > 1
    if several and config.in_batches:
        # Episodes that end one by one make the batches of an on-policy algorithm even.
        options = {**_env_options(config), "autoreset_mode": "SameStep", "stagger": True}
        envs = AnalyticVecEnv(make_envs(count=config.envs, **options))
        envs.seed(config.seed)
        return envs
    return make_vec_env(
        make_env,
        n_envs=config.envs,
        seed=config.seed,
        wrapper_class=EpisodeRecorder,
        env_kwargs={**_env_options(config), "in_worker": several},
        vec_env_cls=SubprocVecEnv if several else DummyVecEnv,
    )


def _env_options(config: TrainingConfig) -> dict[str, Any]:
    """Which environment is trained and evaluated in, as arguments of :func:`make_env`."""
    # A process of its own has to import the id's module, or may not have the bare id registered.
    spec = check_env_id(config.env)
    env = config.env if ":" in config.env else spec
    chosen = {"penalty_weight": config.penalty_weight, "goals": config.goals}
    return {"env": env, **chosen, **config.env_options.given()}
