"""Sampling of goals and starts: safe ones, and tempting ones.

A careless policy that moves to a tempting goal comes too near to the singularity. Straight lines of
P between safe points are safe (the safe set is convex; a test draws pairs). So with Cartesian
actions the risk is at the ends: the goal and an object's start are just above the threshold, and
nearly half of the sphere around the goal is unsafe. With joint actions the risk is on the way too:
the line in joint space from start to goal is unsafe, often all the way. Every pair has both
properties, so that all ids have the same goals.

All points are positions of P, in the machine's frame, m. Every function takes one generator for
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
"""Smallest distance from start to goal, m, so that no episode starts with success."""
BAND: Final = 0.004
"""Largest excess of a tempting end's conditioning over the threshold; less than 1 mm of y."""

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
    """Draw safe points (r, 3) of regions, at least ``apart`` (m) from other points.

    Args:
        others: Other points, (k, 3) m for all rows, or (r, k, 3).
        rngs: One for each row.
        machine: Machine that defines the safe points.
        regions: One for each row.
        apart: Smallest distance, m.
        near_singularity: Whether the points are just above the threshold.

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
        goal: Function that draws the region of a goal.

    Raises:
        ConfigurationError: If no pair was found; not every machine has tempting pairs.
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
    """Compute the conditioning (33, ...) along lines in joint space between points (..., 3).

    It is 0 where the machine cannot be assembled.
    """
    first, last = machine.require_inverse(np.stack(np.broadcast_arrays(start, end)))
    fractions = _FRACTIONS.reshape(-1, *(1,) * first.ndim)
    return machine.conditioning(first + fractions * (last - first))


def at_threshold(
    rng: np.random.Generator, machine: Machine, region: Region, count: int
) -> FloatArray:
    """Draw points (count, 3) of a region, just above the threshold of safe conditioning.

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
    """Draw points from ``region``, and return those just above the threshold, (n, 3)."""
    points = rng.uniform(region.low, region.high, (_BATCH, 3))
    conditioning, safe = machine.conditioning_at(points), machine.safe_conditioning
    chosen: FloatArray = points[(conditioning >= safe) & (conditioning < safe + BAND)]
    return chosen
