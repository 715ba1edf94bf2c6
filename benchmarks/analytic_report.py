"""Tables and picture of bench_engine.py, in docs/speed.md."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from shared import ROOT, fill, processor_line, provenance, quartiles, read_record, spread, table

from tpm_gym.learning import figure_style as style
from tpm_gym.learning.figure_style import BLUE, GREEN, ORANGE, VERMILLION

RECORD = ROOT / "docs" / "records" / "analytic.json"
PICTURE = ROOT / "docs" / "images" / "analytic.png"
PAGE = ROOT / "docs" / "speed.md"
PICK = "TPMPickAndPlace-v0"
COLOURS = {"expert": BLUE, "random": VERMILLION}


def write(record: dict[str, Any]) -> None:
    """Write the parts that were run to the record, and keep its other parts."""
    provenance.write_json(RECORD, read_record(RECORD) | record)


def publish() -> None:
    """Fill the page and draw the picture from the record."""
    record = read_record(RECORD)
    fill(PAGE, "analytic", lines(record))
    if {"speed", "torques"} <= record.keys():
        draw(record)


def lines(record: dict[str, Any]) -> Iterator[str]:
    """Yield all tables in Markdown."""
    for name, part in record.items():
        yield f"{_TITLES[name]} `make bench-engine` on {processor_line(part['machine'])}."
        yield ""
        yield from _TABLES[name](part["rows"])
        yield ""


def _speed(rows: dict[str, Any]) -> Iterator[str]:
    yield from table(
        ["environment", "engine", "steps/s", "times PyBullet's"],
        [
            [name.split(", ")[0], _engine(name), _quartiles(row["rates"], "{:,.0f}"), _times(row)]
            for name, row in rows["rates"].items()
        ],
    )
    yield ""
    taken = _quartiles(rows["evaluation"], "{:.2f}")
    policy = f"the published policy of {PICK}"
    yield f"1000 episodes of {policy}, including their statistics, take {taken} s."


def _engine(name: str) -> str:
    _, *rest = name.split(", ")
    if len(rest) < 3:
        return rest[0] if rest else "its own"
    return f"analytic, {int(rest[2]):,} environments, torques: {rest[1]}"


def _times(row: dict[str, Any]) -> str:
    if row["ratio"] is None:
        return "-"
    return _quartiles(row["ratio"], "{:.0f}" if min(row["ratio"]) >= 10 else "{:.1f}")


def _threads(rows: list[dict[str, Any]]) -> Iterator[str]:
    yield from table(
        ["drives", "environments", "one thread, steps/s", "two threads, steps/s", "ratio"],
        [
            [
                row["drive"],
                f"{row['count']:,}",
                _quartiles(row["one"], "{:,.0f}"),
                _quartiles(row["two"], "{:,.0f}"),
                _quartiles(
                    [two / one for one, two in zip(row["one"], row["two"], strict=True)], "{:.2f}"
                ),
            ]
            for row in rows
        ],
    )


def _torques(rows: list[dict[str, Any]]) -> Iterator[str]:
    yield from table(
        [
            "actions",
            "time steps a second",
            "torque off, relative RMS",
            "conditioning off",
            "observation off",
        ],
        [
            [
                row["policy"],
                str(row["rate"]),
                f"{100 * row['torque']:.3f}%",
                f"{row['conditioning']:.1e}",
                f"{row['observation']:.1e}",
            ]
            for row in rows
        ],
    )


def _success(rows: list[dict[str, Any]]) -> Iterator[str]:
    yield from table(
        ["id", "policy", "episodes", "PyBullet", "analytic", "same end after the same actions"],
        [
            [
                row["env_id"],
                ("expert" if row["policy"] == "expert" else "published")
                + (", trembling" if row["noise"] else ""),
                f"{row['episodes']:,}",
                *(f"{100 * row[name]:.1f}%" for name in ("pybullet", "analytic", "equal")),
            ]
            for row in rows
        ],
    )


_TITLES = {
    "speed": "Control steps a second, summed over the environments: "
    "median and quartiles of several rounds.",
    "threads": f"Control steps a second of {PICK}, summed over the environments, "
    "with one and two threads.",
    "torques": "Torques, where nothing is touched.",
    "success": "Success at the end of the same episodes.",
}
_TABLES = {"speed": _speed, "threads": _threads, "torques": _torques, "success": _success}


def _quartiles(values: list[float], form: str) -> str:
    return spread(quartiles(values), form)


def draw(record: dict[str, Any]) -> None:
    """Draw speed over the number of environments, and torques over the time step."""
    with style.style():
        figure = Figure(figsize=(style.WIDTH, 2.7), layout="constrained")
        left, right = figure.subplots(1, 2)
        _draw_speed(left, record["speed"]["rows"]["rates"])
        _draw_torques(right, record["torques"]["rows"])
        style.save(figure, PICTURE)


def _draw_speed(axes: Axes, rates: dict[str, Any]) -> None:
    form = f"{PICK}, analytic, none, "
    counts = sorted(int(name.removeprefix(form)) for name in rates if name.startswith(form))
    spread = np.array([quartiles(rates[f"{form}{count}"]["rates"]) for count in counts])
    axes.fill_between(counts, spread[:, 0], spread[:, 2], color=BLUE, alpha=0.25, linewidth=0)
    axes.plot(counts, spread[:, 1], "o-", color=BLUE, markersize=3, label="analytic")
    for name, label, colour in (
        (f"{PICK}, pybullet", "PyBullet", VERMILLION),
        ("PandaPickAndPlace-v3", "PandaPickAndPlace-v3", GREEN),
    ):
        rate = quartiles(rates[name]["rates"])[1]
        axes.axhline(rate, color=colour, linewidth=1, label=f"one {label}")
    axes.set(xscale="log", yscale="log", xlabel="environments at a time")
    axes.set_title(f"steps/s of {PICK}, one core", loc="left")
    axes.legend(loc="upper left", frameon=False)
    axes.grid(alpha=0.3, linewidth=0.4)


def _draw_torques(axes: Axes, rows: list[dict[str, Any]]) -> None:
    for policy, colour in COLOURS.items():
        own = [row for row in rows if row["policy"] == policy]
        steps = [1e3 / row["rate"] for row in own]
        axes.plot(steps, [100 * row["torque"] for row in own], "o-", color=colour, markersize=3)
        axes.annotate(
            policy,
            (steps[0], 100 * own[0]["torque"]),
            (4, 0),
            textcoords="offset points",
            color=colour,
            va="center",
        )
    axes.set(xscale="log", yscale="log", xlabel="time step of PyBullet (ms)")
    axes.set_xticks(steps, [f"{value:g}" for value in steps])
    axes.set_xticks([], minor=True)
    axes.set_xlim(right=9)
    axes.axvline(4.0, color=ORANGE, linewidth=0.8, linestyle=":")
    axes.set_title("torques off PyBullet's, relative RMS (%)", loc="left")
    axes.grid(alpha=0.3, linewidth=0.4)
