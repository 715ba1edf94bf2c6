"""Callbacks of a training: evaluations, checkpoints, and stopping."""

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from rich.console import Console
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from tpm_gym.envs.vector import TPMVectorEnv
from tpm_gym.learning.checkpoint import CheckpointStore
from tpm_gym.learning.configuration import TrainingConfig
from tpm_gym.learning.errors import CheckpointError
from tpm_gym.learning.policies import TrainedPolicy
from tpm_gym.learning.rollout import SELECTION_SEED, run_episodes, summarise
from tpm_gym.learning.run_folder import EVALUATIONS_FILE
from tpm_gym.learning.signals import SignalListener
from tpm_gym.learning.training_state import capture

_SHORTEST_INTERVAL: Final = 30.0  # s between checkpoints
_LARGEST_SHARE: Final = 0.02  # largest fraction of the time for writing checkpoints


@dataclass(eq=False)
class PeriodicEvaluation(BaseCallback):
    """Evaluation of the policy on held-out seeds before, during and after training.

    All evaluations use the same episodes. Each evaluation is appended to evaluations.jsonl, with
    the training time so far in seconds: wall-clock time, and CPU time of the main process (without
    workers).

    ``envs`` are not those of the training, so evaluations do not disturb it. ``keep`` is called
    with the model whenever the model is the best so far.
    """

    config: TrainingConfig
    envs: TPMVectorEnv
    console: Console
    keep: Callable[[BaseAlgorithm], object]
    evaluations: list[dict[str, Any]]

    def __post_init__(self) -> None:
        """Initialise the callback."""
        super().__init__()

    def _on_training_start(self) -> None:
        if not self.evaluations:
            self.console.print("first evaluation, before training ...")
            self._evaluate()

    def _init_callback(self) -> None:
        # A resumed run continues to count from its last evaluation.
        earlier = self.evaluations[-1].get("cpu_seconds", 0.0) if self.evaluations else 0.0
        self._cpu_start = time.process_time() - earlier

    def _on_step(self) -> bool:
        due = self.num_timesteps - self.evaluations[-1]["steps"] >= self.config.eval_every
        # The last evaluation follows the last update, so that it tests the policy that is saved.
        if due and self.num_timesteps < self.config.steps:
            self._evaluate()
        return True

    def _on_training_end(self) -> None:
        self._evaluate()

    def _evaluate(self) -> None:
        policy, episodes = TrainedPolicy(self.model), self.config.eval_episodes
        metrics = summarise(run_episodes(self.envs, policy, episodes, SELECTION_SEED))
        earlier = max(map(quality, self.evaluations), default=None)
        self._record({name: estimate.as_dict() for name, estimate in metrics.items()})
        best = earlier is None or quality(self.evaluations[-1]) > earlier
        if best:
            self.keep(self.model)
        success = metrics["success_at_end"]
        self.console.print(
            f"{self.num_timesteps:>9,} steps   success {success.mean:6.1%} "
            f"[{success.low:.1%}, {success.high:.1%}]   return {metrics['return'].mean:7.2f}"
            f"{'   best' if best else ''}",
            markup=False,
        )

    def _record(self, metrics: Mapping[str, Mapping[str, float]]) -> None:
        """Append the metrics to evaluations.jsonl, progress.csv and TensorBoard."""
        line: dict[str, Any] = {
            "steps": self.num_timesteps,
            "episodes": self.config.eval_episodes,
            "first_seed": SELECTION_SEED,
            "wall_seconds": round(seconds_trained(self.model), 3),
            "cpu_seconds": round(time.process_time() - self._cpu_start, 3),
            **metrics,
        }
        self.evaluations.append(line)
        with (self.config.run / EVALUATIONS_FILE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(line, allow_nan=False) + "\n")
        for name, estimate in metrics.items():
            self.logger.record(f"eval/{name}", estimate["mean"])
        self.logger.dump(self.num_timesteps)


def quality(evaluation: Mapping[str, Any]) -> tuple[float, float]:
    """Return the pair (success, return) of an evaluation; the best policy has the largest pair."""
    return evaluation["success_at_end"]["mean"], evaluation["return"]["mean"]


@dataclass(eq=False)
class Progress(BaseCallback):
    """Callback that reports the progress of a training.

    Whenever the environments have taken a step, ``advance`` is called with the number of steps
    since the previous call, summed over all environments.
    """

    advance: Callable[[int], object]

    def __post_init__(self) -> None:
        """Initialise the callback."""
        super().__init__()
        self._shown = 0

    def _on_step(self) -> bool:
        self.advance(self.num_timesteps - self._shown)
        self._shown = self.num_timesteps
        return True


class StopTrainingError(Exception):
    """Error that ends ``learn`` after the last checkpoint; it is caught, so users never see it."""


@dataclass(eq=False)
class Checkpointing(BaseCallback):
    """Checkpoints between rollouts, and one when the process is asked to stop.

    If a checkpoint cannot be written, a warning is printed, and training continues until the next
    checkpoint is due. The first checkpoint is saved before any policy is saved, so that every run
    with a saved policy has a checkpoint. ``seconds`` is the training time in earlier processes, s.
    """

    config: TrainingConfig
    store: CheckpointStore
    listener: SignalListener
    console: Console
    seconds: float

    def __post_init__(self) -> None:
        """Initialise the callback."""
        super().__init__()
        self._last_step: int | None = self.store.newest
        self._next_time = time.perf_counter() + _SHORTEST_INTERVAL

    def _on_training_start(self) -> None:
        # Times and speeds in the logs count from the beginning of the run.
        self.model.start_time = int(time.time_ns() - self.seconds * 1e9)
        self.model._num_timesteps_at_start = 0
        if self._last_step is None:
            self.save()

    def _on_rollout_start(self) -> None:
        stop = self.listener.received is not None
        if stop or self._is_due():
            self.save()
        if stop:
            raise StopTrainingError

    def _on_step(self) -> bool:
        return True

    def _is_due(self) -> bool:
        if self.config.checkpoint_every is not None:
            taken = self.model.num_timesteps - (self._last_step or 0)
            return taken >= self.config.checkpoint_every
        return time.perf_counter() >= self._next_time

    def save(self, finished: bool = False) -> None:
        """Save a checkpoint; report an error instead of raising it."""
        started = time.perf_counter()
        content = capture(self.model, self.config.run, seconds_trained(self.model), finished)
        try:
            self.store.save(content)
        except CheckpointError as error:
            self.console.print(f"warning: {error}", markup=False, soft_wrap=True)
        now = time.perf_counter()
        self._next_time = now + max(_SHORTEST_INTERVAL, (now - started) / _LARGEST_SHARE)
        self._last_step = content.step


def seconds_trained(model: BaseAlgorithm) -> float:
    """Return the training time of a run in this and earlier processes, s."""
    return (time.time_ns() - model.start_time) / 1e9
