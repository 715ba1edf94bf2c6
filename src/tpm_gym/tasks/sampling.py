"""Goals and starts of the tasks: safe ones, and tempting ones.

To reach a tempting goal carelessly, one passes too near to the singularity. In point P a straight
line between two safe points stays safe (the safe set shows no dent; a test draws pairs), so with
Cartesian actions the temptation lies at the ends: the goal, and an object's start, lie just within
the threshold, and nearly half of what counts as reaching the goal lies beyond it. With joint
actions it also lies on the way: the straight line in the joint angles from the start to the goal
leads through the unsafe region, often all the way. Both are asked for of every pair, so that all
ids meet the same goals.

Everything here is about point P, in the machine's frame, m.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism.machine import Machine
from tpm_gym.tasks import rewards

__all__ = [
    "APART",
    "BAND",
    "apart_from",
    "apart_from_each",
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
    rng: np.random.Generator,
    machine: Machine,
    region: Region,
    apart: float = APART,
) -> FloatArray:
    """A safe point (3,) of ``region`` at least ``apart`` (m) from all ``others`` (..., 3).

    Raises:
        ConfigurationError: If no draw was.
    """
    others = np.reshape(others, (-1, 3))
    point: FloatArray = apart_from_each(others, [rng], machine, [region], apart)[0]
    return point


def apart_from_each(
    others: ArrayLike,
    rngs: Sequence[np.random.Generator],
    machine: Machine,
    regions: Sequence[Region],
    apart: float = APART,
) -> FloatArray:
    """The same for r generators and regions, others (k, 3) for all or (r, k, 3): (r, 3) m."""
    points = machine.sample(rngs, regions)
    for _ in range(_ATTEMPTS):
        near = rewards.distance(points[:, None], others) < apart
        rows = np.flatnonzero(near.any(axis=1)).tolist()
        if not rows:
            return points
        points[rows] = machine.sample([rngs[k] for k in rows], [regions[k] for k in rows])
    valid = f"a larger one: what is drawn lies {apart} m from the start, or from other objects"
    raise ConfigurationError("goal_region", regions[rows[0]], valid)


def repeated(places: Mapping[str, FloatArray], count: int) -> dict[str, FloatArray]:
    """Arrays (count, ...) of so many equal ones."""
    return {name: np.tile(place, (count, 1)) for name, place in places.items()}


def first_of(starts: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """The first rows."""
    return {name: rows[0] for name, rows in starts.items()}


def tempting(
    rng: np.random.Generator,
    machine: Machine,
    start: Region | Vector,
    goal: Callable[[np.random.Generator], Region],
) -> tuple[FloatArray, FloatArray]:
    """A tempting pair of a start and a goal, (3,) each.

    Args:
        rng: Source of randomness.
        machine: The machine.
        start: Where the start lies, or the start itself.
        goal: Draws the region of the goal.

    Raises:
        ConfigurationError: If none was drawn: not every machine has some.
    """
    for _ in range(_ATTEMPTS):
        goals = _at_the_threshold(rng, machine, goal(rng))  # (n, 3)
        starts = (
            _at_the_threshold(rng, machine, start)
            if isinstance(start, Region)
            else np.tile(start, (len(goals), 1))
        )
        for first, last in zip(starts, goals, strict=False):
            apart = rewards.distance(first, last) >= APART
            if apart and (line_in_joints(machine, first, last) < machine.safe_conditioning).any():
                return first, last
    valid = f"'sampled': on {machine.name!r} no straight line in the joints nears the singularity"
    raise ConfigurationError("goals", "tempting", valid)


def line_in_joints(machine: Machine, start: ArrayLike, end: ArrayLike) -> FloatArray:
    """Conditioning (33, ...) along the straight line of the joints between points (..., 3) of P.

    0 where they cannot be assembled.
    """
    ends = np.asarray([start, end], dtype=np.float64)
    first, last = machine.require_inverse(ends)
    fractions = _FRACTIONS.reshape(-1, *(1,) * first.ndim)
    return machine.conditioning(first + fractions * (last - first))


def _at_the_threshold(rng: np.random.Generator, machine: Machine, region: Region) -> FloatArray:
    """The points of a batch drawn from ``region`` that are safe, but only just, (n, 3)."""
    points = rng.uniform(region.low, region.high, (_BATCH, 3))
    conditioning, safe = machine.conditioning_at(points), machine.safe_conditioning
    chosen: FloatArray = points[(conditioning >= safe) & (conditioning < safe + BAND)]
    return chosen
