"""Figures of docs/results.md."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import (
    EngFormatter,
    LogLocator,
    MaxNLocator,
    NullFormatter,
    PercentFormatter,
    StrMethodFormatter,
)

from tpm_gym.learning.figure_style import (
    BLUE,
    GREEN,
    ORANGE,
    OUTLINE,
    PURPLE,
    REACHED,
    SKY,
    VERMILLION,
    WIDTH,
    save,
    style,
)
from tpm_gym.simulation.randomisation import LIMITS

from .bisection import UNITS, ends
from .page import ENGINES, LEARNED, Frame, groups, split, successes
from .records import Record

LEARNING_CURVES: Final = "results_learning_curves.png"
PENALTY: Final = "results_penalty.png"
ROBUSTNESS: Final = "results_robustness.png"

_COLUMNS: Final = 3
_COLOURS: Final = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)
_LIMIT: Final[dict[str, Any]] = {
    "color": OUTLINE,
    "linewidth": 0.6,
    "linestyle": (0, (3, 2)),
}


def draw(records: Sequence[Record], folder: Path) -> list[Path]:
    """Draw the figures that there are records for; return their files."""
    runs, tempting = split(records)
    bisections = [record for record in records if "attribute" in record]
    tempting = tempting[tempting["pybullet.success_at_end.mean"].notna()]
    figures: dict[str, Callable[[], Figure]] = {}
    if len(runs) and runs["curve"].any():
        figures[LEARNING_CURVES] = partial(learning_curves, runs)
    if len(tempting):
        figures[PENALTY] = partial(penalty, tempting)
    if bisections:
        figures[ROBUSTNESS] = partial(robustness, bisections)
    with style():
        for name, drawn in figures.items():
            save(drawn(), folder / name)
    return [folder / name for name in figures]


def learning_curves(runs: Frame) -> Figure:
    """Draw success against steps: a panel an id; for each method, a median and a band of seeds."""
    ids = sorted(runs["env"].unique())
    figure, panels = _grid(ids, "Success in the evaluations during training", 2.1)
    colours = _colours(runs["label"])
    for env, axes in zip(ids, panels, strict=True):
        for group in groups(runs[runs["env"] == env]):
            # A row a step, a column a seed. A run that ended early has NaN from there on.
            curves = pd.DataFrame([pd.Series(curve, dtype=float) for curve in group["curve"]]).T
            curves = curves.sort_index()
            label = group["label"].iloc[0]
            if len(curves):
                band = curves.min(axis=1), curves.max(axis=1)
                axes.fill_between(curves.index, *band, color=colours[label], alpha=0.2, lw=0)
                axes.plot(curves.median(axis=1), color=colours[label], label=label, linewidth=1.4)
        axes.axhline(LEARNED, **_LIMIT)
        start = min((min(curve) for curve in runs[runs["env"] == env]["curve"] if curve), default=0)
        if start:
            axes.axvspan(0, start, color=REACHED, lw=0)
            text = axes.text(start / 2, 0.5, "demonstrations", color="0.4", rotation=90)
            text.set(ha="center", va="center")
        axes.set_xlim(left=0)
        axes.set_xlabel("environment steps")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    for axes in panels[::_COLUMNS]:
        axes.set_ylabel("successful episodes")
    _legend(figure, "median of the seeds, band from the least to the most successful")
    return figure


def penalty(runs: Frame) -> Figure:
    """Draw success and steps with unsafe conditioning, by penalty weight; a dot is a seed."""
    ids = sorted(runs["env"].unique())
    figure, panels = _grid(ids, "Goals that tempt towards the singularity", 2.4)
    metrics = (
        ("success_at_end", "success, bar at the median", "median", BLUE),
        ("unsafe_share", "steps with unsafe conditioning, bar at the mean", "mean", VERMILLION),
    )
    for env, axes in zip(ids, panels, strict=True):
        found = groups(runs[runs["env"] == env])
        for place, (metric, label, middle, colour) in zip((-0.16, 0.16), metrics, strict=True):
            for index, group in enumerate(found):
                values, x = group[f"pybullet.{metric}.mean"], index + place
                axes.plot([x] * len(values), values, "o", color=colour, alpha=0.6, markersize=4)
                bar = values.agg(middle)
                axes.hlines(bar, x - 0.12, x + 0.12, color=colour, linewidth=1.6)
            axes.plot([], [], "o", color=colour, label=label)
        labels = [group["label"].iloc[0].replace(", ", "\n") for group in found]
        weights = [f"{group['penalty_weight'].iloc[0]:g}" for group in found]
        if len(set(labels)) > 1:
            weights = [f"{weight}\n{label}" for weight, label in zip(weights, labels, strict=True)]
        axes.set_xlim(-0.5, len(found) - 0.5)
        axes.set_xticks(range(len(found)), weights)
        axes.set_xlabel("penalty weight")
    _legend(figure, "each dot is a seed")
    return figure


def robustness(bisections: Sequence[Record]) -> Figure:
    """Draw success against the size of a difference: a panel an attribute, a line an id."""
    attributes = [name for name in LIMITS if any(r["attribute"] == name for r in bisections)]
    names = [name.replace("_", " ") for name in attributes]
    figure, panels = _grid(names, "Success of the published policies on robots that differ", 1.9)
    colours = _colours(record["env"] for record in bisections)
    for attribute, axes in zip(attributes, panels, strict=True):
        for record in sorted(bisections, key=lambda r: (r["env"], r["engine"])):
            if record["attribute"] == attribute:
                in_pybullet = record["engine"] == "pybullet"
                axes.plot(
                    *zip(*sorted(successes(record).items()), strict=True),
                    color=colours[record["env"]],
                    label=f"{record['env']}, {ENGINES.get(record['engine'], record['engine'])}",
                    linestyle="--" if in_pybullet else "-",
                    markerfacecolor="white" if in_pybullet else None,
                    marker="o",
                    markersize=2.5,
                )
        axes.axhline(0.5, **_LIMIT)
        axes.set_xlabel(UNITS.get(attribute, "factor, logarithmic"))
        if attribute not in UNITS:
            axes.set_xscale("log")
            low, high = ends(attribute)
            parts = (1, 2, 5) if high <= 100 * low else (1, 3)
            axes.xaxis.set_major_locator(LogLocator(subs=parts))
            axes.xaxis.set_minor_locator(LogLocator(subs=range(1, 10)))
            axes.xaxis.set_minor_formatter(NullFormatter())
        else:
            most = 6 if max(ends(attribute)) >= 1 else 5  # small numbers have long labels
            axes.xaxis.set_major_locator(MaxNLocator(most, steps=(1, 2, 5, 10)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    _legend(figure, "each dot is a test; success halves near the dashed lines")
    return figure


def _colours(names: Any) -> dict[str, str]:
    """Return a colour for each name."""
    unique = sorted(set(names))
    return {name: _COLOURS[index % len(_COLOURS)] for index, name in enumerate(unique)}


def _grid(names: Sequence[str], title: str, height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel for each name, row by row, for shares of 0 to 1."""
    columns = 2 if len(names) == 4 else min(_COLUMNS, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(WIDTH, height * rows + 0.5), layout="constrained")
    figure.suptitle(title, weight="bold")
    panels: list[Axes] = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for unused in panels[len(names) :]:
        unused.set_visible(False)
    for name, axes in zip(names, panels, strict=False):
        axes.set_title(name)
        axes.set_ylim(-0.03, 1.03)
        axes.yaxis.set_major_formatter(PercentFormatter(xmax=1))
    return figure, panels[: len(names)]


def _legend(figure: Figure, title: str) -> None:
    """Add one legend for all panels, below them."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        handles, labels = axes.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    figure.legend(
        entries.values(),
        entries,
        loc="outside lower center",
        ncols=max(1, min(_COLUMNS, len(entries))),
        title=title,
    )
