"""The learning curve of a run: success rate and return against environment steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from tpm_gym.learning.provenance import write_whole

_BLUE: Final = "#2166ac"
_TEAL: Final = "#1b9e77"
_ORANGE: Final = "#d95f02"
_INK: Final = "#333333"
_GRID: Final = "#d9d9d9"


def draw_learning_curve(path: Path, title: str, evaluations: Sequence[Mapping[str, Any]]) -> None:
    """Draw the periodic evaluations of a run.

    Args:
        path: The PNG file; replaced in one piece.
        title: First line above the figure.
        evaluations: The lines of evaluations.jsonl, at least one.
    """
    figure = Figure(figsize=(9.0, 6.0), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
    steps = [evaluation["steps"] for evaluation in evaluations]
    _draw_success(upper, steps, evaluations)
    _draw_return(lower, steps, evaluations)
    for axes in (upper, lower):
        _style(axes)
    figure.align_ylabels([upper, lower])
    lower.set_xlabel("environment steps")
    lower.xaxis.set_major_formatter(EngFormatter(sep=""))
    figure.suptitle(title, fontsize=13, fontweight="bold", color=_INK)
    write_whole(path, lambda part: figure.savefig(part, facecolor="white"))


def _draw_success(
    axes: Axes, steps: Sequence[int], evaluations: Sequence[Mapping[str, Any]]
) -> None:
    """Draw the success rates with the Wilson band of the one that counts."""
    at_end = [evaluation["success_at_end"] for evaluation in evaluations]
    once = [evaluation["success_once"]["mean"] for evaluation in evaluations]
    axes.fill_between(
        steps,
        [estimate["low"] for estimate in at_end],
        [estimate["high"] for estimate in at_end],
        color=_BLUE,
        alpha=0.16,
        linewidth=0,
        label="95% interval (Wilson)",
    )
    axes.plot(steps, once, color=_TEAL, linewidth=1.2, linestyle=(0, (4, 2)), label="success once")
    means = [estimate["mean"] for estimate in at_end]
    axes.plot(
        steps, means, color=_BLUE, linewidth=2, marker="o", markersize=4, label="success at end"
    )
    best = max(range(len(evaluations)), key=lambda i: (means[i], evaluations[i]["return"]["mean"]))
    axes.plot(
        steps[best],
        means[best],
        color=_ORANGE,
        marker="*",
        markersize=14,
        markeredgecolor="white",
        linestyle="none",
        zorder=3,
        clip_on=False,
        label=f"best.zip ({means[best]:.0%})",
    )
    axes.set_ylim(-0.02, 1.04)
    axes.yaxis.set_major_formatter(PercentFormatter(xmax=1))
    axes.set_ylabel("successful episodes")
    episodes = evaluations[-1]["episodes"]
    axes.set_title(f"{episodes} episodes an evaluation, never trained on", fontsize=9.5, color=_INK)
    _legend(axes)


def _draw_return(
    axes: Axes, steps: Sequence[int], evaluations: Sequence[Mapping[str, Any]]
) -> None:
    """Draw the return with its bootstrap band."""
    returns = [evaluation["return"] for evaluation in evaluations]
    axes.fill_between(
        steps,
        [estimate["low"] for estimate in returns],
        [estimate["high"] for estimate in returns],
        color=_BLUE,
        alpha=0.16,
        linewidth=0,
        label="95% interval (bootstrap)",
    )
    means = [estimate["mean"] for estimate in returns]
    axes.plot(steps, means, color=_BLUE, linewidth=2, marker="o", markersize=4, label="mean")
    axes.set_ylabel("return per episode")
    _legend(axes)


def _legend(axes: Axes) -> None:
    """A legend to the right, where it covers no data."""
    axes.legend(frameon=False, fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _style(axes: Axes) -> None:
    """Keep the frame quiet, so that the data stands out."""
    axes.grid(color=_GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors=_INK, labelsize=9, length=3)
    axes.margins(x=0.02)
    axes.xaxis.label.set_color(_INK)
    axes.yaxis.label.set_color(_INK)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(_GRID)
