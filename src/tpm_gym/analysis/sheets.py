"""The singular surfaces as curves of link 3' that link 7 sweeps, and the feet of points on them.

Where xC and zC alone decide whether a factor vanishes, its surface is a curve of C1 in the plane
y = 0, and P is on the circle of radius l7 about (xC + l2, 0, zC + 2 l6) that is parallel to xy.
That is so for level3, planar, leg 1, leg 2 and elevation, and each curve has a closed form over one
angle. The point of a circle that is nearest to P is where the ray from its centre meets it, so what
is left of the distance to a surface is a minimum over that one angle.

Curves consist of arcs, each over an interval of its angle in which it is real. Within an arc the
angle is ``middle - half cos(t)``, t from 0 to pi, which makes the curve smooth at both ends.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tpm_gym.arrays import FloatArray, IntArray
from tpm_gym.kinematics.equations import Factors
from tpm_gym.kinematics.geometry import Geometry
from tpm_gym.kinematics.modes import WorkingMode

Point = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""xC and zC, m, and p, q: it belongs to the working mode if p + q cos(beta) > 0."""
Curve = Callable[[Geometry, WorkingMode, FloatArray, FloatArray, FloatArray], Point]
"""From an angle and two signs, that name the branch of a curve."""

_CELLS = 256  # of an arc
_FINER = 4  # times as many chords measure how long a cell is
_NODES, _ROUNDS = 9, 16  # each round keeps a quarter of a cell
_GRID = 2048  # of a full turn, in which intervals are sought
_BLOCK = 64


def _level3(g: Geometry, mode: WorkingMode, t: FloatArray, up: FloatArray, _: FloatArray) -> Point:
    """Circles about B3's, seen along y: rod 11 is parallel to link 7, seen along z."""
    cos, sin = np.cos(t), np.sin(t)
    rise = up * np.sqrt(max(g.l4**2 - g.l7**2, 0.0))
    x, z = g.l1 - 2 * g.l2 + g.l3 * cos, g.l3 * sin - g.l6 + rise
    return x, z, mode.leg3 * rise * cos, -mode.leg3 * g.l7 * sin


def _rod_4(g: Geometry, theta_1: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How far B1 is from the plane y = 0, and the square of how long rod 4 is in that plane."""
    y = g.l1 + g.l3 * np.cos(theta_1)
    return y, g.l4**2 - y * y


def _tangent(
    g: Geometry, t: FloatArray, side: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Where the planar factor vanishes at theta_1, seen along y, with leg 2 moved until C2 is C1.

    Returns:
        B1 from A2, level, upwards and in all, and B1 from B2 along rod 4, which is less than zero.
        ``side`` is -1 where rods 4 and 6 point against each other.
    """
    level, up = g.l1 - 2 * g.l5 + 0 * t, g.l3 * np.sin(t)
    rod = side * np.sqrt(np.maximum(_rod_4(g, t)[1], 0.0))
    return level, up, np.hypot(level, up), rod - g.l4


def _planar(
    g: Geometry, mode: WorkingMode, t: FloatArray, side: FloatArray, bend: FloatArray
) -> Point:
    """Over theta_1: both rods in one direction psi, which arm 2 then has to reach."""
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
    """Over the rods' elevation from the plane of arm 1, in line with it."""
    square = (g.l3 + g.l4 * np.cos(t)) ** 2 - g.l1**2
    return g.l4 * np.sin(t), up * np.sqrt(np.maximum(square, 0.0)), 1.0 + 0 * t, 0.0 * t


def _leg2(g: Geometry, mode: WorkingMode, t: FloatArray, far: FloatArray, _: FloatArray) -> Point:
    """Circles about A2."""
    radius = np.abs(g.l4 + far * g.l3)
    x, z = radius * np.cos(t) + 2 * g.l5 - g.l1, radius * np.sin(t)
    return x, z, 1.0 + 0 * t, 0.0 * t


def _elevation(
    g: Geometry, mode: WorkingMode, t: FloatArray, side: FloatArray, _: FloatArray
) -> Point:
    """Over theta_1: C1 as high as B1."""
    y, square = _rod_4(g, t)
    x, sin = side * np.sqrt(np.maximum(square, 0.0)), np.sin(t)
    return x, g.l3 * sin, mode.leg1 * y * sin, 0.0 * t


def _real(g: Geometry, factor: str, first: int) -> Callable[[FloatArray], FloatArray]:
    """What is positive where a curve's branch is real, over its angle."""
    if factor == "leg1":
        return lambda t: (g.l3 + g.l4 * np.cos(t)) ** 2 - g.l1**2
    if factor == "elevation":
        return lambda t: _rod_4(g, t)[1]
    if factor == "planar":

        def triangle(t: FloatArray) -> FloatArray:
            _, _, apart, gap = _tangent(g, t, np.asarray(first))
            reach = np.minimum(g.l3 - np.abs(apart + gap), apart - gap - g.l3)
            return np.minimum(_rod_4(g, t)[1] / g.l4, reach)

        return triangle
    exists = -1.0 if factor == "level3" and g.l4 <= g.l7 else 1.0
    return lambda t: np.full_like(t, exists)


_CURVES: dict[str, tuple[Curve, tuple[int, ...]]] = {
    "level3": (_level3, (1,)),
    "planar": (_planar, (-1, 1)),
    "leg1": (_leg1, (1,)),
    "leg2": (_leg2, (1,)),
    "elevation": (_elevation, (1,)),
}


@dataclass(frozen=True)
class _Arcs:
    """All arcs (m,) of one factor: their signs, and their intervals of the angle, rad."""

    curve: Curve
    geometry: Geometry
    mode: WorkingMode
    first: FloatArray
    second: FloatArray
    middle: FloatArray
    half: FloatArray

    def at(self, arc: IntArray, t: FloatArray) -> Point:
        """Points at t (k, ...) of arcs (k,)."""
        arc = arc.reshape(-1, *[1] * (t.ndim - 1))
        angle = self.middle[arc] - self.half[arc] * np.cos(t)
        signs = self.first[arc] + 0 * t, self.second[arc] + 0 * t
        return self.curve(self.geometry, self.mode, angle, *signs)

    def sampled(self) -> tuple[Point, FloatArray]:
        """Points (m, cells + 1), and how long the curve is between them, (m, cells) m."""
        arcs, t = np.arange(len(self.first)), np.linspace(0, np.pi, _FINER * _CELLS + 1)
        x, z, p, q = self.at(arcs, np.broadcast_to(t, (len(arcs), len(t))))
        chords = np.hypot(np.diff(x), np.diff(z)).reshape(len(arcs), _CELLS, _FINER)
        return (x[:, ::_FINER], z[:, ::_FINER], p[:, ::_FINER], q[:, ::_FINER]), chords.sum(-1)


@lru_cache(maxsize=64)
def _arcs(geometry: Geometry, mode: WorkingMode, factor: str) -> tuple[_Arcs, Point, FloatArray]:
    curve, seconds = _CURVES[factor]
    rows = [
        (first, second, (low + high) / 2, (high - low) / 2)
        for first in (-1, 1)
        for low, high in _intervals(_real(geometry, factor, first))
        for second in seconds
    ]
    table = np.array(rows, dtype=np.float64).reshape(-1, 4).T
    arcs = _Arcs(curve, geometry, mode, *table)
    return arcs, *arcs.sampled()


def _intervals(real: Callable[[FloatArray], FloatArray]) -> list[tuple[float, float]]:
    """Where a function of an angle is positive, in a turn; short ones are found by extrema."""
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
    """Where a function of (n, nodes) is least between low and high (n,)."""
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
    """The nearest point of all these surfaces on a working mode, if it is nearer than a limit.

    Every cell of every arc is looked into that can hold something nearer than what is known, by the
    distances of its ends and its length.

    Args:
        points: (n, 3) m, 0 <= y <= l7.
        limit: (n,) m. Not more than the distance to the planes y = 0, |y| = l7 and to the edge of
            leg 3's reach.
        mode: The working mode.
        geometry: Link lengths.

    Returns:
        Distance (n,) m, foot (n, 3) m and factor (n,), an index of all; ``limit``, the point itself
        and -1 where nothing is nearer.
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
    """Row, distance and foot of what may be nearer than the limit on one factor's surface."""
    arcs, (x, z, p, q), length = _arcs(g, mode, name)
    link3 = points - [g.l2, 0, 2 * g.l6]  # C1, were link 7 of no length

    def offset(rows: FloatArray, x: FloatArray, z: FloatArray) -> tuple[FloatArray, ...]:
        """Distance, and level from C1 to P in x and altogether."""
        across, side, up = (rows[..., axis] for axis in range(3))
        level = across - x
        radius = np.hypot(level, side)
        return np.hypot(radius - g.l7, up - z), level, radius

    ends, level, radius = offset(link3[:, None, None], x, z)
    ours = (p * radius + q * level > 0) & (mode.cos_beta * level > 0)
    known = np.minimum(limit, np.where(ours, ends, np.inf).min(axis=(1, 2), initial=np.inf))
    least = (ends[..., :-1] + ends[..., 1:] - length) / 2
    row, arc, cell = np.nonzero(least <= known[:, None, None])
    here, step = link3[row][:, None], np.pi / _CELLS
    low = cell.astype(np.float64) * step

    def apart(t: FloatArray) -> FloatArray:
        x, z, _, _ = arcs.at(arc, t)
        return offset(here, x, z)[0]

    t = _zoom(apart, low, low + step)
    x, z, p, q = arcs.at(arc, t)
    _, level, radius = offset(link3[row], x, z)
    real = (p * radius + q * level > 0) & (mode.cos_beta * level > 0)
    scale = g.l7 / np.where(radius > 0, radius, 1.0)
    foot = np.stack([x + level * scale + g.l2, points[row, 1] * scale, z + 2 * g.l6], axis=-1)
    reach = np.linalg.norm(foot - points[row], axis=-1)
    return row[real], reach[real], foot[real]
