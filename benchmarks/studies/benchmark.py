"""Text and figure of docs/benchmark.md: all ids over five seeds, as a paper would print them."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

import tpm_gym
from tpm_gym.learning.estimates import Estimate
from tpm_gym.learning.figure_style import BLUE, OUTLINE, VERMILLION, WIDTH, save, style

from .page import ENGINES, LEARNED, Frame, groups, render, split
from .plan import Study, plan_runs
from .records import Record
from .reliability import interquartile_mean, profile

PLAN: Final = Study("benchmark", engine="analytic")
PICTURE: Final = "benchmark.png"

_COLOURS: Final = {"analytic": BLUE, "pybullet": VERMILLION}
_RATE, _STEPS, _SECONDS = "{:.1f}", "{:,.0f}", "{:,.0f}"


def page(records: Sequence[Record], figures: Sequence[str]) -> str:
    """Return the page as Markdown.

    Args:
        records: All records.
        figures: File names of the figures to show.
    """
    runs, planned = benchmarked(records), plan_runs(PLAN)
    ids = {run.env for run in planned}
    return render(
        "benchmark.md.j2",
        seeds=PLAN.seeds,
        table=_table(runs),
        missing=len(planned) - len(runs),
        planned=len(planned),
        without=[env for env in tpm_gym.ENV_IDS if env not in ids],
        figures=figures,
    )


def benchmarked(records: Sequence[Record]) -> Frame:
    """Return the runs of the plan, a row for each."""
    names = {run.folder.name for run in plan_runs(PLAN)}
    return split([record for record in records if record["run"] in names])[0]


def _table(runs: Frame) -> Frame:
    """Return a row for each id, and for each method with several ids."""
    found = groups(runs)
    rows = [(first.env, first.method, [g]) for g in found for first in g.head(1).itertuples()]
    methods = [(name, list(groups(of))) for name, of in runs.groupby("method")]
    rows += [(f"all {len(of)}", name, of) for name, of in methods if len(of) > 1]
    if len(found) > 1:
        rows.append((f"all {len(found)}", "all", found))
    return pd.DataFrame([_row(*row) for row in rows])


def _row(name: str, method: str, of: Sequence[Frame]) -> dict[str, str]:
    success = {
        f"success, % ({label})": _cell(_successes(of, engine, 100.0), _RATE)
        for engine, label in ENGINES.items()
    }
    times = {"steps": ("learned_steps", 1.0, _STEPS), "seconds": ("learned_seconds", 1.0, _SECONDS)}
    return {
        "id": name,
        "method": method,
        "runs": str(sum(map(len, of))),
        **success,
        **{
            f"{unit} to {LEARNED:.0%}": _cell(
                interquartile_mean([group[column] * factor for group in of]), form
            )
            for unit, (column, factor, form) in times.items()
        },
    }


def _successes(of: Sequence[Frame], engine: str, factor: float = 1.0) -> Estimate:
    return interquartile_mean([factor * scores for scores in _scores(of, engine)])


def _scores(of: Sequence[Frame], engine: str) -> list[Any]:
    """Return the success rates of each id's seeds; a run without a test has 0."""
    return [group[f"{engine}.success_at_end.mean"].fillna(0.0).to_numpy() for group in of]


def _cell(estimate: Estimate, form: str) -> str:
    mean, low, high = (
        form.format(value) if np.isfinite(value) else "never"
        for value in (estimate.mean, estimate.low, estimate.high)
    )
    return f"{mean} [{low}, {high}]"


def draw(records: Sequence[Record], folder: Path) -> Iterator[Path]:
    """Draw the figure, if there are runs; yield its file."""
    runs = benchmarked(records)
    if len(runs):
        with style():
            save(figure(groups(runs)), folder / PICTURE)
        yield folder / PICTURE


def figure(of: Sequence[Frame]) -> Figure:
    """Draw success with intervals for each id, and the performance profile of all runs."""
    drawn = Figure(figsize=(WIDTH, max(2.4, 0.22 * len(of) + 1.0)), layout="constrained")
    left, right = drawn.subplots(1, 2, width_ratios=(3, 2))
    _intervals(left, of)
    _profiles(right, of)
    drawn.legend(*right.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return drawn


def _intervals(axes: Axes, of: Sequence[Frame]) -> None:
    names = [f"{g['env'].iloc[0]}, {g['method'].iloc[0]}" for g in of]
    rows = [*((name, [group]) for name, group in zip(names, of, strict=True)), ("all", list(of))]
    for shift, engine in zip((-0.16, 0.16), ENGINES, strict=True):
        for row, (_, part) in enumerate(rows):
            found, colour = _successes(part, engine), _COLOURS[engine]
            axes.hlines(row + shift, found.low, found.high, colour, linewidth=4, alpha=0.35)
            axes.plot(found.mean, row + shift, "|", color=colour, ms=6, mew=1.6)
    axes.set_yticks(range(len(rows)), [name for name, _ in rows])
    axes.invert_yaxis()
    axes.axvline(LEARNED, color=OUTLINE, linewidth=0.6, linestyle=(0, (3, 2)))
    axes.xaxis.set_major_formatter(PercentFormatter(xmax=1, decimals=0))
    axes.set_xlabel("interquartile mean of success")


def _profiles(axes: Axes, of: Sequence[Frame]) -> None:
    lowest = min(scores.min() for engine in ENGINES for scores in _scores(of, engine))
    limits = np.linspace(np.floor(20 * lowest) / 20, 1.0, 201)
    for engine, label in ENGINES.items():
        share, low, high = profile(_scores(of, engine), limits)
        axes.fill_between(limits, low, high, step="pre", color=_COLOURS[engine], alpha=0.2, lw=0)
        axes.step(limits, share, where="pre", color=_COLOURS[engine], label=label, linewidth=1.4)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(PercentFormatter(xmax=1, decimals=0))
    axes.set_xlabel("success of at least")
    axes.set_ylabel("share of runs")
