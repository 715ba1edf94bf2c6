"""Singular configurations: which they are, of what kind, and how far away; batched.

A configuration is singular where one of the factors of the Jacobians' determinants vanishes
(section "Singularity analysis", Eqs. 16 and 17, corrected): the parallel factors are those of
det A, the serial ones those of det B. Everything is in the paper frame, in metres and radians.

A constraint singularity is no factor of either determinant: where z_C1 = z_B1, the rods of the 4S
parallelogram no longer keep link 3' from turning about y. It is reported apart, and
:func:`nearest_singularity` does not count it.

All functions raise InputError for what is no array (..., 3) of numbers. Those that
classify raise it also for entries that are not finite, UnreachableError if some entry does not
exist on the branch, and ConfigurationError if the tolerance is not between 0 and 1.
"""

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import BoolArray, FloatArray, IntArray
from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics import equations, inverse
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.kinematics.jacobian import Factors, factors
from tpm_gym.kinematics.jacobian import factors_at as factors_at
from tpm_gym.kinematics.modes import DEFAULT_ASSEMBLY, ELBOWS_OUT, AssemblyMode, WorkingMode

FACTORS = equations.Factors._fields[:7]
"""Names of the factors, in the order of every axis of length 7 here: 3 parallel, then 4 serial."""

_LEVEL3, _PLANAR, _LEG1, _LEG3 = 1, 2, 4, 6
# What the search for the nearest singularity is made of; see nearest_singularity.
_DIRECTIONS = 32
_OVERREACH = 1.5
_STEPS = 8
_HALVINGS = 34
_ROUNDS = 8
_DEPTH = 2e-5  # how far inside a surface its normal is taken, in units of l4
_BLOCK = 256


class SingularityType(IntFlag):
    """The kinds of Gosselin and Angeles (1990): 1 serial, 2 parallel, 3 both at once."""

    NONE = 0
    SERIAL = 1
    PARALLEL = 2
    BOTH = 3


@dataclass(frozen=True)
class Classification:
    """What :func:`classify` returns.

    Attributes:
        kind: (...,) values of :class:`SingularityType`.
        vanishing: (..., 7) bool, which of :data:`FACTORS` are zero within the tolerance.
        factors: (..., 7), the factors made dimensionless by :func:`dimensionless`.
        constraint: (...,) bool, whether |z_C1 - z_B1| / l4 is within the tolerance.
        tolerance: What "zero" means here.
    """

    kind: IntArray
    vanishing: BoolArray
    factors: FloatArray
    constraint: BoolArray
    tolerance: float


@dataclass(frozen=True)
class NearestSingularity:
    """What :func:`nearest_singularity` returns.

    Attributes:
        distance: (...,) m; NaN where not valid.
        point: (..., 3) m, a singular position of P at that distance; NaN where not valid.
        factor: (...,) index in :data:`FACTORS` of what vanishes there; -1 where not valid.
        valid: (...,) bool, whether the position is reachable on both branches.
    """

    distance: FloatArray
    point: FloatArray
    factor: IntArray
    valid: BoolArray


def dimensionless(values: Factors, geometry: Geometry = PAPER) -> FloatArray:
    """The factors (..., 7) over their natural sizes, so that one tolerance suits all.

    level3 over l4, planar over l4^2, legs over l3 l4; sin(beta) and cos(beta) as they are.
    """
    l3, l4 = geometry.l3, geometry.l4
    sizes = np.array([1.0, l4, l4**2, 1.0, l3 * l4, l3 * l4, l3 * l4])
    scaled: FloatArray = np.concatenate([values.parallel, values.serial], axis=-1) / sizes
    return scaled


def classify(
    theta: ArrayLike,
    branch: AssemblyMode = DEFAULT_ASSEMBLY,
    geometry: Geometry = PAPER,
    tolerance: float = 1e-6,
) -> Classification:
    """Tell what kind of singularity theta (..., 3) rad is in (section "Singularity analysis").

    A factor made dimensionless counts as zero up to ``tolerance``. From joint angles, a factor that
    merges two branches is known to the square root of rounding only, so less than 1e-7 makes no
    sense here.
    """
    return _classify(factors(theta, branch, geometry), geometry, tolerance)


def classify_at(
    position: ArrayLike,
    branch: WorkingMode = ELBOWS_OUT,
    geometry: Geometry = PAPER,
    tolerance: float = 1e-6,
) -> Classification:
    """Tell what kind of singularity points (..., 3) m are in, on one working mode.

    A factor made dimensionless counts as zero up to ``tolerance``. A leg's factor grows as the
    square root of the distance to its boundary: 1e-6 is reached 1e-12 m from it.
    """
    inverse(position, branch, geometry)  # raises where it is not reachable, and says why
    return _classify(factors_at(position, branch, geometry), geometry, tolerance)


def nearest_singularity(
    position: ArrayLike,
    branch: WorkingMode = ELBOWS_OUT,
    assembly: AssemblyMode = DEFAULT_ASSEMBLY,
    geometry: Geometry = PAPER,
) -> NearestSingularity:
    """Distance from points (..., 3) m to the nearest singular point, in Cartesian space.

    That is the radius of the largest ball about the point in which P can move without meeting a
    singularity. The planes y = 0 (sin(beta) = 0) and |y| = l7 (cos(beta) = 0) are exact, and so is
    leg 3 (its boundary is a torus). They bound the radius by l7 / 2. Within it, the other surfaces
    are searched for with rays: 32 directions of a Fibonacci lattice and the gradients of the
    factors, 8 steps each, a crossing found by bisection; then up to 8 times along the normal of the
    surface that was hit, which leads to the foot of the perpendicular.

    What is returned is a true distance to a true singular point, so never too small; it is too
    large only where a surface that bends sharply, or a sliver beyond two close surfaces, escapes
    the rays. A test compares with thousands of rays a point. It takes a few milliseconds a point.
    Points that are not finite, or not on both branches, are not valid.
    """
    points = np.array(position, dtype=np.float64)
    values = dimensionless(factors_at(points, branch, geometry), geometry)
    with np.errstate(invalid="ignore"):
        valid = values[..., _PLANAR] * assembly.planar >= 0
        valid &= points[..., 1] * assembly.sin_beta >= 0
    shape = valid.shape
    distance, feet = np.full(valid.size, np.nan), np.full((valid.size, 3), np.nan)
    factor, rows, flat = np.full(valid.size, -1), np.flatnonzero(valid), points.reshape(-1, 3)
    for start in range(0, len(rows), _BLOCK):
        some = rows[start : start + _BLOCK]
        mirrored = flat[some] * [1, assembly.sin_beta, 1]  # both halves give the same numbers
        distance[some], foot, factor[some] = _nearest(mirrored, branch, geometry)
        feet[some] = foot * [1, assembly.sin_beta, 1]
    return NearestSingularity(
        distance.reshape(shape), feet.reshape(*shape, 3), factor.reshape(shape), valid
    )


def _classify(values: Factors, geometry: Geometry, tolerance: float) -> Classification:
    if not 0 < tolerance < 1:
        raise ConfigurationError("tolerance", tolerance, "a number between 0 and 1")
    scaled = dimensionless(values, geometry)
    vanishing = np.abs(scaled) <= tolerance
    parallel, serial = vanishing[..., :3].any(axis=-1), vanishing[..., 3:].any(axis=-1)
    kind = SingularityType.PARALLEL.value * parallel + SingularityType.SERIAL.value * serial
    constraint = np.abs(values.constraint) <= tolerance * geometry.l4
    return Classification(np.asarray(kind), vanishing, scaled, np.asarray(constraint), tolerance)


def _nearest(
    points: FloatArray, branch: WorkingMode, geometry: Geometry
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Distance (n,), foot (n, 3) and factor (n,) for points (n, 3) with 0 <= y <= l7."""
    distance, feet, factor = _exact(points, geometry)
    sheet = _Sheet(branch, geometry)
    signs = np.sign(sheet.values(points))
    lattice = np.broadcast_to(_lattice(_DIRECTIONS), (len(points), _DIRECTIONS, 3))
    directions = np.concatenate([lattice, sheet.normals(points)[:, :4]], axis=1)
    # Rays longer than the bound: a flat surface that touches the ball meets all within 48 degrees
    # of its normal, and so at least one. Feet beyond the bound are dropped below.
    reach, hit = sheet.cast(points, directions, _OVERREACH * distance, signs)
    # One start for each surface: the nearest hit may belong to another than the nearest foot.
    found = np.where(np.arange(4)[:, None, None] == hit, reach, np.inf)
    surface, row = np.nonzero(np.isfinite(found.min(axis=-1)))
    start = found[surface, row].argmin(axis=-1)
    ray, length = directions[row, start], found[surface, row, start]
    kind = surface.copy()
    for _ in range(_ROUNDS):
        depth = np.minimum(_DEPTH * geometry.l4, length / 2)
        inside = points[row] + (length - depth)[:, None] * ray
        normal = sheet.normals(inside)[np.arange(len(row)), kind]
        shorter, other = sheet.cast(points[row], normal[:, None], length, signs[row])
        better = (other[:, 0] >= 0) & (shorter[:, 0] < length)
        ray[better], length[better] = normal[better], shorter[better, 0]
        kind[better] = np.minimum(other[better, 0], 3)
    for index in np.argsort(-length, kind="stable"):
        if length[index] < distance[row[index]]:
            distance[row[index]] = length[index]
            feet[row[index]] = points[row[index]] + length[index] * ray[index]
            factor[row[index]] = (_LEVEL3, _PLANAR, _LEG1, _LEG1 + 1)[kind[index]]
    return distance, feet, factor


def _exact(points: FloatArray, geometry: Geometry) -> tuple[FloatArray, FloatArray, IntArray]:
    """The nearest of the planes y = 0, y = l7 and the torus of leg 3: distance, foot, factor."""
    centre = np.array([geometry.l1 - geometry.l2, 0.0, geometry.l6])
    offset = points - centre
    radius = np.hypot(offset[:, 0], offset[:, 2])
    safe = np.where(radius > 0, radius, 1.0)
    level = np.where(radius > 0, offset[:, 0] / safe, 1.0)
    spoke = np.stack([level, np.zeros_like(radius), offset[:, 2] / safe], axis=-1)
    distances, feet = [points[:, 1], geometry.l7 - points[:, 1]], [points * [1, 0, 1]]
    feet.append(feet[0] + [0, geometry.l7, 0])
    # Rod 3 in the half plane of P about the axis of motor 3: stretched beyond the elbow on P's
    # side (outer part of the torus), or folded over that on the far side (inner part).
    for side in (1, -1):
        elbow = centre + side * geometry.l3 * spoke
        rod = points - elbow
        length = np.linalg.norm(rod, axis=-1)
        distances.append(side * (geometry.l4 - length))
        feet.append(elbow + rod * (geometry.l4 / length)[:, None])
    table = np.maximum(np.stack(distances), 0.0)
    first = table.argmin(axis=0)
    rows = np.arange(len(points))
    return table[first, rows], np.stack(feet)[first, rows], np.array([0, 3, 6, 6])[first]


def _lattice(count: int) -> FloatArray:
    """Unit vectors (count, 3) spread evenly over the sphere (Fibonacci lattice)."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=-1)


class _Sheet:
    """The reachable set of one working mode, cut by level3 = 0 and planar = 0.

    Surfaces are numbered as the columns of :meth:`values`.
    """

    def __init__(self, branch: WorkingMode, geometry: Geometry) -> None:
        self.branch, self.geometry = branch, geometry

    def values(self, points: FloatArray) -> FloatArray:
        """(..., 5): level3, planar, and the squares of the legs' factors, dimensionless.

        The squares are smooth where the factors themselves have a vertical tangent.
        """
        scaled = dimensionless(factors_at(points, self.branch, self.geometry), self.geometry)
        rods = scaled[..., _LEG1 : _LEG3 + 1] ** 2
        return np.concatenate([scaled[..., [_LEVEL3, _PLANAR]], rods], axis=-1)

    def normals(self, points: FloatArray) -> FloatArray:
        """Unit vectors (n, 5, 3) along which each value goes to zero; along x where none is."""
        step = _DEPTH * self.geometry.l4 / 8
        moves = step * np.concatenate([np.eye(3), -np.eye(3)])
        values = self.values(points[:, None] + moves)
        slopes = np.swapaxes(values[:, :3] - values[:, 3:], 1, 2)
        slopes = -slopes * np.sign(values[:, 0])[..., None]
        size = np.linalg.norm(slopes, axis=-1, keepdims=True)
        usable = np.isfinite(size) & (size > 0)
        with np.errstate(invalid="ignore"):
            return np.where(usable, slopes / np.where(usable, size, 1.0), [1.0, 0.0, 0.0])

    def cast(
        self, points: FloatArray, directions: FloatArray, length: FloatArray, signs: FloatArray
    ) -> tuple[FloatArray, IntArray]:
        """Where rays (n, k, 3) of ``length`` (n,) first leave the sheet: distance, surface.

        Both (n, k); infinity and -1 where a ray stays inside.
        """
        n, k = directions.shape[:2]
        steps = np.arange(1, _STEPS + 1) / _STEPS * length[:, None]
        trials = points[:, None, None] + directions[:, :, None] * steps[:, None, :, None]
        inside = self._inside(trials, signs[:, None, None])
        row, ray = np.nonzero(~inside.all(axis=-1))
        first = inside[row, ray].argmin(axis=-1)
        far = steps[row, first]
        near = far - steps[row, 0]
        for _ in range(_HALVINGS):
            middle = (near + far) / 2
            where = points[row] + middle[:, None] * directions[row, ray]
            kept = self._inside(where, signs[row])
            near, far = np.where(kept, middle, near), np.where(kept, far, middle)
        values = np.abs(self.values(points[row] + near[:, None] * directions[row, ray]))
        reach, surface = np.full((n, k), np.inf), np.full((n, k), -1)
        reach[row, ray] = near
        surface[row, ray] = np.where(np.isnan(values), np.inf, values).argmin(axis=-1)
        return reach, surface

    def _inside(self, points: FloatArray, signs: FloatArray) -> BoolArray:
        values = self.values(points)
        return np.asarray((values[..., :2] * signs[..., :2] > 0).all(axis=-1))
