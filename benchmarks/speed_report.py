"""Tables and figure of bench_speed.py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from shared import processor_line, spread

from tpm_gym.learning import figure_style as style

__all__ = ["TARGETS", "print_report", "save_plot"]

TARGETS = {"ratio_to_baseline": 1.3, "step_over_with_motors": 1.4, "two_over_one": 1.8}
"""Targets of TPMPickAndPlace-v0: least steps/s over the baseline, most time of env.step over its
raw physics with motors, least steps/s of two processes over one."""
_OURS = "TPMPickAndPlace-v0"


def _spread(values: tuple[float, float, float], digits: int) -> str:
    return spread(values, f"{{:.{digits}f}}")


def print_report(content: dict[str, Any]) -> None:
    """Print all tables."""
    print(processor_line(content))
    print(
        f"{content['rounds']} rounds of {content['steps']} steps each, order shuffled; "
        "medians and quartiles; ratios within each round"
    )
    _print_race(content)
    _print_floor(content["contestants"])
    if content["scaling"] is not None:
        _print_scaling(content["scaling"])
    _print_verdicts(content)


def _print_race(content: dict[str, Any]) -> None:
    """Print steps per second, ratios to the baseline, and resets."""
    baseline = content["baseline"]
    print(f"\n{'environment':<29} {'steps/s with resets':<20} {'over ' + baseline:<26} reset (ms)")
    entries = content["contestants"]
    for env_id, entry in entries.items():
        ratio = entry.get("ratio_to_baseline")
        reset = entry.get("reset_milliseconds")
        print(
            f"{env_id:<29} {_spread(entry['steps_per_second'], 0):<20} "
            f"{'-' if ratio is None else _spread(ratio, 2):<26} "
            f"{'-' if reset is None else _spread(reset, 2)}"
        )
    for env_id, reason in content["unavailable"].items():
        print(f"{env_id:<29} not available: {reason}")


def _print_floor(entries: dict[str, Any]) -> None:
    """Print the time of env.step and of its raw physics."""
    ours = {env_id: entry for env_id, entry in entries.items() if "step_milliseconds" in entry}
    if not ours:
        return
    print(
        f"\n{'env.step over raw physics':<29} {'step (ms)':<20} {'stepSimulation (ms)':<21} "
        f"{'over it':<20} {'with motors (ms)':<20} over it"
    )
    for env_id, entry in ours.items():
        print(
            f"{env_id:<29} {_spread(entry['step_milliseconds'], 3):<20} "
            f"{_spread(entry['physics_milliseconds'], 3):<21} "
            f"{_spread(entry['step_over_physics'], 2):<20} "
            f"{_spread(entry['with_motors_milliseconds'], 3):<20} "
            f"{_spread(entry['step_over_with_motors'], 2)}"
        )


def _print_scaling(scaling: dict[str, Any]) -> None:
    """Print the speed of one process and of two."""
    print(
        f"\nscaling, {scaling['env_id']}, {scaling['rounds']} rounds of {scaling['steps']} steps "
        "a process"
    )
    for name, ratio in (
        ("one_process", None),
        ("two_processes", "two_over_one"),
        ("sync_vector_env", None),
        ("async_vector_env", "async_over_sync"),
    ):
        against = "" if ratio is None else f"{_spread(scaling[ratio], 2)} times the line above"
        print(f"{name.replace('_', ' '):<29} {_spread(scaling[name], 0):<20} {against}".rstrip())


def _print_verdicts(content: dict[str, Any]) -> None:
    """Print each target and its measurement."""
    entry = content["contestants"].get(_OURS, {})
    found = [
        ("ratio_to_baseline", entry.get("ratio_to_baseline"),
         f"{_OURS} over {content['baseline']}", True),
        ("step_over_with_motors", entry.get("step_over_with_motors"),
         "env.step over its raw physics with motors", False),
        ("two_over_one", (content["scaling"] or {}).get("two_over_one"),
         "two processes over one", True),
    ]  # fmt: skip
    print()
    for name, values, what, larger in found:
        limit = TARGETS[name]
        bound = f"at {'least' if larger else 'most'} {limit}"
        if values is None:
            print(f"not measured: {what} ({bound})")
            continue
        met = values[1] >= limit if larger else values[1] <= limit
        print(f"{'met' if met else 'MISSED'}: {what} {_spread(values, 2)} ({bound})")


def save_plot(content: dict[str, Any], path: Path) -> None:
    """Draw steps per second of all contestants as bars with their quartiles."""
    with style.style():
        style.save(_figure(content), path)


def _figure(content: dict[str, Any]) -> Figure:
    """Return the figure, the fastest contestant on top."""
    entries = sorted(
        content["contestants"].items(), key=lambda item: item[1]["steps_per_second"][1]
    )
    height = 0.85 + 0.24 * len(entries)
    figure = Figure(figsize=(style.WIDTH, height))
    axes = figure.add_axes((0.255, 0.42 / height, 0.725, (height - 0.95) / height))
    _bars(axes, entries, content["baseline"])
    figure.text(
        0.5, 1 - 0.08 / height, "Control steps a second", ha="center", va="top", fontsize=11,
        weight="bold",
    )  # fmt: skip
    figure.text(
        0.5, 1 - 0.29 / height,
        f"25 Hz control, one process, random actions, resets included; median and quartiles of "
        f"{content['rounds']} rounds",
        ha="center", va="top", fontsize=8,
    )  # fmt: skip
    return figure


def _bars(axes: Axes, entries: list[tuple[str, Any]], baseline: str) -> None:
    """Draw a bar for each environment, with its quartiles and its ratio to the baseline."""
    right = max(entry["steps_per_second"][2] for _, entry in entries)
    for row, (env_id, entry) in enumerate(entries):
        low, middle, high = entry["steps_per_second"]
        ours = env_id.startswith("TPM")
        axes.barh(row, middle, 0.68, color=style.BLUE if ours else style.OUTLINE)
        axes.errorbar(
            middle, row, xerr=[[middle - low], [high - middle]], color=style.BLACK, lw=1.0,
            capsize=2.5,
        )  # fmt: skip
        text = f"{middle:.0f}"
        if "ratio_to_baseline" in entry and env_id != baseline:
            text += f"   {entry['ratio_to_baseline'][1]:.2f} x"
        axes.text(high + 0.012 * right, row, text, va="center", fontsize=7.5)
    axes.set_yticks(range(len(entries)), [env_id for env_id, _ in entries])
    for label, (env_id, _) in zip(axes.get_yticklabels(), entries, strict=True):
        label.set_color(style.BLUE if env_id.startswith("TPM") else style.BLACK)
    axes.set_ylim(-0.6, len(entries) - 0.4)
    axes.set_xlim(0, 1.16 * right)
    several = any("ratio_to_baseline" in entry for _, entry in entries)
    axes.set_xlabel(f"steps/s    (x: times {baseline})" if several else "steps/s")
    axes.tick_params(axis="y", length=0)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.xaxis.grid(True, color=style.REACHED, lw=0.8)
    axes.set_axisbelow(True)
