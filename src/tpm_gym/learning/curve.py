"""Learning curve of a run, as a picture."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from tpm_gym.learning.figure_style import BLUE, GREEN, ORANGE, WIDTH, save, style


def draw_learning_curve(path: Path, title: str, evaluations: Sequence[Mapping[str, Any]]) -> None:
    """Draw the periodic evaluations of a run: success above, return below."""
    with style():
        figure = Figure(figsize=(WIDTH, 4.8), layout="constrained")
        figure.suptitle(title, weight="bold")
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
        _draw_success(upper, evaluations)
        _draw_interval(lower, evaluations, "return", "95% interval (bootstrap)", "mean")
        lower.set_ylabel("return per episode")
        lower.set_xlabel("environment steps")
        lower.xaxis.set_major_formatter(EngFormatter(sep=""))
        for axes in (upper, lower):
            axes.grid(linewidth=0.4)
            # To the right, where the legend covers no data.
            axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
        figure.align_ylabels([upper, lower])
        save(figure, path)


def _draw_success(axes: Axes, evaluations: Sequence[Mapping[str, Any]]) -> None:
    """Draw both success rates, the interval of the rate at the end, and the best policy."""
    steps = [evaluation["steps"] for evaluation in evaluations]
    once = [evaluation["success_once"]["mean"] for evaluation in evaluations]
    axes.plot(steps, once, color=GREEN, linewidth=1.2, linestyle=(0, (4, 2)), label="success once")
    _draw_interval(axes, evaluations, "success_at_end", "95% interval (Wilson)", "success at end")
    means = [evaluation["success_at_end"]["mean"] for evaluation in evaluations]
    best = max(range(len(means)), key=lambda i: (means[i], evaluations[i]["return"]["mean"]))
    axes.plot(
        *(steps[best], means[best], "*"),
        color=ORANGE,
        markersize=12,
        markeredgecolor="white",
        zorder=3,
        clip_on=False,
        label=f"best.zip ({means[best]:.0%})",
    )
    axes.set_ylim(-0.02, 1.04)
    axes.yaxis.set_major_formatter(PercentFormatter(xmax=1))
    axes.set_ylabel("successful episodes")
    axes.set_title(f"{evaluations[-1]['episodes']} episodes an evaluation, never trained on")


def _draw_interval(
    axes: Axes, evaluations: Sequence[Mapping[str, Any]], name: str, interval: str, mean: str
) -> None:
    """Draw a metric over the steps as a line, and its interval as a band."""
    steps = [evaluation["steps"] for evaluation in evaluations]
    low, means, high = (
        [evaluation[name][part] for evaluation in evaluations] for part in ("low", "mean", "high")
    )
    axes.fill_between(steps, low, high, color=BLUE, alpha=0.16, linewidth=0, label=interval)
    axes.plot(steps, means, color=BLUE, linewidth=1.6, marker="o", markersize=3, label=mean)
