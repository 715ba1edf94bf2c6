"""Errors of the default settings in the real environment, at each of many time steps.

With ``--write``, results go to docs/records/fidelity.json, and from there to docs/fidelity.md.

Only histograms are kept, so that memory does not grow with the number of time steps.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from fidelity_lab import CONDITIONED, against_kinematics
from shared import ROOT, fill, processor_line, provenance, read_record, table

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import ClosureError
from tpm_gym.tasks import Expert

BUFFER = 5000  # time steps whose kinematics are computed at once
RECORD = ROOT / "docs" / "records" / "fidelity.json"
PAGE = ROOT / "docs" / "fidelity.md"


class Histogram:
    """Histogram of a positive quantity: exact mean and maximum, quantiles to 1 %.

    Bins have equal widths in the logarithm, from 1e-12 to 1e3 in SI units.
    """

    LOW, HIGH, BINS = -12.0, 3.0, 3600  # 10 ** (15 / 3600) = 1.0096

    def __init__(self) -> None:
        """Start empty."""
        self._counts = np.zeros(self.BINS, dtype=np.int64)
        self.count, self._sum, self.maximum = 0, 0.0, 0.0

    def add(self, values: FloatArray) -> None:
        """Add values (n,)."""
        if not len(values):
            return
        position = (np.log10(np.maximum(values, 1e-300)) - self.LOW) / (self.HIGH - self.LOW)
        bins = np.clip(position * self.BINS, 0, self.BINS - 1).astype(np.int64)
        self._counts += np.bincount(bins, minlength=self.BINS)
        self.count += len(values)
        self._sum += float(values.sum())
        self.maximum = max(self.maximum, float(values.max()))

    @property
    def mean(self) -> float:
        """Mean of all samples."""
        return self._sum / self.count

    def quantile(self, share: float) -> float:
        """Return the upper edge of the bin of a quantile, or the maximum if it is smaller."""
        at = int(np.searchsorted(np.cumsum(self._counts), share * self.count))
        edge = 10 ** (self.LOW + (at + 1) / self.BINS * (self.HIGH - self.LOW))
        return min(edge, self.maximum)


class Probe:
    """Measurement of the robot after each time step of an environment.

    It wraps ``stepSimulation`` of the client, so that the environment itself is unchanged.

    Args:
        env: TPMPickAndPlace-v0.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        """Wrap ``stepSimulation``."""
        inside: Any = env.unwrapped
        self._robot, client = inside.simulation.engine.robot, inside.simulation.engine.client
        self._step = client.stepSimulation
        client.stepSimulation = self._measured_step
        self._rows = np.empty((BUFFER, 8))
        self._filled = self.steps = self.below = 0
        self.gap, self.tilt = Histogram(), Histogram()
        self.fk, self.fk_near = Histogram(), Histogram()

    def _measured_step(self, *arguments: Any, **options: Any) -> Any:
        result = self._step(*arguments, **options)
        gap, position, tilt = self._robot.truth()
        self._rows[self._filled] = (gap, tilt, *position, *self._robot.motors()[0])
        self._filled += 1
        self.steps += 1
        if self._filled == BUFFER:
            self.flush()
        return result

    def flush(self) -> None:
        """Add the buffered measurements to the histograms."""
        rows, self._filled = self._rows[: self._filled], 0
        apart, conditioning = against_kinematics(rows[:, 5:8], rows[:, 2:5])
        good = conditioning > CONDITIONED
        self.below += int((rows[:, 0] < 1e-4).sum())
        self.gap.add(rows[:, 0])
        self.tilt.add(rows[:, 1])
        self.fk.add(apart[good])
        self.fk_near.add(apart[~good])

    def summary(self) -> dict[str, Any]:
        """Return mean, 99.9 % quantile and maximum of each quantity, in SI units."""
        named = {"gap": self.gap, "fk": self.fk, "fk_near": self.fk_near, "tilt": self.tilt}
        found: dict[str, Any] = {
            name: {"samples": h.count, "max": h.maximum}
            | ({"mean": h.mean, "p999": h.quantile(0.999)} if h.count else {})
            for name, h in named.items()
        }
        return found | {"steps": self.steps, "share_gap_below_0.1_mm": self.below / self.steps}


def follow(motion: str, steps: int, seed: int = 0) -> dict[str, Any]:
    """Run TPMPickAndPlace-v0 for ``steps`` time steps with "random" or "expert" actions."""
    env = gym.make("TPMPickAndPlace-v0")
    env.action_space.seed(seed)
    probe, expert = Probe(env), Expert(env)
    start = time.perf_counter()
    episode = successes = lost = mode_changes = 0
    while probe.steps < steps:
        observation, info = env.reset(seed=seed + episode)
        expert.reset(observation)
        episode, ended = episode + 1, False
        while not ended:
            random = motion == "random"
            action = env.action_space.sample() if random else expert.act(observation)
            try:
                observation, _, _, ended, info = env.step(action)
            except ClosureError as error:
                lost, ended = lost + 1, True
                print(f"{motion}: lost in episode {episode}: {error}")
        mode_changes += info["assembly_mode_changed"] or info["working_mode_changed"]
        successes += bool(info["is_success"])
    probe.flush()
    env.close()
    return {
        **probe.summary(),
        "episodes": episode,
        "successes": successes,
        "lost": lost,
        "mode_changes": int(mode_changes),
        "seconds": time.perf_counter() - start,
    }


def run(steps: int, describe: Callable[[], dict[str, Any]], write: bool) -> None:
    """Run random actions and the expert; print, and with ``write`` replace record and page."""
    description = describe()
    results = {motion: follow(motion, steps) for motion in ("random", "expert")}
    for motion, found in results.items():
        gap, fk, near, tilt = (found[name] for name in ("gap", "fk", "fk_near", "tilt"))
        print(
            f"{motion}: {found['steps']:,} time steps, {found['episodes']} episodes "
            f"({found['successes']} ended in success), loops lost {found['lost']} times, "
            f"mode left {found['mode_changes']} times, {found['seconds']:.0f} s\n"
            f"  gap: max {1e3 * gap['max']:.4f} mm, 99.9 % {1e3 * gap['p999']:.4f} mm, "
            f"mean {1e3 * gap['mean']:.4f} mm, {100 * found['share_gap_below_0.1_mm']:.4f} % "
            f"below 0.1 mm\n"
            f"  FK where 1/cond(J) > {CONDITIONED}: max {1e3 * fk['max']:.4f} mm, "
            f"99.9 % {1e3 * fk['p999']:.4f} mm ({fk['samples']:,} time steps)\n"
            f"  FK elsewhere: max {1e3 * near['max']:.4f} mm ({near['samples']:,} time steps)\n"
            f"  tilt: max {np.rad2deg(tilt['max']):.2e} degrees"
        )
    if write:
        provenance.write_json(RECORD, {**description, "results": results})
        publish()


def publish() -> None:
    """Fill the page from the record."""
    record = read_record(RECORD)
    fill(PAGE, "summary", summary(record))
    fill(PAGE, "long", lines(record))


def summary(record: dict[str, Any]) -> Iterator[str]:
    """Yield the sentence that begins the page."""
    if not record:
        yield "This version has not been measured yet: `make bench-long`."
        return
    found = record["results"].values()
    gap, apart, tilt = (
        max(motion[name]["max"] for motion in found for name in names)
        for names in (("gap",), ("fk", "fk_near"), ("tilt",))
    )
    steps = sum(motion["steps"] for motion in found)
    yield (
        f"In `TPMPickAndPlace-v0`, in PyBullet, at every one of {steps:,} time steps, loops are "
        f"open by at most **{1e3 * gap:.3f} mm**, and the platform is within "
        f"**{1e3 * apart:.3f} mm** of the forward kinematics of its encoders. It tilts by at most "
        f"{np.rad2deg(tilt):.0e} degrees, which is rounding."
    )


def lines(record: dict[str, Any]) -> Iterator[str]:
    """Yield the table in Markdown, a column for each motion, lengths in mm."""
    if not record:
        yield "Not measured on this version yet: `make bench-long`."
        return
    results = record["results"]

    def largest(motion: dict[str, Any]) -> str:
        near = motion["fk_near"]
        return (
            f"{1e3 * near['max']:.4f} ({near['samples']:,} time steps)" if near["samples"] else "-"
        )

    rows = {
        "gap: mean, 99.9%, max": lambda m: _lengths(m["gap"], "mean", "p999", "max"),
        "gap below 0.1 mm": lambda m: f"{m['share_gap_below_0.1_mm']:.2%}",
        f"FK where 1/cond(J) > {CONDITIONED}: 99.9%, max": lambda m: _lengths(
            m["fk"], "p999", "max"
        ),
        "FK elsewhere: max": largest,
        "tilt: max": lambda m: f"{np.rad2deg(m['tilt']['max']):.1e} degrees",
        "loops lost, modes left": lambda m: f"{m['lost']}, {m['mode_changes']}",
        "episodes, successes": lambda m: f"{m['episodes']:,}, {m['successes']:,}",
    }
    yield f"`{record['command']}` on {processor_line(record)}."
    yield ""
    yield from table(
        ["mm", *results],
        [[name, *(form(motion) for motion in results.values())] for name, form in rows.items()],
    )


def _lengths(quantity: dict[str, float], *names: str) -> str:
    return ", ".join(f"{1e3 * quantity[name]:.4f}" for name in names)
