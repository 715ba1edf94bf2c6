"""Verdict and figure of soak.py."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from shared import processor_line

from tpm_gym.learning import figure_style as style

__all__ = ["judge", "print_verdict", "save_plot"]

SIGMAS = 3.0
"""A drift has a slope of more than this number of standard errors, ..."""
NEGLIGIBLE = 0.01
"""... and changes the mean by more than this share over the run."""
_MOST_SHOWN = 20  # failures printed one by one


def settled(content: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the samples after the warm-up; the first one is the baseline."""
    return [
        sample
        for sample in content["samples"]
        if sample["steps"] >= content["warm_up"] and sample["all_opened"]
    ]


def judge(content: dict[str, Any]) -> dict[str, Any]:
    """Return the verdict on the samples; entries with too few samples are None, and do not pass."""
    samples = settled(content)
    memory, drift = _memory(samples), _drift(samples)
    within = memory is not None and memory["growth_mb"] <= content["limit_mb"]
    steady = drift is not None and not drift["found"]
    return {
        "memory": memory,
        "memory_within_limit": within,
        "closure_drift": drift,
        "no_closure_drift": steady,
        "speed": _speed(samples),
        "nothing_raised": not content["failures"],
        "passed": within and steady and not content["failures"] and content["finished"],
    }


def _memory(samples: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Return the growth of memory from the baseline to the end."""
    if len(samples) < 2:
        return None
    values = [sample["memory_mb"] for sample in samples]
    line = _line(samples, "memory_mb")
    return {
        "baseline_steps": samples[0]["steps"],
        "baseline_mb": values[0],
        "end_mb": values[-1],
        "growth_mb": values[-1] - values[0],
        "largest_growth_mb": max(values) - values[0],
        "slope_mb_per_million_steps": None if line is None else line["slope"],
    }


def _drift(samples: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Return the slope of the mean closure error of the windows, m per million steps."""
    line = _line(samples, "closure_mean")
    if line is None:
        return None
    gaps = [sample for sample in samples if sample["closure_max"] is not None]
    tenth = max(1, len(gaps) // 10)
    span = (gaps[-1]["steps"] - gaps[0]["steps"]) / 1e6
    significant = line["slope"] > SIGMAS * line["standard_error"]
    return line | {
        "found": significant and line["slope"] * span > NEGLIGIBLE * line["mean"],
        "largest_first_tenth": max(sample["closure_max"] for sample in gaps[:tenth]),
        "largest_last_tenth": max(sample["closure_max"] for sample in gaps[-tenth:]),
        "largest": max(sample["closure_max"] for sample in gaps),
    }


def _line(samples: list[dict[str, Any]], name: str) -> dict[str, float] | None:
    """Fit a line to (million steps, value) by least squares; None with fewer than 4 samples."""
    kept = [sample for sample in samples if sample[name] is not None]
    if len(kept) < 4:
        return None
    x = np.array([sample["steps"] for sample in kept]) / 1e6
    y = np.array([sample[name] for sample in kept])
    centred = x - x.mean()
    spread = float(centred @ centred)
    slope = float(centred @ y) / spread
    left = y - y.mean() - slope * centred
    error = math.sqrt(float(left @ left) / (len(kept) - 2) / spread)
    return {
        "slope": slope,
        "standard_error": error,
        "mean": float(y.mean()),
        "middle": float(x.mean()),
    }


def _speed(samples: list[dict[str, Any]]) -> dict[str, float] | None:
    """Return the median steps per second of the first and the last tenth."""
    if not samples:
        return None
    rates = [sample["steps_per_second"] for sample in samples]
    tenth = max(1, len(rates) // 10)
    return {"start": float(np.median(rates[:tenth])), "end": float(np.median(rates[-tenth:]))}


def print_verdict(content: dict[str, Any]) -> None:
    """Print the events and the verdict."""
    verdict, samples = content["verdict"], content["samples"]
    print(processor_line(content))
    done = samples[-1]["steps"] if samples else 0
    state = "" if content["finished"] else f" of {content['steps']}: NOT FINISHED"
    events = ", ".join(f"{count} {name}" for name, count in content["events"].items())
    print(f"{done} steps{state}; {events}")
    for failure in content["failures"][:_MOST_SHOWN]:
        print(
            f"RAISED {failure['env_id']}, --seed {failure['seed']} --replay {failure['visit']}, "
            f"episode {failure['episode']} step {failure['step']}: {failure['error']}"
        )
    print(f"{len(content['failures'])} exceptions")
    print(_memory_line(content))
    print(_drift_line(verdict["closure_drift"]))
    if verdict["speed"] is not None:
        print("speed: {start:.0f} steps/s at the start, {end:.0f} at the end".format(
            **verdict["speed"]))  # fmt: skip
    print("PASSED" if verdict["passed"] else "FAILED")


def _memory_line(content: dict[str, Any]) -> str:
    """Return a sentence on memory at the end and at the baseline."""
    memory = content["verdict"]["memory"]
    if memory is None:
        return "memory: not known, too few samples after the warm-up"
    slope = memory["slope_mb_per_million_steps"]
    return (
        f"memory ({content['memory_kind']}): {memory['growth_mb']:+.2f} MB from the baseline "
        f"(sample at {memory['baseline_steps']} steps, {memory['baseline_mb']:.1f} MB; "
        f"{content['memory_before_mb']:.1f} MB before the first environment), at most "
        f"{memory['largest_growth_mb']:+.2f} MB on the way, limit {content['limit_mb']:.0f} MB"
        + ("" if slope is None else f"; slope {slope:+.2f} MB a million steps")
    )


def _drift_line(drift: dict[str, Any] | None) -> str:
    """Return a sentence on the slope of the closure error."""
    if drift is None:
        return "closure error: drift not known, too few samples after the warm-up"
    return (
        f"closure error: mean {1e6 * drift['mean']:.3f} um, slope {1e6 * drift['slope']:+.3f} "
        f"+- {1e6 * drift['standard_error']:.3f} um a million steps (standard error): "
        f"{'DRIFT' if drift['found'] else 'no drift'} (more than {SIGMAS:.0f} standard errors and "
        f"{NEGLIGIBLE:.0%} of the mean); largest {1e6 * drift['largest']:.1f} um, first tenth "
        f"{1e6 * drift['largest_first_tenth']:.1f}, last tenth "
        f"{1e6 * drift['largest_last_tenth']:.1f}"
    )


def save_plot(content: dict[str, Any], path: Path) -> None:
    """Draw memory, closure error and speed over the steps."""
    with style.style():
        style.save(_figure(content), path)


def _figure(content: dict[str, Any]) -> Figure:
    """Return three panels, one above the other."""
    figure = Figure(figsize=(style.WIDTH, 5.4))
    panels = figure.subplots(3, 1, sharex=True)
    figure.subplots_adjust(left=0.095, right=0.98, top=0.885, bottom=0.075, hspace=0.14)
    done = content["samples"][-1]["steps"]
    figure.text(
        0.5, 0.985, f"Endurance: {done:,} steps over all environments", ha="center", va="top",
        fontsize=11, weight="bold",
    )  # fmt: skip
    events, failures = content["events"], len(content["failures"])
    resets = sum(count for name, count in events.items() if name.startswith("resets"))
    figure.text(
        0.5, 0.945,
        f"{resets:,} resets, {events.get('openings', 0):,} openings, "
        f"{events.get('restores', 0):,} states restored, {events.get('pictures', 0):,} pictures, "
        f"{failures} exceptions",
        ha="center", va="top", fontsize=8.5,
    )  # fmt: skip
    scale, unit = (1e6, "million steps") if done >= 500_000 else (1e3, "thousand steps")
    _memory_panel(panels[0], content, scale)
    _closure_panel(panels[1], content, scale)
    steps = [sample["steps"] / scale for sample in content["samples"]]
    rates = [sample["steps_per_second"] for sample in content["samples"]]
    panels[2].plot(steps, rates, color=style.GREEN, lw=1.0)
    panels[2].set_ylim(0, 1.15 * max(rates))
    panels[2].set_ylabel("steps/s")
    panels[2].set_xlabel(unit)
    for axes in panels:
        axes.set_xlim(0, done / scale)
        axes.axvspan(0, _warm_until(content) / scale, color=style.REACHED, lw=0)
        axes.grid(True, color=style.REACHED, lw=0.8)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    figure.align_ylabels(panels)
    return figure


def _warm_until(content: dict[str, Any]) -> float:
    """Return the steps at the baseline, or all steps if there is no baseline yet."""
    samples = settled(content) or content["samples"][-1:]
    return float(samples[0]["steps"])


def _memory_panel(axes: Axes, content: dict[str, Any], scale: float) -> None:
    """Draw memory, and its limit from the baseline on."""
    samples, memory = content["samples"], content["verdict"]["memory"]
    steps = [sample["steps"] / scale for sample in samples]
    values = [sample["memory_mb"] for sample in samples]
    axes.plot(steps, values, color=style.BLUE, lw=1.2, label=f"{content['memory_kind']} memory")
    low, high = min(values), max(values)
    if memory is not None:
        base, limit = memory["baseline_mb"], memory["baseline_mb"] + content["limit_mb"]
        ends = [memory["baseline_steps"] / scale, steps[-1]]
        axes.plot(ends, [base, base], color=style.BLACK, lw=0.8, label="after the warm-up (grey)")
        axes.plot(
            ends, [limit, limit], color=style.VERMILLION, lw=1.0, ls=(0, (4, 2)),
            label=f"limit, {content['limit_mb']:.0f} MB more",
        )  # fmt: skip
        # The axis starts at the baseline: growth of a few MB would not show beside the warm-up.
        kept = [sample["memory_mb"] for sample in settled(content)]
        low, high = min(*kept, base - content["limit_mb"] / 2), max(*kept, limit)
    margin = 0.08 * (high - low) or 1.0
    axes.set_ylim(low, high + 4 * margin)
    axes.set_ylabel("memory (MB)")
    axes.legend(loc="upper right", ncols=3)


def _closure_panel(axes: Axes, content: dict[str, Any], scale: float) -> None:
    """Draw mean and largest gap of each window, and the line through the means."""
    kept = [sample for sample in content["samples"] if sample["closure_mean"] is not None]
    steps = [sample["steps"] / scale for sample in kept]
    axes.plot(
        steps, [1e6 * sample["closure_max"] for sample in kept], color=style.SKY, lw=1.0,
        label="largest of a window",
    )  # fmt: skip
    axes.plot(
        steps, [1e6 * sample["closure_mean"] for sample in kept], color=style.BLUE, lw=1.2,
        label="mean of a window",
    )  # fmt: skip
    drift = content["verdict"]["closure_drift"]
    if drift is not None:
        ends = np.array([_warm_until(content), kept[-1]["steps"]])
        line = drift["mean"] + drift["slope"] * (ends / 1e6 - drift["middle"])
        axes.plot(
            ends / scale, 1e6 * line, color=style.VERMILLION, lw=1.0, ls=(0, (4, 2)),
            label=f"slope {1e6 * drift['slope']:+.3f} \N{PLUS-MINUS SIGN} "
            f"{1e6 * drift['standard_error']:.3f} µm a million steps",
        )  # fmt: skip
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * 3)  # room for the legend
    axes.set_ylabel("closure error (µm)")
    axes.legend(loc="upper right", ncols=3)
