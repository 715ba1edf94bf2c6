"""What happens besides learning while a policy trains: evaluation, progress, stopping."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, Final

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from curves import draw_learning_curve
from policies import BEST_FILE, TrainedPolicy
from provenance import write_whole
from rollout import SELECTION_SEED, Estimate, GoalEnv, run_episodes, summarise

EVALUATIONS_FILE: Final = "evaluations.jsonl"
CURVE_FILE: Final = "learning_curve.png"


def save_model(model: BaseAlgorithm, path: Path) -> None:
    """Save an algorithm so that an interruption cannot leave half a file."""
    write_whole(path, model.save)


class PeriodicEvaluation(BaseCallback):
    """Evaluates the policy on held-out seeds before, during and after training.

    Every evaluation uses the same episodes, so the points of a learning curve differ by the policy
    alone. Each is appended to evaluations.jsonl and drawn; the best policy so far is kept.

    Args:
        env: An environment of its own, so that training is not disturbed.
        every: Environment steps between evaluations.
        episodes: Episodes per evaluation, from ``SELECTION_SEED`` up.
        run: The run folder.
        title: Title of the learning curve.
        console: Where one line per evaluation is printed.
    """

    def __init__(
        self, env: GoalEnv, every: int, episodes: int, run: Path, title: str, console: Console
    ) -> None:
        """Remember what to evaluate and where to put it."""
        super().__init__()
        self._env = env
        self._every = every
        self._episodes = episodes
        self._run = run
        self._title = title
        self._console = console
        self._evaluations: list[dict[str, Any]] = []
        self._best: tuple[float, float] | None = None
        self._total_steps = 0
        self._started = 0.0

    def _on_training_start(self) -> None:
        self._started = time.perf_counter()
        self._total_steps = self.locals["total_timesteps"]
        self._evaluate()

    def _on_step(self) -> bool:
        due = self.num_timesteps - self._evaluations[-1]["steps"] >= self._every
        # The last evaluation waits for the last update, to be that of the policy which is saved.
        if due and self.num_timesteps < self._total_steps:
            self._evaluate()
        return True

    def _on_training_end(self) -> None:
        # Also reached after an early stop, and whoever stopped does not want to wait.
        if self.num_timesteps >= self._total_steps:
            self._evaluate()

    def _evaluate(self) -> None:
        """Evaluate, record, keep the policy where it is the best so far, and draw."""
        policy = TrainedPolicy(self.model)
        records = run_episodes(self._env, policy, self._episodes, SELECTION_SEED)
        metrics = summarise(records)
        self._record(metrics)
        quality = (metrics["success_at_end"].mean, metrics["return"].mean)
        best = self._best is None or quality > self._best
        if best:
            self._best = quality
            save_model(self.model, self._run / BEST_FILE)
        self._print(metrics, best)
        draw_learning_curve(self._run / CURVE_FILE, self._title, self._evaluations)

    def _record(self, metrics: Mapping[str, Estimate]) -> None:
        """Append the metrics to evaluations.jsonl, progress.csv and TensorBoard."""
        line: dict[str, Any] = {
            "steps": self.num_timesteps,
            "episodes": self._episodes,
            "first_seed": SELECTION_SEED,
            "wall_seconds": round(time.perf_counter() - self._started, 3),
        }
        line.update({name: estimate.as_dict() for name, estimate in metrics.items()})
        self._evaluations.append(line)
        with (self._run / EVALUATIONS_FILE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(line, allow_nan=False) + "\n")
        for name, estimate in metrics.items():
            self.logger.record(f"eval/{name}", estimate.mean)
        self.logger.dump(self.num_timesteps)

    def _print(self, metrics: Mapping[str, Estimate], best: bool) -> None:
        """Print one line."""
        success = metrics["success_at_end"]
        self._console.print(
            f"{self.num_timesteps:>9,} steps   success {success.mean:6.1%} "
            f"[{success.low:.1%}, {success.high:.1%}]   return {metrics['return'].mean:7.2f}"
            f"{'   best' if best else ''}",
            markup=False,
        )


class ProgressBar(BaseCallback):
    """Shows a progress bar on a terminal, and nothing anywhere else.

    Args:
        console: Where it is shown; lines printed there appear above the bar.
    """

    def __init__(self, console: Console) -> None:
        """Lay out the bar without showing it."""
        super().__init__()
        self._progress = Progress(
            TextColumn("training"),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._task: TaskID | None = None

    def _on_training_start(self) -> None:
        self._progress.start()
        self._task = self._progress.add_task("training", total=self.locals["total_timesteps"])

    def _on_step(self) -> bool:
        if self._task is not None:
            self._progress.update(self._task, completed=self.num_timesteps)
        return True

    def close(self) -> None:
        """Leave the terminal as it was; safe to call at any time."""
        self._progress.stop()


class StopOnSignal(BaseCallback):
    """Ends training between two steps once the process is asked to stop.

    An exception in the middle of an update could leave a half-updated network to save. A second
    signal interrupts at once.
    """

    def __init__(self) -> None:
        """Start out not stopped."""
        super().__init__()
        self.stopped = False

    def _on_step(self) -> bool:
        return not self.stopped

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Take over SIGINT (Ctrl-C) and SIGTERM inside the context."""
        signals = (signal.SIGINT, signal.SIGTERM)
        before = {number: signal.signal(number, self._stop) for number in signals}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if self.stopped:
            raise KeyboardInterrupt
        self.stopped = True
