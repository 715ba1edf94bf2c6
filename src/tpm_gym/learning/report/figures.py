"""The learning curve of a run, and the figures of docs/results.md."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from tpm_gym.learning.estimates import LEARNED
from tpm_gym.learning.figure_style import (
    BLUE,
    GREEN,
    ORANGE,
    OUTLINE,
    PURPLE,
    SKY,
    VERMILLION,
    WIDTH,
    save,
    style,
)
from tpm_gym.learning.provenance import write_whole
from tpm_gym.learning.report.page import (
    LEARNING_CURVES,
    PENALTY,
    ROBUSTNESS,
    Group,
    Record,
    engine_of,
    grouped,
    method,
    split,
    successes,
)
from tpm_gym.learning.robustness import UNITS, ends, nominal
from tpm_gym.simulation.randomisation import LIMITS

_COLUMNS = 3
_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)


def draw(records: Sequence[Record], folder: Path) -> list[Path]:
    """Draw what there are records for; return the files."""
    bisections, runs = split(records)
    plain = [r for r in runs if r["goals"] == "sampled" and r["penalty_weight"] == 1.0]
    tempted = [r for r in runs if r["goals"] == "tempting" and "pybullet" in r["tests"]]
    written = []
    with style():
        if any(record["evaluations"]["steps"] for record in plain):
            written.append(_save(learning_curves(plain), folder / LEARNING_CURVES))
        if tempted:
            written.append(_save(penalty(tempted), folder / PENALTY))
        if bisections:
            written.append(_save(robustness(bisections), folder / ROBUSTNESS))
    return written


def _save(figure: Figure, path: Path) -> Path:
    write_whole(path, partial(save, figure))
    return path


def _figure(height: float, title: str) -> Figure:
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    figure.suptitle(title, weight="bold")
    return figure


def _count_steps(axes: Axes) -> None:
    axes.set_xlabel("environment steps")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def _grid(names: Sequence[str], title: str, height: float) -> tuple[Figure, list[Axes]]:
    """A figure with a panel a name, for shares of 0 to 1, row by row."""
    columns = 2 if len(names) == 4 else min(_COLUMNS, len(names))
    rows = -(-len(names) // columns)
    figure = _figure(height * rows + 0.5, title)
    panels: list[Axes] = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for unused in panels[len(names) :]:
        unused.set_visible(False)
    for name, axes in zip(names, panels, strict=False):
        axes.set_title(name)
        axes.set_ylim(-0.03, 1.03)
        axes.yaxis.set_major_formatter(PercentFormatter(xmax=1))
    return figure, panels[: len(names)]


def _panels(
    records: Sequence[Record], title: str, height: float
) -> tuple[Figure, list[tuple[Axes, list[Group]]]]:
    """A figure with a panel an id, and each panel's groups."""
    ids = sorted({record["env"] for record in records})
    figure, panels = _grid(ids, title, height)
    groups = [grouped(r for r in records if r["env"] == env_id) for env_id in ids]
    return figure, list(zip(panels, groups, strict=True))


def learning_curves(records: Sequence[Record]) -> Figure:
    """Draw success against steps: a panel an id, a median and a band over seeds each method."""
    names = sorted({method(record) for record in records})
    colours = dict(zip(names, _COLOURS, strict=False))
    figure, panels = _panels(records, "Success in the evaluations during training", 2.1)
    for axes, groups in panels:
        for group in groups:
            _draw_band(axes, group, colours[method(group[0])])
        axes.axhline(LEARNED, color=OUTLINE, linewidth=0.6, linestyle=(0, (3, 2)))
        axes.set_xlim(left=0)  # a curve that starts later does so because of demonstrations
        _count_steps(axes)
    figure.axes[0].set_ylabel("successful episodes")
    _legend(figure, "median of the seeds, band from the least to the most successful")
    return figure


def _legend(figure: Figure, title: str) -> None:
    """One legend for all panels, below them."""
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


def _draw_band(axes: Axes, group: Group, colour: str) -> None:
    """Median over seeds, and the band from the least to the most successful one."""
    curves = [record["evaluations"] for record in group]
    steps = sorted({step for curve in curves for step in curve["steps"]})
    # A run that ended early is in the band as far as it went.
    rows = np.full((len(curves), len(steps)), np.nan)  # (seeds, evaluations)
    for row, curve in zip(rows, curves, strict=True):
        if curve["steps"]:
            row[np.searchsorted(steps, curve["steps"])] = curve["success_at_end"]
    label = method(group[0])
    if steps:
        axes.fill_between(
            steps, np.nanmin(rows, axis=0), np.nanmax(rows, axis=0), color=colour, alpha=0.2, lw=0
        )
        axes.plot(steps, np.nanmedian(rows, axis=0), color=colour, label=label, linewidth=1.4)


def penalty(records: Sequence[Record]) -> Figure:
    """Draw success and time below safe by penalty weight: a dot a seed, a bar at the mean."""
    title = "Goals that tempt towards the singularity, by penalty weight"
    figure, panels = _panels(records, title, 2.4)
    metrics = {
        "success_at_end": ("success", BLUE),
        "unsafe_share": ("time below safe", VERMILLION),
    }
    for axes, groups in panels:
        for place, (name, (label, colour)) in enumerate(metrics.items()):
            for index, group in enumerate(groups):
                values = [record["tests"]["pybullet"][name]["mean"] for record in group]
                x = index + 0.16 * (2 * place - 1)
                axes.plot([x] * len(values), values, "o", color=colour, alpha=0.6, markersize=4)
                axes.hlines(np.mean(values), x - 0.12, x + 0.12, color=colour, linewidth=1.6)
            axes.plot([], [], "o", color=colour, label=label)
        axes.set_xlim(-0.5, len(groups) - 0.5)
        axes.set_xticks(range(len(groups)), _weights([group[0] for group in groups]))
        axes.set_xlabel("penalty weight")
    _legend(figure, "a dot a seed, a bar at their mean")
    return figure


def _weights(records: Sequence[Record]) -> list[str]:
    """Penalty weights as labels, with what else sets the runs apart."""
    parts = [
        [method(record) for record in records],
        [f"{record['steps']:,}\nsteps" for record in records],
    ]
    telling = [part for part in parts if len(set(part)) > 1]
    weights = [f"{record['penalty_weight']:g}" for record in records]
    return ["\n".join(labels) for labels in zip(weights, *telling, strict=True)]


def robustness(records: Sequence[Record]) -> Figure:
    """Draw success against what differs: a panel an attribute, a line an id."""
    attributes = [name for name in LIMITS if any(r["attribute"] == name for r in records)]
    names = [name.replace("_", " ") for name in attributes]
    figure, panels = _grid(names, "Success of the published policies by what differs", 1.9)
    colours = dict(zip(sorted({record["env"] for record in records}), _COLOURS, strict=False))
    for attribute, axes in zip(attributes, panels, strict=True):
        for record in sorted(records, key=lambda r: (r["env"], r["engine"])):
            if record["attribute"] == attribute:
                rates = sorted(successes(record).items())
                axes.plot(
                    *zip(*rates, strict=True),
                    color=colours[record["env"]],
                    label=f"{record['env']}, {engine_of(record)}",
                    linestyle="--" if record["engine"] == "pybullet" else "-",
                    markerfacecolor="white" if record["engine"] == "pybullet" else None,
                    marker="o",
                    markersize=2.5,
                )
        axes.axhline(0.5, color=OUTLINE, linewidth=0.6, linestyle=(0, (3, 2)))
        axes.set_xlabel(UNITS.get(attribute, "factor"))
        if attribute not in UNITS:
            axes.set_xscale("log")
        ticks = sorted([nominal(attribute), *ends(attribute)])
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
    _legend(figure, "a dot a test; success halves near the dashed lines")
    return figure


# -- of one run -------------------------------------------------------------------------------


def draw_learning_curve(path: Path, title: str, evaluations: Sequence[Mapping[str, Any]]) -> None:
    """Draw the periodic evaluations of a run."""
    with style():
        figure = _figure(4.8, title)
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
        _draw_success(upper, evaluations)
        _draw_interval(lower, evaluations, "return", "95% interval (bootstrap)", "mean")
        lower.set_ylabel("return per episode")
        for axes in (upper, lower):
            axes.grid(linewidth=0.4)
            # To the right, where it covers no data.
            axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
        figure.align_ylabels([upper, lower])
        _count_steps(lower)
        _save(figure, path)


def _draw_success(axes: Axes, evaluations: Sequence[Mapping[str, Any]]) -> None:
    """Draw the success rates with the Wilson band of the one that counts."""
    steps = [evaluation["steps"] for evaluation in evaluations]
    once = [evaluation["success_once"]["mean"] for evaluation in evaluations]
    axes.plot(steps, once, color=GREEN, linewidth=1.2, linestyle=(0, (4, 2)), label="success once")
    _draw_interval(axes, evaluations, "success_at_end", "95% interval (Wilson)", "success at end")
    means = [evaluation["success_at_end"]["mean"] for evaluation in evaluations]
    best = max(range(len(means)), key=lambda i: (means[i], evaluations[i]["return"]["mean"]))
    label = f"best.zip ({means[best]:.0%})"
    axes.plot(
        *(steps[best], means[best], "*"),
        color=ORANGE,
        markersize=12,
        markeredgecolor="white",
        zorder=3,
        clip_on=False,
        label=label,
    )
    axes.set_ylim(-0.02, 1.04)
    axes.yaxis.set_major_formatter(PercentFormatter(xmax=1))
    axes.set_ylabel("successful episodes")
    axes.set_title(f"{evaluations[-1]['episodes']} episodes an evaluation, never trained on")


def _draw_interval(
    axes: Axes, evaluations: Sequence[Mapping[str, Any]], name: str, interval: str, mean: str
) -> None:
    steps = [evaluation["steps"] for evaluation in evaluations]
    low, means, high = (
        [evaluation[name][part] for evaluation in evaluations] for part in ("low", "mean", "high")
    )
    axes.fill_between(steps, low, high, color=BLUE, alpha=0.16, linewidth=0, label=interval)
    axes.plot(steps, means, color=BLUE, linewidth=1.6, marker="o", markersize=3, label=mean)
