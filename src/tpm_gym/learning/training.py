"""Training with Stable-Baselines3; everything about a run is in one folder.

The folder holds ``config.json`` (configuration, versions, seeds), ``progress.csv`` and TensorBoard
events, ``evaluations.jsonl``, ``checkpoints/``, ``best.zip`` (best periodic evaluation) and
``last.zip``, both exported as safetensors, and at the end ``learning_curve.png``. Ctrl-C stops at
the end of a rollout, with a checkpoint; a second Ctrl-C stops at once.
"""

import json
import signal
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from gymnasium.spaces import flatdim
from rich.console import Console
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from tpm_gym.errors import TPMError
from tpm_gym.learning import callbacks, curve, export, provenance, run_folder, training_state
from tpm_gym.learning.algorithms import ALGORITHMS
from tpm_gym.learning.checkpoint import CheckpointStore, Content
from tpm_gym.learning.configuration import UNSET, ResumeConfig, TrainingConfig, complete, resumed
from tpm_gym.learning.demonstrations import Demonstrations
from tpm_gym.learning.environments import (
    check_env_id,
    conditions_set_by,
    import_module_of,
    make_env,
    make_envs,
)
from tpm_gym.learning.errors import (
    CheckpointError,
    ConfigError,
    DivergedError,
    PolicyError,
    RunError,
)
from tpm_gym.learning.evaluation import EvaluationConfig, bar, evaluate
from tpm_gym.learning.recipes import shipped_for
from tpm_gym.learning.rollout import BATCH, SELECTION_SEED
from tpm_gym.learning.run_folder import (
    CHECKPOINTS,
    CONFIG_FILE,
    CURVE_FILE,
    EVALUATIONS_FILE,
    TESTS,
    is_finished,
)
from tpm_gym.learning.signals import SignalListener
from tpm_gym.learning.vec_env import AnalyticVecEnv

_TESTED: Final = ("analytic", "pybullet")  # engines of the final test
_CHANGEABLE: Final = {
    **dict.fromkeys(("steps", "eval_every", "checkpoint_every", "threads"), int),
    "device": str,
}
"""Options that resuming can change, and their types. The environment id cannot change."""


def train(config: TrainingConfig, console: Console | None = None) -> signal.Signals | None:
    """Train a policy and write the run folder; progress is shown on ``console``.

    Returns:
        None if training went to its end; the signal that stopped it (Ctrl-C or SIGTERM) if a
        checkpoint was saved instead.

    Raises:
        LearningError: The configuration is not valid, the run folder is not empty or not writable,
            or the training diverged.
        ConfigurationError: There is no such environment.
    """
    console = console or Console()
    import_module_of(config.env)
    check_env_id(config.env)
    with closing(make_env(**config.env_arguments)) as env:  # wrong options fail here, before all
        size = flatdim(env.observation_space)
    asked, config = config.steps, complete(config)
    asked = config.recipe.n_timesteps if asked is UNSET else asked
    _require_room(config, size)
    run_folder.prepare(config.run, config.overwrite)
    if config.demonstrations != (few := config.recipe.demonstrations.get("episodes", 0)):
        _say(
            console,
            f"note: {few:,} demonstrations were asked for, and rounded up to "
            f"{config.demonstrations:,}, equally many in each of {config.envs:,} environments",
        )
    if config.steps != asked:
        shown = f"{config.demonstrated:,} of demonstrations and " if config.demonstrated else ""
        rollouts = (config.steps - config.demonstrated) // config.rollout
        _say(
            console,
            f"note: {asked:,} steps were asked for, and rounded up to {config.steps:,}: {shown}"
            f"{rollouts:,} rollouts of {config.rollout:,}",
        )
    if config.recipe.written_for != config.env.rpartition(":")[2]:
        there = "".join(f"; the id has one with {own}" for own in shipped_for(config.env)[:1])
        _say(
            console,
            f"note: the recipe of {config.algo} is that of {config.recipe.written_for}{there}; "
            "give your own with --recipe FILE",
        )
    starts = config.argument("learning_starts") or 0
    if config.steps <= starts:
        _say(console, f"note: learning starts at step {starts:,}, so nothing will be learned")
    description = {
        **config.record(),
        "id_options": conditions_set_by(config.env),
        "training_seeds": [config.seed, config.seed + config.envs - 1],
        "evaluation_seeds": [SELECTION_SEED, SELECTION_SEED + config.eval_episodes - 1],
        **provenance.origin(),
    }
    store = CheckpointStore(config.run / CHECKPOINTS)
    with run_folder.disk_errors_named(config.run, store), run_folder.claimed(config.run):
        return _Session(config, console, store, description, None).run()


def resume(config: ResumeConfig, console: Console | None = None) -> signal.Signals | None:
    """Continue a run from its last whole checkpoint; return as :func:`train` does.

    A run that was killed before its first checkpoint begins again. A finished run is continued only
    if it is given more steps. Otherwise, a missing learning curve is drawn, and a missing final
    test is run.

    Raises:
        LearningError: There is no such run, it holds a policy but no whole checkpoint, a change is
            not valid, or the training diverged.
    """
    console = console or Console()
    run = config.run
    store = CheckpointStore(run / CHECKPOINTS)
    if not run.is_dir():
        raise RunError(f"there is no folder {run}; start a run with tpm-gym train")
    with run_folder.disk_errors_named(run, store), run_folder.claimed(run):
        stored = run_folder.description(run)
        if stored is not None and is_finished(run) and config.steps in (UNSET, stored["steps"]):
            checked = resumed(config, stored, 0)
            if not _Session(checked, console, store, stored, None).complete():
                _say(console, f"nothing to do: {run} has finished its {stored['steps']:,} steps")
            return None
        content = store.load(lambda text: _say(console, f"warning: {text}"))
        if content:
            with _foreign_named(run):
                stored = _with_changes(dict(json.loads(content.files[CONFIG_FILE])), stored or {})
        elif stored is None:
            raise RunError(f"{run} holds no run of tpm_gym; start one with tpm-gym train")
        elif run_folder.holds_policy(run):
            raise RunError(
                f"{run} holds a policy, but no checkpoint to go on from, and beginning again would "
                "replace it; train into another --run, or here with tpm-gym train --overwrite"
            )
        changed = resumed(config, stored, content.step if content else 0)
        resumption = {"from_step": content.step if content else 0, **provenance.origin()}
        description = {
            **stored,
            **{name: getattr(changed, name) for name in _CHANGEABLE},
            "resumed": [*stored.get("resumed", []), resumption],
        }
        return _Session(changed, console, store, description, content).run()


def _with_changes(saved: dict[str, Any], newest: Mapping[str, Any]) -> dict[str, Any]:
    """Return the configuration ``saved``, with the options of ``newest`` that resuming can change.

    These options differ if an earlier resumption was killed before its first checkpoint.

    Args:
        saved: Configuration in the checkpoint.
        newest: Configuration in the folder of the run.
    """
    given = {name: newest.get(name) for name in _CHANGEABLE}
    return saved | {n: value for n, value in given.items() if isinstance(value, _CHANGEABLE[n])}


@contextmanager
def _foreign_named(run: Path) -> Iterator[None]:
    """Raise a CheckpointError if a checkpoint cannot be used, although its checksum is right."""
    try:
        yield
    except TPMError:
        raise
    except Exception as error:  # whatever JSON, PyTorch and NumPy raise
        raise CheckpointError(
            f"the checkpoint of {run} has other entries than a training writes "
            f"({type(error).__name__}: {str(error)[:100]}); start the run anew with --overwrite"
        ) from error


def _say(console: Console, text: str) -> None:
    console.print(text, markup=False, soft_wrap=True)


@dataclass(frozen=True)
class _Session:
    """Part of a run that is executed by this process.

    It begins at the checkpoint ``content``, or at the start of the run if ``content`` is None.
    """

    config: TrainingConfig
    console: Console
    store: CheckpointStore
    description: Mapping[str, Any]
    content: Content | None

    def run(self) -> signal.Signals | None:
        """Train, save and test; return the signal that stopped the training, or None."""
        config, content, listener = self.config, self.content, SignalListener()
        self._say_title()
        torch.set_num_threads(config.threads)
        count = min(config.eval_episodes, BATCH) if config.env_options.in_batches else 1
        with ExitStack() as stack:
            training_envs = stack.enter_context(training_envs_of(config))
            envs = stack.enter_context(closing(make_envs(count=count, **config.env_arguments)))
            advance = stack.enter_context(bar(self.console, "training", config.steps))
            model = make_model(config, training_envs)
            seconds, earlier = self._begin(model)
            keep = partial(self._keep, run_folder.BEST_FILE)
            evaluation = callbacks.PeriodicEvaluation(config, envs, self.console, keep, earlier)
            checkpointing = callbacks.Checkpointing(
                config, self.store, listener, self.console, seconds
            )
            stack.callback(model.logger.close)
            # Checkpointing sets the clock that the callbacks after it read.
            called: list[BaseCallback] = [checkpointing, callbacks.Progress(advance), evaluation]
            if config.recipe.demonstrations:
                called.insert(1, Demonstrations(**config.recipe.demonstrations))
                if content is None:
                    shown = f"{config.demonstrations:,} demonstrations of the expert"
                    _say(self.console, f"playing {shown} and learning from them ...")
            with listener.listening():
                stopped_by = self._learn(model, called, listener)
                self._keep(run_folder.LAST_FILE, model)
                if stopped_by is None:
                    checkpointing.save(finished=True)
        curve.draw_learning_curve(config.run / CURVE_FILE, config.title, evaluation.evaluations)
        self._conclude(stopped_by)
        return stopped_by

    def _say_title(self) -> None:
        config, content = self.config, self.content
        start = f"from step {content.step if content else 0:,} to "
        start = start if "resumed" in self.description else ""
        _say(self.console, f"{config.title}, {start}{config.steps:,} steps, in {config.run}")
        count, every = config.eval_episodes, config.eval_every
        _say(self.console, f"evaluations: {count:,} episodes each, every {every:,} steps")

    def _begin(self, model: BaseAlgorithm) -> tuple[float, list[dict[str, Any]]]:
        """Set model, files and logs to the beginning or the checkpoint.

        Return the training time, s, and the evaluations so far.
        """
        config, content, seconds, evaluations = self.config, self.content, 0.0, []
        if content is None:
            run_folder.clear(config.run)
        else:  # files change only once the checkpoint is restored
            with _foreign_named(config.run):
                seconds = training_state.restore(model, content)
                evaluations = run_folder.checked(content.files.get(EVALUATIONS_FILE, b""))
            training_state.restore_files(config.run, content)
        provenance.write_json(config.run / CONFIG_FILE, self.description)
        iterations = max(0, model.num_timesteps - config.demonstrated) // config.rollout
        model.set_logger(training_state.make_logger(config.run, content, iterations))
        return seconds, evaluations

    def _learn(
        self, model: BaseAlgorithm, called: list[BaseCallback], listener: SignalListener
    ) -> signal.Signals | None:
        """Train for the remaining steps; return the signal that stopped the training, or None."""
        steps = self.config.steps - model.num_timesteps
        try:
            model.learn(steps, callback=called, reset_num_timesteps=self.content is None)
        except callbacks.StopTrainingError:
            return listener.received
        except (TPMError, ValueError) as error:
            # PyTorch refuses NaN in a distribution, environments refuse it in an action.
            if all(bool(values.isfinite().all()) for values in model.policy.parameters()):
                raise
            raise DivergedError(
                f"the training diverged before step {model.num_timesteps:,}: its networks are no "
                f"longer finite; lower learning_rate in {self.config.recipe_file} and train again "
                "with --overwrite"
            ) from error
        return None

    def _keep(self, name: str, model: BaseAlgorithm) -> None:
        """Save a policy in the run folder, and export it."""
        config = self.config
        archive = config.run / name
        path = archive.with_suffix("")
        recipe, options = asdict(config.recipe), config.env_options.given()
        try:
            export.save(
                model, path, env_id=config.env, seed=config.seed, recipe=recipe, env_options=options
            )
        except PolicyError as error:
            export.remove(path)
            _say(self.console, f"warning: not exported: {error}")
        export.save_archive(model, archive)

    def _conclude(self, stopped_by: signal.Signals | None) -> None:
        """Report how the training ended; run the final test if the configuration has one."""
        config = self.config
        if stopped_by is not None:
            command, saved = run_folder.resume_command(config.run), "without a checkpoint"
            if self.store.newest is not None:
                saved = f"saved at step {self.store.newest:,}; continue with: {command}"
            _say(self.console, f"stopped early by {stopped_by.name}, {saved}")
            return
        _say(self.console, f"finished: {config.run}")
        if self._has_test:
            self._test()

    def complete(self) -> bool:
        """Draw the learning curve and run the final test, if a killed process has not done so.

        Return whether the final test ran.
        """
        config = self.config
        if not (config.run / CURVE_FILE).exists():
            evaluations = run_folder.evaluations(config.run)
            curve.draw_learning_curve(config.run / CURVE_FILE, config.title, evaluations)
        files = [config.run / TESTS / f"{engine}.json" for engine in _TESTED]
        if not self._has_test or all(file.exists() for file in files):
            return False
        self._test()
        return True

    @property
    def _has_test(self) -> bool:
        return self.config.env_options.in_batches and self.config.test_episodes > 0

    def _test(self) -> None:
        """Test the best policy in the analytic engine and in PyBullet; print success and events."""
        config = self.config
        best = max(run_folder.evaluations(config.run), key=callbacks.quality)["steps"]
        _say(
            self.console,
            f"testing the best policy, of step {best:,}, in {config.test_episodes} held-out "
            "episodes in each engine ...",
        )
        rates: dict[str, list[str]] = {}
        for engine in _TESTED:
            test = EvaluationConfig(
                policy=(str(config.run),),
                env=config.env,
                episodes=config.test_episodes,
                goals=config.goals,
                penalty_weight=config.penalty_weight,
                randomisation=config.randomisation,
                env_options=replace(config.env_options, engine=engine),
                json=config.run / TESTS / f"{engine}.json",
            )
            (result,) = evaluate(test, Console(quiet=True))
            for name, label in {"success_at_end": "success", **result.events}.items():
                rate = result.metrics[name]
                shown = f"{rate.mean:.1%} [{rate.low:.1%}, {rate.high:.1%}]"
                rates.setdefault(label, []).append(shown)
        for label, each in rates.items():
            _say(self.console, f"{label} in the analytic engine and PyBullet: {', '.join(each)}")


def make_model(config: TrainingConfig, envs: VecEnv) -> BaseAlgorithm:
    """Build the algorithm of a configuration in which all options have values."""
    kind = ALGORITHMS[config.algo].load_class()
    keywords = config.recipe.keywords(config.rollout / config.steps)
    return kind(env=envs, seed=config.seed, device=config.device, **keywords)


def _require_room(config: TrainingConfig, numbers: int) -> None:
    """Refuse a buffer that does not fit in memory.

    The buffer is assumed to store two observations of ``numbers`` values for each step.
    """
    name = "buffer_size" if config.argument("buffer_size") else "n_steps"
    size = config.argument("buffer_size") or config.rollout
    try:
        np.empty((size, 2, numbers), np.float32)
    except (MemoryError, ValueError) as error:  # ValueError: larger than the address space
        raise ConfigError(f"--recipe {config.recipe_file}: {name} {size}: {error}") from error


@contextmanager
def training_envs_of(config: TrainingConfig) -> Iterator[VecEnv]:
    """Build the training environments, and close them at the end.

    If a worker has ended, or a step was interrupted, closing would wait forever for answers of the
    workers. They are killed instead.
    """
    envs = make_training_envs(config)
    try:
        yield envs
    except BaseException as error:
        if isinstance(envs, SubprocVecEnv) and (
            envs.waiting or isinstance(error, ConnectionError | EOFError)
        ):
            for process in envs.processes:
                process.kill()
                process.join()
            envs.closed = True
        raise
    finally:
        envs.close()


def make_training_envs(config: TrainingConfig) -> VecEnv:
    """Build the training environments.

    In the analytic engine, all environments are in this process. In another engine, each of several
    environments has its own process.
    """
    several = config.envs > 1
    if several and config.env_options.in_batches:
        # Episodes that end at different steps give an on-policy batch all parts of an episode.
        options = {**config.env_arguments, "autoreset_mode": "SameStep", "stagger": True}
        envs = AnalyticVecEnv(make_envs(count=config.envs, **options))
        envs.seed(config.seed)
        return envs
    return make_vec_env(
        make_env,
        n_envs=config.envs,
        seed=config.seed,
        wrapper_class=training_state.EpisodeRecorder,
        env_kwargs={**config.env_arguments, "in_worker": several},
        vec_env_cls=SubprocVecEnv if several else DummyVecEnv,
    )
