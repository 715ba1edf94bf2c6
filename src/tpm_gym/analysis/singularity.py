"""Singular configurations: which they are, of what kind, and how far away; batched.

A configuration is singular where one of eight factors vanishes: the parallel ones are those of
det A, the serial ones those of det B (section "Singularity analysis", Eqs. 16 and 17, corrected),
and the last, the elevation z_C1 - z_B1 of rods 4, is that of the constraint which keeps link 3'
from turning about y. The paper lacks it; with it the parallel ones are complete: the closures'
determinant in xC, zC, beta and that turn is a product of the four. Everything is in the paper
frame, in metres and radians.

All functions raise InputError for what is no array (..., 3) of numbers. Those that
classify raise it also for entries that are not finite, UnreachableError if some entry does not
exist on the branch, and ConfigurationError if the tolerance is not between 0 and 1.
"""

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.analysis import sheets
from tpm_gym.arrays import BoolArray, FloatArray, IntArray
from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics import equations, inverse
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.kinematics.jacobian import Factors, factors
from tpm_gym.kinematics.jacobian import factors_at as factors_at
from tpm_gym.kinematics.modes import DEFAULT_ASSEMBLY, ELBOWS_OUT, AssemblyMode, WorkingMode

FACTORS = equations.Factors._fields
"""Names of the factors, in the order of every axis of length 8 here: 3 parallel, 4 serial, 1 of a
constraint."""

_SIN_BETA, _PLANAR, _COS_BETA, _LEG3 = (
    FACTORS.index(name) for name in ("sin_beta", "planar", "cos_beta", "leg3")
)


class SingularityType(IntFlag):
    """The kinds of Gosselin and Angeles (1990), and constraint singularities; they add up."""

    NONE = 0
    SERIAL = 1
    PARALLEL = 2
    BOTH = 3
    CONSTRAINT = 4


@dataclass(frozen=True)
class Classification:
    """What :func:`classify` returns.

    Attributes:
        kind: (...,) values of :class:`SingularityType`.
        vanishing: (..., 8) bool, which of :data:`FACTORS` are zero within the tolerance.
        factors: (..., 8), the factors made dimensionless by :func:`dimensionless`.
        tolerance: What "zero" means here.
    """

    kind: IntArray
    vanishing: BoolArray
    factors: FloatArray
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
    """The factors (..., 8) over their natural sizes, so that one tolerance suits all.

    level3 and elevation over l4, planar over l4^2, legs over l3 l4; sin(beta) and cos(beta) as they
    are.
    """
    l3, l4 = geometry.l3, geometry.l4
    sizes = np.array([1.0, l4, l4**2, 1.0, l3 * l4, l3 * l4, l3 * l4, l4])
    elevation = np.asarray(values.constraint)[..., None]
    scaled: FloatArray = (
        np.concatenate([values.parallel, values.serial, elevation], axis=-1) / sizes
    )
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
    singularity, of a constraint or not. The planes y = 0 (sin(beta) = 0) and |y| = l7
    (cos(beta) = 0) are exact, and so is leg 3 (its boundary is a torus). The other surfaces are
    curves that link 7 sweeps; wherever a curve can be nearer than what is known, the foot is sought
    (:mod:`tpm_gym.analysis.sheets`). Points that are not finite, or not on both branches, are not
    valid.
    """
    points = np.array(position, dtype=np.float64)
    values = dimensionless(factors_at(points, branch, geometry), geometry)
    with np.errstate(invalid="ignore"):
        valid = values[..., _PLANAR] * assembly.planar >= 0
        valid &= points[..., 1] * assembly.sin_beta >= 0
    shape = valid.shape
    distance, feet = np.full(valid.size, np.nan), np.full((valid.size, 3), np.nan)
    factor, rows = np.full(valid.size, -1), valid.ravel()
    mirror = np.array([1, assembly.sin_beta, 1])  # both halves give the same numbers
    inside = points.reshape(-1, 3)[rows] * mirror
    edge, at_edge, which = _edges(inside, geometry)
    distance[rows], foot, found = sheets.nearest(inside, edge, branch, geometry)
    feet[rows] = np.where(found[:, None] < 0, at_edge, foot) * mirror
    factor[rows] = np.where(found < 0, which, found)
    return NearestSingularity(
        distance.reshape(shape), feet.reshape(*shape, 3), factor.reshape(shape), valid
    )


def _classify(values: Factors, geometry: Geometry, tolerance: float) -> Classification:
    if not 0 < tolerance < 1:
        raise ConfigurationError("tolerance", tolerance, "a number between 0 and 1")
    scaled = dimensionless(values, geometry)
    vanishing = np.abs(scaled) <= tolerance
    kinds = SingularityType.PARALLEL, SingularityType.SERIAL, SingularityType.CONSTRAINT
    parts = np.split(vanishing, [3, 7], axis=-1)
    kind = sum(kind.value * part.any(axis=-1) for kind, part in zip(kinds, parts, strict=True))
    return Classification(np.asarray(kind), vanishing, scaled, tolerance)


def _edges(points: FloatArray, geometry: Geometry) -> tuple[FloatArray, FloatArray, IntArray]:
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
    factor = np.array([_SIN_BETA, _COS_BETA, _LEG3, _LEG3])
    return table[first, rows], np.stack(feet)[first, rows], factor[first]
