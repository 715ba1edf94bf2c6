"""Partial decoupling of the mechanism: which motor moves which coordinate.

Let r_i = B_iC_i, leg_i and planar the factors of Eqs. (16) and (17), corrected, w_i the speed of
motor i, and k = sin(beta) level3. The differentiated closures are

    leg_1 w_1 = r_1x xC' + r_1z zC'
    leg_2 w_2 = r_2x xC' + r_2z zC'
    leg_3 w_3 = r_3x xC' + r_3z zC' + k l7 beta'

Only motors 1 and 2 move link 3'. Motor 3 turns link 7 and moves nothing else, so it moves P along
(-sin(beta), cos(beta), 0). Functions of joint angles raise like
:func:`tpm_gym.kinematics.jacobian.velocity`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, finite_points
from tpm_gym.errors import ConfigurationError, SingularityError
from tpm_gym.kinematics import equations, inverse, jacobian
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.kinematics.modes import DEFAULT_ASSEMBLY, ELBOWS_OUT, AssemblyMode, WorkingMode
from tpm_gym.kinematics.namespaces import NUMPY
from tpm_gym.kinematics.workspace import Region

PLATFORM = np.array([[True, True, True], [True, True, True], [True, True, False]])
"""Entries of J that are not always zero: rows x, y, z of P, columns motors 1, 2, 3."""

LINKS = np.array([[True, True, False], [True, True, False], [True, True, True]])
"""Entries that are not always zero: rows xC, zC of link 3' and beta of link 7; also the inverse."""


@dataclass(frozen=True, eq=False)
class Index:
    """Means of :func:`shares` (3, 3) and :func:`motors` (3,) over a region, from :func:`over`."""

    shares: FloatArray
    motors: FloatArray


def link_velocity(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> FloatArray:
    """Compute d(xC, zC, l7 beta) / d(theta), (..., 3, 3) m/rad, at theta (..., 3) rad."""
    (r1, r2, r3), f = _configuration(theta, branch, geometry)
    nothing = 0 * f.planar
    x = np.stack([r2[2] * f.leg1, -r1[2] * f.leg2, nothing], axis=-1) / f.planar[..., None]
    z = np.stack([-r2[0] * f.leg1, r1[0] * f.leg2, nothing], axis=-1) / f.planar[..., None]
    turn = -(r3[0][..., None] * x + r3[2][..., None] * z)
    turn[..., 2] = f.leg3
    return np.stack([x, z, turn / (f.sin_beta * f.level3)[..., None]], axis=-2)


def inverse_link_velocity(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> FloatArray:
    """Compute d(theta) / d(xC, zC, l7 beta), (..., 3, 3) rad/m, at theta (..., 3) rad.

    Raises SingularityError if a leg is stretched or folded.
    """
    (r1, r2, r3), f = _configuration(theta, branch, geometry)
    turns = 0 * f.planar, 0 * f.planar, f.sin_beta * f.level3
    columns = (r1[0], r2[0], r3[0]), (r1[2], r2[2], r3[2]), turns
    rows = np.stack([np.stack(column, axis=-1) for column in columns], axis=-1)
    return _over_legs(rows, np.stack([f.leg1, f.leg2, f.leg3], axis=-1), geometry)


def inverse_velocity(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> FloatArray:
    """Compute J^-1 = B^-1 A = d(theta) / d(x, y, z), (..., 3, 3) rad/m, at theta (..., 3) rad.

    Raises SingularityError at a serial singularity.
    """
    a = jacobian.parallel(theta, branch, geometry)
    b = np.diagonal(jacobian.serial(theta, branch, geometry), axis1=-2, axis2=-1)
    return _over_legs(a, b, geometry)


def shares(velocity: ArrayLike) -> FloatArray:
    """Compute the share of each motor in the motion of each coordinate, (..., 3, 3), in [0, 1].

    The share is J_ij^2 / sum_j J_ij^2 of the velocity Jacobian (..., 3, 3) of any mechanism whose
    motors have the same unit. If the speeds of the motors are independent and equally large, it is
    the part of the variance of coordinate i that motor j causes. Rows add up to 1. The row of a
    coordinate that cannot move is NaN.
    """
    squares = finite_points("velocity", velocity) ** 2
    with np.errstate(invalid="ignore"):
        parts: FloatArray = squares / squares.sum(axis=-1, keepdims=True)
    return parts


def motors(velocity: ArrayLike) -> FloatArray:
    """Compute how many motors move each coordinate, (..., 3): 1 / sum_j shares_ij^2.

    The number is 1 if one motor alone moves the coordinate, and 3 if all have equal shares.
    """
    count: FloatArray = 1 / (shares(velocity) ** 2).sum(axis=-1)
    return count


def over(
    region: Region,
    branch: WorkingMode = ELBOWS_OUT,
    assembly: AssemblyMode = DEFAULT_ASSEMBLY,
    geometry: Geometry = PAPER,
    shape: tuple[int, int, int] = (9, 9, 9),
) -> Index:
    """Average shares and numbers of motors over a grid of ``shape`` in a region, for x, y, z of P.

    Raises UnreachableError, SingularityError, or ConfigurationError where a point is in another
    assembly mode.
    """
    low, high = np.array(region.low), np.array(region.high)
    cells = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)
    points = low + (cells + 0.5) / shape * (high - low)
    found = jacobian.evaluate(inverse(points, branch, geometry), assembly, geometry)
    elsewhere = np.abs(found.position - points).max(axis=-1) > 1e-6 * geometry.l4
    if elsewhere.any():
        point = tuple(points[elsewhere][0].tolist())
        raise ConfigurationError("region", region, f"in assembly mode {assembly}; {point} is not")
    mean = shares(found.velocity).mean(axis=0)
    return Index(mean, motors(found.velocity).mean(axis=0))


def _configuration(
    theta: ArrayLike, branch: AssemblyMode, geometry: Geometry
) -> tuple[tuple[equations.Triple, equations.Triple, equations.Triple], equations.Factors]:
    """Return rods and factors at theta, if J exists there."""
    jacobian.velocity(theta, branch, geometry)  # raises with the reason if J does not exist
    a, b, c = np.moveaxis(finite_points("theta", theta), -1, 0)
    cos, sin = equations.arms((a, b, c), geometry, NUMPY)
    found = equations.assembly_at(cos, sin, branch.planar, branch.sin_beta, geometry, NUMPY)[0]
    bars = equations.rods(cos, sin, found, geometry)
    return bars, equations.factors(cos, sin, found, bars, geometry)


def _over_legs(rows: FloatArray, legs: FloatArray, geometry: Geometry) -> FloatArray:
    """Divide rows (..., 3, 3) by the diagonal of B (..., 3), if no leg is singular."""
    scaled = legs / (geometry.l3 * geometry.l4)
    if scaled.size and np.abs(scaled).min() < equations.SINGULAR:
        smallest = scaled.flat[np.abs(scaled).argmin()].item()
        raise SingularityError("a factor of det B", smallest)
    quotient: FloatArray = rows / legs[..., None]
    return quotient
