"""Singular configurations: their factors, their kind, and the distance to the nearest one.

A configuration is singular where one of eight factors is zero. Three parallel factors make up
det A and four serial factors make up det B (Eqs. 16 and 17, corrected). The eighth factor is the
elevation z_C1 - z_B1 of rods 4. If the elevation is zero, nothing keeps link 3' from turning about
y. The paper does not have this constraint singularity. All values are in the paper's frame, in m
and rad.

Functions of angles or points take arrays (..., 3) of numbers and raise InputError for anything
else. The functions that classify also raise InputError for numbers that are not finite,
UnreachableError if the branch does not exist at one of the angles or points, and ConfigurationError
if the tolerance is not between 0 and 1.
"""

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.analysis import sheets
from tpm_gym.arrays import BoolArray, FloatArray, IntArray, is_number, numbers
from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics import equations, inverse
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.kinematics.jacobian import Factors, factors
from tpm_gym.kinematics.jacobian import factors_at as factors_at
from tpm_gym.kinematics.modes import (
    DEFAULT_ASSEMBLY,
    ELBOWS_OUT,
    AssemblyMode,
    WorkingMode,
    require_mode,
)

FACTORS = equations.Factors._fields
"""Names of the eight factors: 3 parallel, 4 serial, elevation. Arrays (..., 8) of factors, as in
:class:`Classification`, have this order along the last axis."""

_SIN_BETA, _PLANAR, _COS_BETA, _LEG3 = map(
    FACTORS.index, ("sin_beta", "planar", "cos_beta", "leg3")
)


class SingularityType(IntFlag):
    """Kinds of singularities, as flags.

    SERIAL, PARALLEL and BOTH are the kinds of Gosselin and Angeles (1990).
    """

    NONE = 0
    SERIAL = 1
    PARALLEL = 2
    BOTH = 3
    CONSTRAINT = 4


@dataclass(frozen=True)
class Classification:
    """Kind of singularity of each configuration, from :func:`classify`.

    Attributes:
        kind: (...,) values of :class:`SingularityType`.
        vanishing: (..., 8) bool, true where a factor's absolute value is at most ``tolerance``.
        factors: (..., 8), the factors from :func:`dimensionless`.
    """

    kind: IntArray
    vanishing: BoolArray
    factors: FloatArray
    tolerance: float


@dataclass(frozen=True)
class NearestSingularity:
    """Nearest singular position of each point, from :func:`nearest_singularity`.

    Attributes:
        distance: (...,) m; NaN for points that are not valid.
        point: (..., 3) m, singular position of P at this distance; NaN for points not valid.
        factor: (...,) index in :data:`FACTORS` of the factor that is zero; -1 for points not valid.
        valid: (...,) bool, true where the working mode and the assembly mode reach the point.
    """

    distance: FloatArray
    point: FloatArray
    factor: IntArray
    valid: BoolArray


def dimensionless(values: Factors, geometry: Geometry = PAPER) -> FloatArray:
    """Divide the factors (..., 8) by lengths, so that one tolerance suits all factors.

    level3 and elevation are divided by l4, planar by l4^2, and leg1, leg2 and leg3 by l3 l4.
    """
    l3, l4 = geometry.l3, geometry.l4
    return np.stack(values, axis=-1) / [1.0, l4, l4**2, 1.0, l3 * l4, l3 * l4, l3 * l4, l4]


def classify(
    theta: ArrayLike,
    branch: AssemblyMode = DEFAULT_ASSEMBLY,
    geometry: Geometry = PAPER,
    tolerance: float = 1e-6,
) -> Classification:
    """Classify joint positions theta (..., 3) rad (the paper's section "Singularity analysis").

    A dimensionless factor counts as zero up to ``tolerance``. Use 1e-7 or more: where two branches
    merge, a factor computed from joint positions has an error of about the square root of the
    rounding error.
    """
    return _classify(factors(numbers("theta", theta), branch, geometry), geometry, tolerance)


def classify_at(
    position: ArrayLike,
    branch: WorkingMode = ELBOWS_OUT,
    geometry: Geometry = PAPER,
    tolerance: float = 1e-6,
) -> Classification:
    """Classify points (..., 3) m on one working mode.

    At the boundary of a leg's reach, the factor of the leg is zero. It grows as the square root of
    the distance to this boundary: at a distance of 1e-12 m, the factor is about 1e-6.
    """
    points = numbers("position", position)
    inverse(points, branch, geometry)  # raises UnreachableError with the reason
    return _classify(factors_at(points, branch, geometry), geometry, tolerance)


def nearest_singularity(
    position: ArrayLike,
    branch: WorkingMode = ELBOWS_OUT,
    assembly: AssemblyMode = DEFAULT_ASSEMBLY,
    geometry: Geometry = PAPER,
) -> NearestSingularity:
    """Find the nearest singular position of points (..., 3) m, in Cartesian space.

    The distance is the radius of the largest ball about the point in which P can move without a
    singularity of any kind. Distances to the planes y = 0 and |y| = l7 and to the boundary of leg
    3's reach are exact; other distances are numerical. Points are not valid if they are not finite,
    or not reachable in the working mode ``branch`` and the assembly mode ``assembly``.
    """
    require_mode(assembly, AssemblyMode)
    points = numbers("position", position)
    values = dimensionless(factors_at(points, branch, geometry), geometry)
    with np.errstate(invalid="ignore"):
        valid = values[..., _PLANAR] * assembly.planar >= 0
        valid &= points[..., 1] * assembly.sin_beta >= 0
    shape = valid.shape
    distance, feet = np.full(valid.size, np.nan), np.full((valid.size, 3), np.nan)
    factor, rows = np.full(valid.size, -1), valid.ravel()
    mirror = np.array([1, assembly.sin_beta, 1])  # the halves y > 0 and y < 0 are mirror images
    inside = points.reshape(-1, 3)[rows] * mirror
    edge, at_edge, which = _edges(inside, geometry)
    distance[rows], foot, found = sheets.nearest(inside, edge, branch, geometry)
    feet[rows] = np.where(found[:, None] < 0, at_edge, foot) * mirror
    factor[rows] = np.where(found < 0, which, found)
    return NearestSingularity(
        distance.reshape(shape), feet.reshape(*shape, 3), factor.reshape(shape), valid
    )


def _classify(values: Factors, geometry: Geometry, tolerance: float) -> Classification:
    if not is_number(tolerance) or not 0 < tolerance < 1:
        raise ConfigurationError("tolerance", tolerance, "a number between 0 and 1")
    scaled = dimensionless(values, geometry)
    vanishing = np.abs(scaled) <= tolerance
    kinds = SingularityType.PARALLEL, SingularityType.SERIAL, SingularityType.CONSTRAINT
    parts = np.split(vanishing, [3, 7], axis=-1)
    kind = sum(kind.value * part.any(axis=-1) for kind, part in zip(kinds, parts, strict=True))
    return Classification(np.asarray(kind), vanishing, scaled, tolerance)


def _edges(points: FloatArray, geometry: Geometry) -> tuple[FloatArray, FloatArray, IntArray]:
    """Find the nearest of three surfaces: the planes y = 0 and y = l7, and leg 3's torus.

    The torus is the boundary of leg 3's reach. Return the distance to the nearest surface, the
    nearest point on this surface, and the index of the factor that is zero on this surface.
    """
    centre = np.array([geometry.l1 - geometry.l2, 0.0, geometry.l6])
    offset = points - centre
    radius = np.hypot(offset[:, 0], offset[:, 2])
    safe = np.where(radius > 0, radius, 1.0)
    level = np.where(radius > 0, offset[:, 0] / safe, 1.0)
    spoke = np.stack([level, np.zeros_like(radius), offset[:, 2] / safe], axis=-1)
    distances, feet = [points[:, 1], geometry.l7 - points[:, 1]], [points * [1, 0, 1]]
    feet.append(feet[0] + [0, geometry.l7, 0])
    # Rod 3 lies in the half plane of P about the axis of motor 3. It is stretched beyond the elbow
    # on the side of P (outer part of the torus), or folded over the other elbow (inner part).
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
