"""Sampling of goals and starts: safe ones, and tempting ones.

Who reaches a tempting goal carelessly passes too near to the singularity. Between two safe points,
point P stays safe on a straight line (the safe set has no dent; a test draws pairs). So with
Cartesian actions the temptation lies at the ends: the goal, and an object's start, lie just within
the threshold, and nearly half of the sphere around the goal lies beyond it. With joint actions the
temptation lies on the way too: the straight line in the joints from start to goal leads through the
unsafe region, often all the way. Every pair has both, so that all ids meet the same goals.

Everything here is about point P, in the machine's frame, m. Every function takes one generator for
each row, and a row draws from its own generator only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism.machine import Machine

__all__ = [
    "APART",
    "BAND",
    "apart_from",
    "at_threshold",
    "line_in_joints",
    "tempting",
]

APART: Final = 0.030
"""A goal is at least this far from where its episode starts, m: no success for free."""
BAND: Final = 0.004
"""How far above the threshold the conditioning of a tempting end may be: less than 1 mm of y."""

_BATCH: Final = 256
_ATTEMPTS: Final = 100
_FRACTIONS: Final = np.linspace(0.0, 1.0, 33)


def apart_from(
    others: ArrayLike,
    rngs: Sequence[np.random.Generator],
    machine: Machine,
    regions: Sequence[Region],
    apart: float = APART,
    near_singularity: bool = False,
) -> FloatArray:
    """Draw safe points (r, 3) of regions at least ``apart`` (m) from others.

    Args:
        others: (k, 3) m for all rows, or (r, k, 3).
        rngs: One for each row.
        machine: Whose points are safe.
        regions: One for each row.
        apart: m.
        near_singularity: Whether the points are only just safe.

    Raises:
        ConfigurationError: If no draw is far enough.
    """
    draw = _one_at_threshold if near_singularity else Machine.sample
    points = draw(machine, rngs, regions)
    for _ in range(_ATTEMPTS):
        gap = np.subtract(points[:, None], others)
        near = (gap * gap).sum(axis=-1) < apart * apart  # faster than linalg.norm
        rows = np.flatnonzero(near.any(axis=1)).tolist()
        if not rows:
            return points
        points[rows] = draw(machine, [rngs[k] for k in rows], [regions[k] for k in rows])
    valid = f"a larger one: what is drawn lies {apart} m from the start, or from other objects"
    raise ConfigurationError("goal_region", regions[rows[0]], valid)


def tempting(
    rngs: Sequence[np.random.Generator],
    machine: Machine,
    start: Region | Vector,
    goal: Callable[[np.random.Generator], Region],
) -> tuple[FloatArray, FloatArray]:
    """Draw tempting pairs of starts and goals, (r, 3) each.

    Args:
        rngs: One for each row.
        machine: The machine.
        start: Region of the starts, or the start itself.
        goal: Draws the region of a goal.

    Raises:
        ConfigurationError: If none was drawn: not every machine has some.
    """
    pairs = np.array([_tempting(rng, machine, start, goal) for rng in rngs])
    return pairs[:, 0], pairs[:, 1]


def _tempting(
    rng: np.random.Generator,
    machine: Machine,
    start: Region | Vector,
    goal: Callable[[np.random.Generator], Region],
) -> tuple[FloatArray, FloatArray]:
    """Draw one tempting pair, (3,) each."""
    for _ in range(_ATTEMPTS):
        goals = _at_the_threshold(rng, machine, goal(rng))  # (n, 3)
        starts = (
            _at_the_threshold(rng, machine, start)
            if isinstance(start, Region)
            else np.tile(start, (len(goals), 1))
        )
        for first, last in zip(starts, goals, strict=False):
            apart = np.linalg.norm(first - last, axis=-1) >= APART
            if apart and (line_in_joints(machine, first, last) < machine.safe_conditioning).any():
                return first, last
    valid = f"'sampled': on {machine.name!r} no straight line in the joints nears the singularity"
    raise ConfigurationError("goals", "tempting", valid)


def line_in_joints(machine: Machine, start: ArrayLike, end: ArrayLike) -> FloatArray:
    """Return the conditioning (33, ...) along straight lines of the joints between points (..., 3).

    It is 0 where the machine cannot be assembled.
    """
    first, last = machine.require_inverse(np.stack(np.broadcast_arrays(start, end)))
    fractions = _FRACTIONS.reshape(-1, *(1,) * first.ndim)
    return machine.conditioning(first + fractions * (last - first))


def at_threshold(
    rng: np.random.Generator, machine: Machine, region: Region, count: int
) -> FloatArray:
    """Draw points (count, 3) of a region that are only just safe.

    Raises:
        ConfigurationError: If no draw was near the threshold.
    """
    found: list[FloatArray] = []
    for _ in range(_ATTEMPTS):
        found += [*_at_the_threshold(rng, machine, region)]
        if len(found) >= count:
            return np.array(found[:count])
    valid = f"'sampled': on {machine.name!r} the goals are not near a singularity"
    raise ConfigurationError("goals", "tempting", valid)


def _one_at_threshold(
    machine: Machine, rngs: Sequence[np.random.Generator], regions: Sequence[Region]
) -> FloatArray:
    draws = zip(rngs, regions, strict=True)
    return np.array([at_threshold(rng, machine, region, 1)[0] for rng, region in draws])


def _at_the_threshold(rng: np.random.Generator, machine: Machine, region: Region) -> FloatArray:
    """Draw points from ``region``, and return those that are only just safe, (n, 3)."""
    points = rng.uniform(region.low, region.high, (_BATCH, 3))
    conditioning, safe = machine.conditioning_at(points), machine.safe_conditioning
    chosen: FloatArray = points[(conditioning >= safe) & (conditioning < safe + BAND)]
    return chosen
