"""Sampling of goals and starts: safe ones, and tempting ones, which are next to the singularity.

A careless policy that moves to a tempting goal comes too near to the singularity. If two positions
of P are safe, all positions on the straight line between them are safe (the safe set is convex; a
test checks random pairs). So with Cartesian actions, the risk is at the ends of the line. The goal
and an object's start are just above the threshold of safe conditioning, and nearly half of the
positions within the tolerance of the goal are unsafe. With joint actions, the motion between the
ends is a risk too. The line in joint space from start to goal is partly unsafe, and often unsafe
everywhere except next to its ends. Every tempting pair of start and goal has both risks, so that
environments with Cartesian actions and with joint actions have the same goals.

All points are positions of P, in the machine's frame, m. Every function takes one generator for
each row, and a row draws from its own generator only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.engine import loops

__all__ = [
    "APART",
    "BAND",
    "at_threshold",
    "line_in_joints",
    "safe_draw",
    "safe_points",
    "tempting",
]

APART: Final = 0.030
"""Smallest distance from start to goal, m, so that no episode starts with success."""
BAND: Final = 0.004
"""Largest amount by which the conditioning of a tempting start or goal exceeds the threshold.

On the paper's machine, a displacement of about 1 mm along y changes the conditioning by this
amount.
"""

_DRAWS: Final = 4  # points in a call; nearly every row then needs only one call
_BATCH: Final = 256  # points in a call near the singularity, where about one of 30 fits
_ATTEMPTS: Final = 100
_FRACTIONS: Final = np.linspace(0.0, 1.0, 33)


def safe_points(
    rngs: Sequence[np.random.Generator],
    machine: Machine,
    regions: Mapping[str, Region | Sequence[Region]],
    known: Mapping[str, ArrayLike],
    apart: float = APART,
    near_singularity: bool = False,
) -> dict[str, FloatArray]:
    """Draw a safe point for each name in ``regions``, at least ``apart`` (m) from each other.

    Args:
        rngs: One generator for each of the r robots.
        regions: For each name, the region of its point, or several regions that are equally likely.
        known: Given points by name, (3,) or (r, 3) m each. They are not drawn.
        near_singularity: Whether the points must be just above the threshold of safe conditioning.

    Returns:
        The known and the drawn points by name, (r, 3) m each, machine's frame.

    Raises:
        ConfigurationError: If no draw meets these conditions.
    """
    names = [*known, *(name for name in regions if name not in known)]
    first, rows = len(known), np.arange(len(rngs))
    points = np.empty((len(rngs), len(names), 3))
    for index, point in enumerate(known.values()):
        points[:, index] = point
    chosen = [regions[name] for name in names[first:]]
    parts = [[part] if isinstance(part, Region) else part for part in chosen]
    boxes = np.array([(box.low, box.high) for part in parts for box in part]).reshape(-1, 2, 3)
    counts = np.array([len(part) for part in parts], dtype=np.int64)
    least, most = _limits(machine, near_singularity)
    size = _BATCH if near_singularity else _DRAWS
    shares = np.empty((len(rngs), len(parts), size, 4))
    for _ in range(_ATTEMPTS * _BATCH // size):
        # One call for each generator, because a call takes longer than the numbers.
        for row, own in zip(rows.tolist(), shares, strict=False):
            rngs[row].random(out=own)
        drawn = loops().drawn(shares[: len(rows)], boxes, counts)
        conditioning = machine.conditioning_at(drawn)
        found = loops().accepted(drawn, conditioning, least, most, apart, rows, points)
        rows = rows[~found]
        if not len(rows):
            return dict(zip(names, points.swapaxes(0, 1), strict=True))
    if near_singularity:
        raise _no_tempting(f"on {machine.name!r} these places are not near a singularity")
    valid = f"with points of conditioning {least} to {most}, {apart} m from {', '.join(names)}"
    raise ConfigurationError("goal_region", dict(regions), valid)


def safe_draw(
    rng: np.random.Generator,
    machine: Machine,
    goals: str,
    draw: Callable[[np.random.Generator], FloatArray],
    ways: Callable[[FloatArray], FloatArray],
) -> FloatArray:
    """Draw points, and return the first point (3,) whose way is safe at all corners.

    The way of a point is a sequence of straight lines along which P will move.

    Args:
        goals: ``"tempting"`` if the lowest conditioning on the way must be just above the threshold
            of safe conditioning.
        draw: Function that draws any number d of points, (d, 3).
        ways: Function that returns the way of each of these points, as k corners (d, k, 3) m,
            machine's frame. Ways are straight between their corners.

    Raises:
        ConfigurationError: If no point with such a way was found.
    """
    least, most = _limits(machine, goals == "tempting")
    for _ in range(_ATTEMPTS):
        points = draw(rng)
        conditioning = machine.conditioning_at(ways(points)).min(axis=-1)
        fits = np.flatnonzero((conditioning >= least) & (conditioning < most))
        if len(fits):
            point: FloatArray = points[fits[0]]
            return point
    if goals == "tempting":
        raise _no_tempting(f"{machine.name!r} has no such way")
    valid = f"one with a way on which the conditioning is {least} or more"
    raise ConfigurationError("machine", machine.name, valid)


def _no_tempting(reason: str) -> ConfigurationError:
    return ConfigurationError("goals", "tempting", f"'sampled': {reason}")


def _limits(machine: Machine, near_singularity: bool) -> tuple[float, float]:
    """Return two limits, low and high: points must have low <= conditioning < high.

    ``low`` is the threshold of safe conditioning. ``high`` is just above it with
    ``near_singularity``, else infinite.
    """
    safe = machine.safe_conditioning
    return safe, safe + BAND if near_singularity else math.inf


def tempting(
    rngs: Sequence[np.random.Generator],
    machine: Machine,
    start: Region | Vector,
    goals: Sequence[Region],
) -> tuple[FloatArray, FloatArray]:
    """Draw tempting starts and goals in pairs, (r, 3) each.

    The goal, and a start that is drawn, are just above the threshold of safe conditioning. A part
    of the line in joint space between them is below the threshold.

    Args:
        rngs: One generator for each of the r robots.
        start: Region of the starts, or the start itself.
        goals: Equally likely regions of the goals.

    Raises:
        ConfigurationError: If no pair was found; not every machine has such pairs.
    """
    pairs = np.array([_tempting(rng, machine, start, goals) for rng in rngs])
    return pairs[:, 0], pairs[:, 1]


def _tempting(
    rng: np.random.Generator,
    machine: Machine,
    start: Region | Vector,
    goals: Sequence[Region],
) -> tuple[FloatArray, FloatArray]:
    """Draw one pair of start and goal, (3,) each, for :func:`tempting`."""
    for _ in range(_ATTEMPTS):
        ends = _at_the_threshold(rng, machine, goals[int(rng.integers(len(goals)))])  # (n, 3)
        starts = (
            _at_the_threshold(rng, machine, start)
            if isinstance(start, Region)
            else np.tile(start, (len(ends), 1))
        )
        for first, last in zip(starts, ends, strict=False):
            apart = np.linalg.norm(first - last, axis=-1) >= APART
            if apart and (line_in_joints(machine, first, last) < machine.safe_conditioning).any():
                return first, last
    raise _no_tempting(f"on {machine.name!r} no straight line in the joints nears the singularity")


def line_in_joints(machine: Machine, start: ArrayLike, end: ArrayLike) -> FloatArray:
    """Compute the conditioning at 33 places on each line in joint space, (33, ...).

    The lines join points (..., 3). The conditioning is 0 where the machine cannot be assembled.
    """
    first, last = machine.require_inverse(np.stack(np.broadcast_arrays(start, end)))
    fractions = _FRACTIONS.reshape(-1, *(1,) * first.ndim)
    return machine.conditioning(first + fractions * (last - first))


def at_threshold(
    rng: np.random.Generator, machine: Machine, region: Region, count: int
) -> FloatArray:
    """Draw points (count, 3) with a conditioning just above the safe threshold, from a region.

    Raises:
        ConfigurationError: If no draw was near the threshold.
    """
    found: list[FloatArray] = []
    for _ in range(_ATTEMPTS):
        found += [*_at_the_threshold(rng, machine, region)]
        if len(found) >= count:
            return np.array(found[:count])
    raise _no_tempting(f"on {machine.name!r} the goals are not near a singularity")


def _at_the_threshold(rng: np.random.Generator, machine: Machine, region: Region) -> FloatArray:
    """Draw points; return those with a conditioning just above the safe threshold, (n, 3)."""
    points = rng.uniform(region.low, region.high, (_BATCH, 3))
    conditioning, (low, high) = machine.conditioning_at(points), _limits(machine, True)
    chosen: FloatArray = points[(conditioning >= low) & (conditioning < high)]
    return chosen
