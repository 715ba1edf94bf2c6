"""Tables and picture of bench_engines.py, in docs/engines.md."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from shared import ROOT, fill, processor_line, quartiles, read_record, spread, table

from tpm_gym.learning import figure_style as style
from tpm_gym.learning.figure_style import BLUE, ORANGE, PURPLE, SKY, VERMILLION

RECORD = ROOT / "docs" / "records" / "engines.json"
PICTURE = ROOT / "docs" / "images" / "engines.png"
PAGE = ROOT / "docs" / "engines.md"

MM = 1e3
COLUMNS = {
    "gap, largest (mm)": lambda row: f"{MM * row['gap_max']:.4f}",
    "P off FK, largest (mm)": lambda row: f"{MM * row['apart_max']:.3f}",
    "torque, RMS (N m)": lambda row: f"{row['torque_rms']:.3f}",
    "peak (N m)": lambda row: f"{row['torque_peak']:.1f}",
    "off PyBullet's": lambda row: f"{100 * row['off_engine']:.2f}%",
    "off theory": lambda row: _share(row["off_theory"]),
    "block apart, median (mm)": lambda row: _length(row["block_median"]),
    "largest (mm)": lambda row: _length(row["block_max"]),
}
COLOURS = {
    ("pybullet", "ideal"): BLUE,
    ("pybullet", "servo"): SKY,
    ("mujoco", "ideal"): VERMILLION,
    ("mujoco", "servo"): ORANGE,
}


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.2f}%"


def _length(value: float | None) -> str:
    return "-" if value is None else f"{MM * value:.2f}"


def publish() -> None:
    """Fill the page and draw the picture from the record."""
    record = read_record(RECORD)
    fill(PAGE, "engines", lines(record))
    draw(record)


def lines(record: dict[str, Any]) -> Iterator[str]:
    """Yield both tables in Markdown, with the computer and the cost."""
    yield f"`make bench-engines` on {processor_line(record['machine'])}."
    yield ""
    yield from table(
        ["motion", "engine", *COLUMNS],
        [
            [row["motion"], row["engine"], *(form(row) for form in COLUMNS.values())]
            for row in record["agreement"]
        ],
    )
    yield ""
    yield _costs(record)
    yield ""
    if "renewed" in record:
        command = record["renewed"]["command"]
        yield f"The parts named in this command were measured again later: `{command}`."
        yield ""
    heads = list(dict.fromkeys((row["engine"], row["drive"]) for row in record["matrix"]))
    yield from table(
        ["id", "policy", *(f"{engine}, {drive}" for engine, drive in heads)],
        [
            [env_id, policy, *(_success(cells[head]) for head in heads)]
            for (env_id, policy), cells in _by_policy(record).items()
        ],
    )


def _costs(record: dict[str, Any]) -> str:
    """Return a sentence on cost and energy."""
    cost = {engine: np.array(seconds) for engine, seconds in record["cost"].items()}
    first, *others = cost
    times = ", ".join(
        f"{engine} {1e3 * np.median(seconds):.3f} ms" for engine, seconds in cost.items()
    )
    ratios = []
    for engine in others:
        ratio = spread(quartiles(cost[first] / cost[engine]), "{:.2f}")
        ratios.append(f"{engine} {ratio} times as fast as {first}")
    lost = ", ".join(f"{name} {100 * share:.1f}%" for name, share in record["energy_lost"].items())
    return (
        f"A control step of `TPMPickAndPlace-v0` under random actions: {times}; "
        f"{'; '.join(ratios)} (median and quartiles of rounds in which the engines take turns). "
        f"Energy lost in a fall of 0.16 s, with the motors off: {lost}."
    )


def _by_policy(record: dict[str, Any]) -> dict[tuple[str, str], dict[tuple[str, str], Any]]:
    """Return the cells of the matrix by id and policy, then by engine and drive."""
    found: dict[tuple[str, str], dict[tuple[str, str], Any]] = {}
    for cell in record["matrix"]:
        row = found.setdefault((cell["env_id"], _name(cell)), {})
        row[cell["engine"], cell["drive"]] = cell["metrics"]["success_at_end"]
    return found


def _name(cell: dict[str, Any]) -> str:
    """Return the name of the policy in the table."""
    name = "published" if cell["policy"] == cell["env_id"] else cell["policy"]
    return f"{name}, trembling" if cell["noise"] else str(name)


def _success(estimate: dict[str, float]) -> str:
    low, mean, high = (100 * estimate[key] for key in ("low", "mean", "high"))
    return f"{mean:.1f}% [{low:.1f}, {high:.1f}]"


# -- picture -----------------------------------------------------------------------------------


def draw(record: dict[str, Any]) -> None:
    """Draw differences of torques, and success of each policy over engines and drives."""
    with style.style():
        figure = Figure(figsize=(style.WIDTH, 3.8))
        left, *right = figure.subplots(1, 3, width_ratios=(1.1, 1, 1))
        _agreement(left, record)
        ids = list(dict.fromkeys(cell["env_id"] for cell in record["matrix"]))
        for axes, env_id in zip(right, ids, strict=True):
            _matrix(axes, record, env_id)
        right[-1].set_yticklabels([])
        for axes, place, columns in ((left, 0.17, 1), (right[0], 0.72, 2)):
            figure.legend(
                *axes.get_legend_handles_labels(),
                loc="lower center",
                ncols=columns,
                bbox_to_anchor=(place, 0.0),
                frameon=False,
            )
        left.set_position((0.17, 0.28, 0.25, 0.64))
        right[0].set_position((0.53, 0.28, 0.215, 0.64))
        right[1].set_position((0.77, 0.28, 0.215, 0.64))
        style.save(figure, PICTURE)


def _agreement(axes: Axes, record: dict[str, Any]) -> None:
    rows = record["agreement"]
    names = list(dict.fromkeys(row["motion"] for row in rows))
    marks = (
        ("PyBullet off theory", "o", BLUE, "pybullet", "off_theory"),
        ("MuJoCo off theory", "s", VERMILLION, "mujoco", "off_theory"),
        ("MuJoCo off PyBullet", "D", PURPLE, "mujoco", "off_engine"),
    )
    for aside, (label, marker, colour, engine, key) in zip((-0.2, 0.0, 0.2), marks, strict=True):
        found = {row["motion"]: row[key] for row in rows if row["engine"] == engine}
        # Marks have different heights, so that none hides another.
        shown = [(found[name], at + aside) for at, name in enumerate(names) if found.get(name)]
        x, y = zip(*shown, strict=True)
        axes.plot(
            100 * np.array(x), y, marker, color=colour, label=label, markersize=5, mec="white"
        )
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set(xscale="log", xlabel="RMS difference of torques (%)")
    axes.set_title("Torques", loc="left")
    axes.grid(axis="x", color="0.92", linewidth=0.6)


def _matrix(axes: Axes, record: dict[str, Any], env_id: str) -> None:
    rows = {policy: row for (of, policy), row in _by_policy(record).items() if of == env_id}
    height = 0.8 / len(COLOURS)
    for k, (head, colour) in enumerate(COLOURS.items()):
        values = np.array(
            [[row[head][q] for q in ("low", "mean", "high")] for row in rows.values()]
        )
        at = np.arange(len(rows)) + (k - (len(COLOURS) - 1) / 2) * height
        axes.barh(at, 100 * values[:, 1], 0.9 * height, color=colour, label=", ".join(head))
        spread = 100 * np.abs(values[:, [0, 2]].T - values[:, 1])
        axes.errorbar(100 * values[:, 1], at, xerr=spread, fmt="none", ecolor="0.3", lw=0.6)
    axes.set_yticks(range(len(rows)), [name.replace(", ", ",\n") for name in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set(xlim=(0, 103), xlabel="success at end (%)")
    axes.set_title(env_id, loc="left")
