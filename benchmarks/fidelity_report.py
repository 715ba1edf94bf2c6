"""Table, JSON and picture of the fidelity sweep, in docs/loops-sweep.md."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from fidelity_sweep import QUANTITIES, Result, pareto
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator
from shared import ROOT, fill, provenance, read_record, table

from tpm_gym.learning import figure_style as style
from tpm_gym.learning.figure_style import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION

JSON = ROOT / "runs" / "fidelity.json"
PICTURE = ROOT / "docs" / "images" / "fidelity.png"
PAGE = ROOT / "docs" / "loops-sweep.md"

MM = 1e3
UNITS = {"gap": MM, "fk": MM, "fk_near": MM, "tilt": float(np.rad2deg(1.0)), "tracking": MM}
FAMILIES = {
    "direct": (BLUE, "o", "direct solver"),
    "structure": (GREEN, "D", "other joints, other cuts"),
    "torque": (PURPLE, "P", "torque control"),
    "LCP PGS": (SKY, "v", "LCP by PGS"),
    "iterative": (VERMILLION, "s", "iterative solver"),
    "one body": (ORANGE, "^", "one multibody, iterative"),
}
COLUMNS = (
    "configuration", "µs a step", "ms a period", "ratio",
    "gap mean", "99.9 %", "max", "FK 99.9 %", "max", "near y = 0", "tilt max", "track max",
)  # fmt: skip
LEGEND = (
    "Gap is the largest gap of the four closures. FK is the distance of the platform from the "
    "forward kinematics of the encoders where 1/cond(J) > 0.05; "
    'the column "near y = 0" has the largest such '
    "distance where 1/cond(J) is smaller. Track is the distance of the platform from its "
    "reference. These columns are in mm, tilt is in degrees. Mean, 99.9% "
    "and max are those of all time steps of the three motions. Cost is the CPU time of "
    "stepSimulation and the motor commands, with the robot alone in the scene. "
    "The ratio compares the cost of a control period with that of the default "
    "in the same round of timing."
)


def cells(result: Result) -> list[str]:
    """Return a row of the table."""
    c, lost = result.config, ", ".join(f"{name} {n}" for name, n in result.lost.items())
    if np.isfinite(result.step_time):
        cost = [f"{1e6 * result.step_time:.0f}", f"{1e3 * result.period_time:.2f}"]
        cost.append(f"{np.median(result.ratios):.2f}")
    else:
        cost = ["-"] * 3
    values = [("gap", "mean"), ("gap", "p999"), ("gap", "maximum"), ("fk", "p999")]
    values += [(name, "maximum") for name in ("fk", "fk_near", "tilt", "tracking")]
    shown = [_number(getattr(result.overall[q], s), UNITS[q]) for q, s in values]
    name = f"{c.name} (lost at step: {lost})" if lost else c.name
    return [name, *cost, *shown]


def _number(value: float | None, unit: float) -> str:
    if value is None:
        return "-"
    scaled = value * unit
    return f"{scaled:.1e}" if scaled < 5e-4 else f"{scaled:#.3g}".rstrip(".")


def print_table(results: Sequence[Result]) -> None:
    """Print the table by families, with aligned columns."""
    rows = [list(COLUMNS), *(cells(result) for result in results)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(COLUMNS))]
    family = ""
    for row, result in zip(rows, [None, *results], strict=True):
        if result is not None and result.config.family != family:
            family = result.config.family
            print()
        text = [cell.ljust(w) if k == 0 else cell.rjust(w)
                for k, (cell, w) in enumerate(zip(row, widths, strict=True))]  # fmt: skip
        print("  ".join(text))
    print(f"\n{LEGEND}")


def write_json(results: Sequence[Result], description: dict[str, Any], path: Path = JSON) -> None:
    """Write the description of the computer and all results, in SI units."""
    provenance.write_json(path, {**description, "results": [r.as_json() for r in results]})


def read_json(path: Path = JSON) -> tuple[list[Result], dict[str, Any]]:
    """Read the results and the description of :func:`write_json`."""
    description = read_record(path)
    return [Result.from_json(row) for row in description.pop("results")], description


def write_page(results: Sequence[Result], machine: str) -> None:
    """Write the table to docs/loops-sweep.md."""
    rows = [
        [f"**{cell}**" for cell in cells(result)]
        if result.config.family == "default"
        else cells(result)
        for result in results
    ]
    note = f"`make bench-fidelity` on {machine}. {LEGEND}"
    fill(PAGE, "sweep", [note, "", *table(list(COLUMNS), rows)])


# -- picture -----------------------------------------------------------------------------------

PANELS = (
    ("gap", "Largest loop gap (mm)"),
    ("fk", "Platform against FK (mm)"),
    ("tilt", "Tilt (degrees)"),
)
SERIES = tuple(
    [f"1/{rate} s, {n} iterations" for n in counts]
    for rate, counts in ((250, (25, 50, 100, 200, 400)), (500, (25, 50, 100, 200)))
)
"""Rows with increasing iterations, which a thin line joins in the picture."""
LABELS: dict[str, dict[str, tuple[str, tuple[float, float], str]]] = {
    "gap": {
        "default": ("default", (-5, -10), "right"),
        "1/125 s": ("1/125 s", (0, -12), "center"),
        "1/500 s": ("1/500 s", (5, 4), "left"),
        "1/1000 s": ("1/1000 s", (-6, -3), "right"),
        "erp 0.2": ("erp 0.2", (-6, 1), "right"),
        "erp 0.5": ("erp 0.5", (-6, -3), "right"),
        "erp 0.8": ("erp 0.8", (-6, -2), "right"),
        "1/250 s, 25 iterations": ("25 iterations, 1/250 s", (6, -2), "left"),
        "1/250 s, 400 iterations": ("400", (4, 3), "left"),
        "1/500 s, 100 iterations": ("1/500 s", (-5, -5), "right"),
        "1/500 s, 200 iterations": ("200", (4, -10), "center"),
    },
    "tilt": {"CFM 0": ("CFM 0", (-6, -3), "right"), "CFM 1e-06": ("CFM 1e-6", (6, -3), "left")},
}
"""Text, offset in points and alignment of labels, by panel and row."""


def draw(results: Sequence[Result], machine: str, path: Path = PICTURE) -> None:
    """Draw each error over the cost, with the Pareto front."""
    held = [result for result in results if not result.lost]
    with style.style():
        figure = Figure(figsize=(style.WIDTH, 3.9))
        for axes, (quantity, title) in zip(figure.subplots(1, 3), PANELS, strict=True):
            _panel(axes, held, quantity)
            axes.set_title(title, loc="left")
        title = "Largest error over all motions against the cost of the physics"
        figure.text(0.5, 0.985, title, ha="center", va="top", fontsize=11, weight="bold")
        lost = (
            f"{len(results) - len(held)} of {len(results)} settings lost the mechanism: not shown"
        )
        figure.text(0.5, 0.925, f"{machine}; {lost}", ha="center", va="top", fontsize=7)
        handles = _handles({result.config.family for result in held})
        figure.legend(handles=handles, loc="lower center", ncols=4, columnspacing=1.6)
        figure.subplots_adjust(left=0.06, right=0.985, top=0.83, bottom=0.25, wspace=0.2)
        path.parent.mkdir(parents=True, exist_ok=True)
        style.save(figure, path)


def _handles(families: set[str]) -> list[Line2D]:
    marks = [
        Line2D([], [], linestyle="", marker=marker, color=colour, markersize=5, label=label)
        for family, (colour, marker, label) in FAMILIES.items()
        if family in families
    ]
    star = Line2D([], [], linestyle="", marker="*", color=BLACK, markersize=9, label="default")
    front = Line2D([], [], color=BLACK, linewidth=0.8, label="Pareto front")
    return [star, front, *marks]


def _panel(axes: Axes, held: Sequence[Result], quantity: str) -> None:
    # Ratios within a round vary less than times.
    unit = 1e3 * held[0].period_time
    costs = np.array([unit * np.median(r.ratios) for r in held])
    errors = np.array([r.overall[quantity].maximum or 0.0 for r in held]) * UNITS[quantity]
    front = pareto(costs, errors)
    axes.step(costs[front], errors[front], where="post", color=BLACK, linewidth=0.8, zorder=1)
    places = {r.config.name: (c, e) for r, c, e in zip(held, costs, errors, strict=True)}
    for names in SERIES:
        x, y = zip(*(places[name] for name in names if name in places), strict=True)
        axes.plot(x, y, color=VERMILLION, linewidth=0.6, alpha=0.6, zorder=1)
    for result in held:
        known = FAMILIES.get(result.config.family)
        colour, marker, size = (known[0], known[1], 5.0) if known else (BLACK, "*", 11.0)
        axes.plot(*places[result.config.name], marker, color=colour, markersize=size, mec="white",
                  mew=0.4, zorder=3 if known else 5)  # fmt: skip
        if result.config.name in LABELS.get(quantity, {}):
            text, offset, side = LABELS[quantity][result.config.name]
            axes.annotate(text, places[result.config.name], offset, textcoords="offset points",
                          ha=side, fontsize=6.5, color=colour)  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="ms of CPU a control period (40 ms)")
    ticks = [t for t in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20) if costs.min() / 2 < t < costs.max() * 2]
    axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_xlim(costs.min() / 1.35, costs.max() * 1.35)
    axes.grid(color="0.92", linewidth=0.6)
    axes.set_axisbelow(True)


assert set(UNITS) == set(QUANTITIES)
