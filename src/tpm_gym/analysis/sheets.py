"""Singular surfaces, and the nearest points on them.

Point C1 = (xC, 0, zC) is always in the plane y = 0. Each of the singularity factors level3, planar,
leg1, leg2 and elevation is zero only if C1 is on certain curves in this plane. For each position of
C1, P is on a circle of radius l7 about (xC + l2, 0, zC + 2 l6), parallel to the plane xy. While C1
follows a curve, this circle sweeps the singular surface. Each curve is a closed-form function of
one angle, so the nearest point of a surface is found by a search over this angle. A curve consists
of arcs, one for each interval of the angle in which the curve is real.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray, IntArray
from tpm_gym.errors import InputError
from tpm_gym.kinematics.equations import Factors
from tpm_gym.kinematics.geometry import Geometry
from tpm_gym.kinematics.modes import WorkingMode

Point = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""xC and zC in m, and two numbers p and q, which depend on the working mode. P belongs to this
mode if p + q cos(beta) > 0 and cos(beta) has the sign ``cos_beta`` of the mode."""
Curve = Callable[[Geometry, WorkingMode, FloatArray, FloatArray, FloatArray], Point]
"""Function that returns points of a curve, with p and q. Its arguments are the lengths, the working
mode, the angle, and two signs that select a branch of the curve."""

_CELLS = 256  # cells of an arc: equal steps of the ``t`` of _Arcs.at()
_FINE = 4 * _CELLS  # chords that measure the length of an arc
_NODES, _ROUNDS = 9, 16  # each round keeps a quarter of the interval
_GRID = 2048  # steps between the sampled angles of a full turn, in the search for intervals
_BLOCK = 64  # points at a time


def _level3(g: Geometry, mode: WorkingMode, t: FloatArray, up: FloatArray, _: FloatArray) -> Point:
    """Return positions of C1, on two circles, where rod 11, seen along z, is parallel to link 7."""
    cos, sin = np.cos(t), np.sin(t)
    rise = up * np.sqrt(max(g.l4**2 - g.l7**2, 0.0))
    x, z = g.l1 - 2 * g.l2 + g.l3 * cos, g.l3 * sin - g.l6 + rise
    return x, z, mode.leg3 * rise * cos, -mode.leg3 * g.l7 * sin


def _rod_4(g: Geometry, theta_1: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return y of B1, m, and the squared length of rod 4 projected on the plane y = 0, m^2."""
    y = g.l1 + g.l3 * np.cos(theta_1)
    return y, g.l4**2 - y * y


def _tangent(
    g: Geometry, t: FloatArray, side: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return x, z and length of the vector from A2 to B1, and the position of B2 on a line, m.

    Here A2, B2 and C2 are the points of leg 2 after a shift by 2 l5 along x, so that C2 coincides
    with C1. All points are projected on the plane y = 0, and theta_1 is ``t``. If the planar factor
    is zero, rods 4 and 6 lie on one line after the shift. The position on this line is 0 at B1 and
    increases from B2 to C2. The position of B2 is never positive. Its absolute value is the
    distance from B1 to B2, a side of the triangle A2B1B2. ``side`` is -1 if the rods point in
    opposite directions, else 1.
    """
    level, up = g.l1 - 2 * g.l5 + 0 * t, g.l3 * np.sin(t)
    rod = side * np.sqrt(np.maximum(_rod_4(g, t)[1], 0.0))
    return level, up, np.hypot(level, up), rod - g.l4


def _planar(
    g: Geometry, mode: WorkingMode, t: FloatArray, side: FloatArray, bend: FloatArray
) -> Point:
    """Return positions of C1 at theta_1 = ``t`` where rods 4 and 6, seen along y, are parallel."""
    level, up, apart, gap = _tangent(g, t, side)
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = (g.l3**2 - gap**2 - apart**2) / (2 * gap * apart)
    psi = np.arctan2(up, level) + bend * np.arccos(np.clip(cosine, -1.0, 1.0))
    cos, sin, rod = np.cos(psi), np.sin(psi), gap + g.l4
    leg1 = rod * sin * np.cos(t) + _rod_4(g, t)[0] * np.sin(t)
    leg2 = sin * level - cos * up
    ours = (np.sign(leg1) == mode.leg1) & (np.sign(leg2) == mode.leg2)
    return rod * cos, up + rod * sin, 2.0 * ours - 1.0, 0.0 * t


def _leg1(g: Geometry, mode: WorkingMode, t: FloatArray, up: FloatArray, _: FloatArray) -> Point:
    """Return positions of C1 where leg 1, seen along x, is stretched or folded.

    ``t`` is the angle from the arm to the rods, in the plane that contains the arm and the
    direction x.
    """
    square = (g.l3 + g.l4 * np.cos(t)) ** 2 - g.l1**2
    return g.l4 * np.sin(t), up * np.sqrt(np.maximum(square, 0.0)), 1.0 + 0 * t, 0.0 * t


def _leg2(g: Geometry, mode: WorkingMode, t: FloatArray, far: FloatArray, _: FloatArray) -> Point:
    """Return positions of C1 where leg 2 is stretched or folded.

    These positions are circles about A2 + (2 l5, 0, 0).
    """
    radius = np.abs(g.l4 + far * g.l3)
    x, z = radius * np.cos(t) + 2 * g.l5 - g.l1, radius * np.sin(t)
    return x, z, 1.0 + 0 * t, 0.0 * t


def _elevation(
    g: Geometry, mode: WorkingMode, t: FloatArray, side: FloatArray, _: FloatArray
) -> Point:
    """Return positions of C1 at theta_1 = ``t`` that are as high as B1."""
    y, square = _rod_4(g, t)
    x, sin = side * np.sqrt(np.maximum(square, 0.0)), np.sin(t)
    return x, g.l3 * sin, mode.leg1 * y * sin, 0.0 * t


def _real(g: Geometry, factor: str, first: int, t: FloatArray) -> FloatArray:
    """Return a number for each angle ``t``, positive where the curve of a factor is real.

    ``first`` is the first of the two signs that select a branch of the curve; see :data:`Curve`.
    """
    if factor == "leg1":
        return (g.l3 + g.l4 * np.cos(t)) ** 2 - g.l1**2
    if factor == "elevation":
        return _rod_4(g, t)[1]
    if factor == "planar":
        _, _, apart, gap = _tangent(g, t, np.asarray(first))
        reach = np.minimum(g.l3 - np.abs(apart + gap), apart - gap - g.l3)
        return np.minimum(_rod_4(g, t)[1] / g.l4, reach)
    return np.full_like(t, -1.0 if factor == "level3" and g.l4 <= g.l7 else 1.0)


_CURVES: dict[str, Curve] = {
    "level3": _level3,
    "planar": _planar,
    "leg1": _leg1,
    "leg2": _leg2,
    "elevation": _elevation,
}


@dataclass(frozen=True)
class _Arcs:
    """The n arcs of the curve on which point C1 lies if one factor is zero.

    The points of the curve are a function of an angle and two signs. Each arc has fixed signs, and
    its angle runs over one interval.

    Attributes:
        curve: Function that returns points of the curve; see :data:`Curve`.
        first: (n,) first sign of each arc, -1 or 1.
        second: (n,) second sign of each arc, -1 or 1.
        middle: (n,) rad, middle of the angle's interval.
        half: (n,) rad, half the length of the angle's interval.
    """

    curve: Curve
    geometry: Geometry
    mode: WorkingMode
    first: FloatArray
    second: FloatArray
    middle: FloatArray
    half: FloatArray

    def at(self, arc: IntArray, t: FloatArray) -> Point:
        """Return points of k arcs.

        Args:
            arc: (k,) indices of the arcs.
            t: (k, ...) places on the arcs: 0 at the start of an arc, pi at its end.
        """
        arc = arc.reshape(-1, *[1] * (t.ndim - 1))
        # As a function of t instead of the angle, the curve is smooth at both ends.
        angle = self.middle[arc] - self.half[arc] * np.cos(t)
        signs = self.first[arc] + 0 * t, self.second[arc] + 0 * t
        return self.curve(self.geometry, self.mode, angle, *signs)


@lru_cache(maxsize=64)
def _arcs(geometry: Geometry, mode: WorkingMode, factor: str) -> tuple[_Arcs, Point, FloatArray]:
    """Return the n arcs of a factor, each divided into cells.

    Returns:
        The arcs, the points (n, cells + 1) at the ends of cells, and the lengths (n, cells) m of
        cells.
    """
    rows = [
        (first, second, (low + high) / 2, (high - low) / 2)
        for first in (-1, 1)
        for low, high in _intervals(partial(_real, geometry, factor, first))
        for second in ((-1, 1) if factor == "planar" else (1,))
    ]
    table = np.array(rows, dtype=np.float64).reshape(-1, 4).T
    arcs, t = _Arcs(_CURVES[factor], geometry, mode, *table), np.linspace(0, np.pi, _FINE + 1)
    points = arcs.at(np.arange(len(rows)), np.broadcast_to(t, (len(rows), len(t))))
    chords = np.hypot(*np.diff(points[:2])).reshape(len(rows), _CELLS, _FINE // _CELLS)
    x, z, p, q = (part[:, :: _FINE // _CELLS] for part in points)
    for part in (x, z, p, q):
        part.flags.writeable = False  # they serve all callers
    return arcs, (x, z, p, q), chords.sum(-1)


def curves(factor: str, mode: WorkingMode, geometry: Geometry) -> Point:
    """Return the k curves of point C1 on which a singular factor can be zero.

    Each curve is divided into 256 steps, so the arrays of points are (k, 257).

    Args:
        factor: ``"level3"``, ``"planar"``, ``"leg1"``, ``"leg2"`` or ``"elevation"``.
        mode: The working mode. Points of other working modes are included; see :data:`Point`.

    Raises:
        InputError: If no curve belongs to a factor of this name.
    """
    if factor not in _CURVES:
        raise InputError("factor", factor, f"one of {', '.join(_CURVES)}")
    return _arcs(geometry, mode, factor)[1]


def _intervals(real: Callable[[FloatArray], FloatArray]) -> list[tuple[float, float]]:
    """Return the intervals of an angle, from 0 to 2 pi, in which the function ``real`` is positive.

    The function is computed at equally spaced angles. Intervals shorter than the distance between
    two of these angles are found too.
    """
    t = np.linspace(0.0, 2 * np.pi, _GRID + 1)
    values = real(t)
    towards = np.abs(values)
    turns = np.flatnonzero((towards[1:-1] <= towards[:-2]) & (towards[1:-1] <= towards[2:])) + 1
    sign = np.sign(values[turns])[:, None]
    extrema = _zoom(lambda s: sign * real(s), t[turns - 1], t[turns + 1])
    t = np.sort(np.concatenate([t, extrema]))
    inside = real(t) > 0
    change = np.flatnonzero(inside[1:] != inside[:-1])
    within, beyond = t[change + ~inside[change]], t[change + inside[change]]
    for _ in range(64):
        middle = (within + beyond) / 2
        kept = real(middle) > 0
        within, beyond = np.where(kept, middle, within), np.where(kept, beyond, middle)
    ends = np.sort(np.concatenate([within, t[[0, -1]][inside[[0, -1]]]]))
    return list(zip(ends[::2].tolist(), ends[1::2].tolist(), strict=True))


def _zoom(
    function: Callable[[FloatArray], FloatArray], low: FloatArray, high: FloatArray
) -> FloatArray:
    """Return the arguments (n,) at which n functions are smallest, between ``low`` and ``high``.

    ``function`` computes all n functions together. Row i of its argument (n, m) has m arguments of
    function i. Row i of its result (n, m) has the m values of this function.
    """
    steps, rows = np.linspace(0, 1, _NODES), np.arange(len(low))
    found = low
    for _ in range(_ROUNDS):
        nodes = low[:, None] + (high - low)[:, None] * steps
        best = function(nodes).argmin(axis=-1)
        found = nodes[rows, best]
        low = nodes[rows, np.maximum(best - 1, 0)]
        high = nodes[rows, np.minimum(best + 1, _NODES - 1)]
    return found


def nearest(
    points: FloatArray, limit: FloatArray, mode: WorkingMode, geometry: Geometry
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Find the nearest point of the five surfaces within a limit, in one working mode.

    Args:
        points: (n, 3) m, 0 <= y <= l7.
        limit: (n,) m, at most the distance to the planes y = 0 and |y| = l7, and to the boundary
            of leg 3's reach.

    Returns:
        Distance (n,) m, nearest point (n, 3) m and index of the factor (n,). If no surface is
        nearer than ``limit``, they are ``limit``, the point itself and -1.
    """
    distance, feet, factor = limit.copy(), points.copy(), np.full(len(points), -1)
    for start in range(0, len(points), _BLOCK):
        rows = np.arange(start, min(start + _BLOCK, len(points)))
        for name in _CURVES:
            row, reach, foot = _feet(points[rows], distance[rows], mode, geometry, name)
            for index in np.argsort(-reach, kind="stable"):
                target = rows[row[index]]
                if reach[index] < distance[target]:
                    distance[target], feet[target] = reach[index], foot[index]
                    factor[target] = Factors._fields.index(name)
    return distance, feet, factor


def _feet(
    points: FloatArray, limit: FloatArray, mode: WorkingMode, g: Geometry, name: str
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return candidates for the nearest points of a surface.

    Returns:
        For each of c candidates: row of ``points`` (c,), distance (c,) m, point of the surface
        (c, 3) m.
    """
    arcs, (x, z, p, q), length = _arcs(g, mode, name)
    link3 = points - [g.l2, 0, 2 * g.l6]  # C1 if link 7 had length 0

    def offset(rows: FloatArray, x: FloatArray, z: FloatArray) -> tuple[FloatArray, ...]:
        """Return three lengths, m, that locate the points ``rows`` (..., 3) m relative to circles.

        The circles have the centres (x, 0, z) and the radius l7, and are parallel to the plane xy.
        The first result is the distance from the circle to the point. The second result is x of
        the point minus x of the centre. The third result is the distance from the centre to the
        point in the projection on the plane xy.
        """
        level = rows[..., 0] - x
        radius = np.hypot(level, rows[..., 1])
        return np.hypot(radius - g.l7, rows[..., 2] - z), level, radius

    def belongs(point: Point, level: FloatArray, radius: FloatArray) -> BoolArray:
        """Return whether points of a curve belong to the working mode.

        ``level`` and ``radius`` are the second and third result of offset().
        """
        ours: BoolArray = (point[2] * radius + point[3] * level > 0) & (mode.cos_beta * level > 0)
        return ours

    # Search each cell whose ends and length allow a point nearer than the nearest one so far.
    ends, level, radius = offset(link3[:, None, None], x, z)
    ours = belongs((x, z, p, q), level, radius)
    known = np.minimum(limit, np.where(ours, ends, np.inf).min(axis=(1, 2), initial=np.inf))
    least = (ends[..., :-1] + ends[..., 1:] - length) / 2
    row, arc, cell = np.nonzero(least <= known[:, None, None])
    step = np.pi / _CELLS
    low, all_ = cell.astype(np.float64) * step, np.arange(len(cell))

    def on(cells: IntArray, t: FloatArray) -> tuple[Point, tuple[FloatArray, ...], BoolArray]:
        """Return points on k arcs, and the results of offset() and belongs() for these points.

        Search i looks in cell ``cell[i]`` of arc ``arc[i]`` for the point nearest to
        ``points[row[i]]``. ``cells`` (k,) are the numbers i of k searches. ``t`` (k, ...) are
        places on the arcs of these searches, as in :meth:`_Arcs.at`.
        """
        point, rows = arcs.at(arc[cells], t), link3[row[cells]]
        found = offset(rows[:, None] if t.ndim > 1 else rows, *point[:2])
        return point, found, belongs(point, *found[1:])

    t = _zoom(lambda t: on(all_, t)[1][0], low, low + step)
    # Where a cell's nearest point is in another mode, find its nearest point in this mode.
    either = ours[row, arc, cell] | ours[row, arc, cell + 1]
    split = np.flatnonzero(either & ~on(all_, t)[2])

    def within(t: FloatArray) -> FloatArray:
        _, (apart, *_), real = on(split, t)
        return np.where(real, apart, np.inf)

    if len(split):
        t[split] = _zoom(within, low[split], low[split] + step)
    (x, z, *_), (_, level, radius), real = on(all_, t)
    scale = g.l7 / np.where(radius > 0, radius, 1.0)
    foot = np.stack([x + level * scale + g.l2, points[row, 1] * scale, z + 2 * g.l6], axis=-1)
    reach = np.linalg.norm(foot - points[row], axis=-1)
    return row[real], reach[real], foot[real]
