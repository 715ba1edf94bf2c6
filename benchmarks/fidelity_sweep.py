"""Settings of the fidelity sweep, and their measurement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from fidelity_lab import CONDITIONED, Config, Errors, Motion, Rig, measure, references
from fidelity_lab import seconds_per_step as timed
from shared import quartiles

from tpm_gym.arrays import FloatArray

QUANTITIES = ("gap", "fk", "fk_near", "tilt", "tracking")
"""Loop gap (m); distance of the platform from forward kinematics (m), where 1/cond(J) exceeds
CONDITIONED and elsewhere; tilt (rad); distance of the platform from its reference (m)."""


def sweep() -> tuple[Config, ...]:
    """Return all settings: the default first, then settings that differ from it in one respect."""
    return (
        Config("default", "default"),
        *_direct(),
        *_iterative(),
        *(
            Config("LCP PGS", f"PGS, {n} iterations", solver="lcp pgs", iterations=n)
            for n in (50, 200)
        ),
        *_one_body(),
        *_structure(),
        *_torque(),
    )


def _direct() -> list[Config]:
    steps = [Config("direct", f"1/{rate} s", time_step=1 / rate) for rate in (125, 500, 1000)]
    erps = [Config("direct", f"erp {erp}", erp=erp) for erp in (0.2, 0.5, 0.8)]
    cfms = [Config("direct", f"CFM {cfm:g}", cfm=cfm) for cfm in (0.0, 1e-6)]
    return [*steps, *erps, *cfms]


def _iterative() -> list[Config]:
    """Return settings of Bullet's default solver: iterations, time steps, erp, early stops."""

    def row(name: str, **settings: Any) -> Config:
        return Config("iterative", name, solver="iterative", **settings)

    rows = [
        row(f"1/{rate} s, {n} iterations", time_step=1 / rate, iterations=n)
        for rate, counts in ((125, (200, 400)), (250, (25, 50, 100, 200, 400)),
                             (500, (25, 50, 100, 200)), (1000, (50,)))
        for n in counts
    ]  # fmt: skip
    rows += [
        row(f"1/{rate} s, {n} iterations, erp 0.2", time_step=1 / rate, iterations=n, erp=0.2)
        for rate, n in ((250, 50), (250, 200), (500, 50))
    ]
    rows += [
        row(f"1/250 s, 200 iterations, residual {limit:g}", iterations=200, residual=limit)
        for limit in (1e-4, 0.0)
    ]
    return rows


def _torque() -> list[Config]:
    """Return settings of torque control, with gains for 250 Hz, and gains for 1000 Hz only."""
    soft, stiff = (4000.0, 40.0), (8000.0, 160.0)

    def row(name: str, **settings: Any) -> Config:
        return Config("torque", f"torque control, {name}", motor="torque", **settings)

    return [
        row("soft", gains=soft),
        row("stiff", gains=stiff),
        row("stiff, 1/1000 s", gains=stiff, time_step=1 / 1000),
    ]


def _one_body() -> list[Config]:
    """Return settings with all loops inside one multibody."""
    return [
        Config("one body", "one body, direct", variant="one body"),
        Config("one body", "one body, PGS, 200 iterations", variant="one body", solver="lcp pgs",
               iterations=200),
        *(
            Config("one body", f"one body, iterative, {n} iterations", variant="one body",
                   solver="iterative", iterations=n)
            for n in (50, 200)
        ),
    ]  # fmt: skip


def _structure() -> list[Config]:
    """Return settings with other joints at the ends of the rods, and other cuts."""
    rows = []
    for name in (
        "rods 4 spherical",
        "rods 4 cut at arm",
        "rods 11 spherical",
        "rods 11 cut at arm",
    ):
        rows.append(Config("structure", f"{name}, direct", variant=name))
        rows.append(
            Config("structure", f"{name}, iterative, 100", variant=name, solver="iterative",
                   iterations=100)
        )  # fmt: skip
    return rows


# -- results -----------------------------------------------------------------------------------


@dataclass
class Summary:
    """Mean, 99.9 % quantile and maximum of a quantity, in SI units; None without samples."""

    mean: float | None
    p999: float | None
    maximum: float | None

    @classmethod
    def of(cls, values: FloatArray) -> Summary:
        """Summarise samples (n,)."""
        if not len(values):
            return cls(None, None, None)
        return cls(float(values.mean()), float(np.quantile(values, 0.999)), float(values.max()))


@dataclass
class Result:
    """Results of one configuration, a row of the table.

    Attributes:
        config: Settings.
        motions: Summaries by motion and quantity.
        overall: Summaries over all motions, by quantity.
        lost: Time step at which a loop was lost, by motion.
        step_times: Seconds of a time step with its motor commands, by block.
        ratios: Cost of a control period over that of the default in the same round.
    """

    config: Config
    motions: dict[str, dict[str, Summary]] = field(default_factory=dict)
    overall: dict[str, Summary] = field(default_factory=dict)
    lost: dict[str, int] = field(default_factory=dict)
    step_times: list[float] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)

    @property
    def step_time(self) -> float:
        """Median of ``step_times``, s; NaN if a loop was lost."""
        return float(np.median(self.step_times)) if self.step_times else float("nan")

    @property
    def period_time(self) -> float:
        """Median of the seconds of a control period."""
        return self.step_time * self.config.substeps

    def as_json(self) -> dict[str, Any]:
        """Return plain data in SI units."""
        held = np.isfinite(self.step_time)
        return {
            "config": asdict(self.config),
            "lost_at_step": self.lost,
            "seconds_per_step": quartiles(self.step_times) if held else None,
            "cost_against_default": quartiles(self.ratios) if held else None,
            "step_times": self.step_times if held else [],
            "ratios": self.ratios if held else [],
            "overall": {name: asdict(value) for name, value in self.overall.items()},
            "motions": {
                motion: {name: asdict(value) for name, value in summaries.items()}
                for motion, summaries in self.motions.items()
            },
        }

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Result:
        """Make a result from the data of :meth:`as_json`."""
        config = {**data["config"], "gains": tuple(data["config"]["gains"])}
        return cls(
            Config(**config),
            {
                motion: {name: Summary(**value) for name, value in found.items()}
                for motion, found in data["motions"].items()
            },
            {name: Summary(**value) for name, value in data["overall"].items()},
            data["lost_at_step"],
            data["step_times"],
            data["ratios"],
        )


def samples(errors: Errors) -> dict[str, FloatArray]:
    """Return the samples of each quantity."""
    good = errors.conditioning > CONDITIONED
    return {
        "gap": errors.gap,
        "fk": errors.apart[good],
        "fk_near": errors.apart[~good],
        "tilt": errors.tilt,
        "tracking": errors.tracking,
    }


def errors_of(config: Config, motions: Sequence[Motion]) -> Result:
    """Follow all motions, each in a new client; return the summaries."""
    result, pool = Result(config), {name: [] for name in QUANTITIES}
    for motion in motions:
        rig = Rig(config)
        errors = measure(rig, motion)
        rig.close()
        if errors.lost is not None:
            result.lost[motion.name] = errors.lost
        found = samples(errors)
        result.motions[motion.name] = {name: Summary.of(found[name]) for name in QUANTITIES}
        for name in QUANTITIES:
            pool[name].append(found[name])
    result.overall = {name: Summary.of(np.concatenate(pool[name])) for name in QUANTITIES}
    return result


def time_all(results: Sequence[Result], motion: Motion, rounds: int) -> None:
    """Time each configuration in each round, so that noise of the computer affects all alike.

    Ratios to the default, which comes first, are taken within a round.
    """
    rigs = [Rig(result.config) for result in results]
    paths = [references(motion, result.config)[0] for result in results]
    for _ in range(rounds):
        default = None
        for result, rig, path in zip(results, rigs, paths, strict=True):
            seconds = timed(rig, path)
            period = seconds * result.config.substeps
            default = period if default is None else default
            result.step_times.append(seconds)
            result.ratios.append(period / default)
    for rig in rigs:
        rig.close()


def pareto(costs: FloatArray, errors: FloatArray) -> list[int]:
    """Return the indices of the Pareto front, in order of cost."""
    front: list[int] = []
    for i in np.lexsort((errors, costs)):
        if np.isfinite(costs[i] + errors[i]) and (not front or errors[i] < errors[front[-1]]):
            front.append(int(i))
    return front
