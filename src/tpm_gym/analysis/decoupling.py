"""Which motor moves what: the partial decoupling of the mechanism, in formulas and numbers.

With r_i = B_iC_i, leg_i and planar the factors of Eqs. (16) and (17), corrected, w_i the rate of
motor i and k = sin(beta) level3, the closures differentiated read

    leg_1 w_1 = r_1x xC' + r_1z zC'
    leg_2 w_2 = r_2x xC' + r_2z zC'
    leg_3 w_3 = r_3x xC' + r_3z zC' + k l7 beta'

Motors 1 and 2 alone move link 3', and link 3' alone moves them; motor 3 turns link 7 and moves
nothing else, so P runs along (-sin(beta), cos(beta), 0). In xC, zC and beta the velocity
Jacobian and its inverse have zeros in the same two places, :data:`LINKS`. In x, y and z one of
them is left, that of z (:data:`PLATFORM`), and the inverse has none.

:func:`shares` and :func:`motors` take the velocity Jacobian of any mechanism whose motors share a
unit. Functions of joint angles raise as :func:`tpm_gym.kinematics.jacobian.velocity` does.
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
"""Where J is not zero by structure: rows x, y, z of P, columns motors 1, 2, 3."""

LINKS = np.array([[True, True, False], [True, True, False], [True, True, True]])
"""The same for xC, zC of link 3' and beta of link 7, and for the inverse."""


@dataclass(frozen=True, eq=False)
class Index:
    """What :func:`over` returns.

    Attributes:
        shares: (3, 3), the mean of :func:`shares`.
        motors: (3,), the mean of :func:`motors`.
    """

    shares: FloatArray
    motors: FloatArray


def link_velocity(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> FloatArray:
    """Rates of xC, zC and l7 beta by the motors, (..., 3, 3) m/rad, at theta (..., 3) rad."""
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
    """Rates of the motors by xC, zC and l7 beta, (..., 3, 3) rad/m, at theta (..., 3) rad.

    Raises:
        SingularityError: If a leg is stretched or folded, too.
    """
    (r1, r2, r3), f = _configuration(theta, branch, geometry)
    turns = 0 * f.planar, 0 * f.planar, f.sin_beta * f.level3
    rows = [
        np.stack([rod[0], rod[2], turn], axis=-1)
        for rod, turn in zip((r1, r2, r3), turns, strict=True)
    ]
    return _over_legs(np.stack(rows, axis=-2), np.stack([f.leg1, f.leg2, f.leg3], -1), geometry)


def inverse_velocity(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> FloatArray:
    """J^-1 = B^-1 A: rates of the motors by x, y, z of P, (..., 3, 3) rad/m.

    Raises:
        SingularityError: If theta is a serial singularity, where it does not exist.
    """
    a = jacobian.parallel(theta, branch, geometry)
    b = np.diagonal(jacobian.serial(theta, branch, geometry), axis1=-2, axis2=-1)
    return _over_legs(a, b, geometry)


def shares(velocity: ArrayLike) -> FloatArray:
    """The part that each motor has in each coordinate's motion, (..., 3, 3), in [0, 1].

    J_ij^2 / sum_j J_ij^2 of a velocity Jacobian (..., 3, 3): where the rates of the motors are
    independent and equally large, the part of coordinate i's variance that motor j makes. Rows add
    up to 1; where a coordinate cannot move, they are NaN.
    """
    squares = finite_points("velocity", velocity) ** 2
    with np.errstate(invalid="ignore"):
        parts: FloatArray = squares / squares.sum(axis=-1, keepdims=True)
    return parts


def motors(velocity: ArrayLike) -> FloatArray:
    """How many motors move each coordinate, (..., 3), in [1, 3]: 1 / sum_j shares_ij^2.

    1 where one motor alone does, as in a Cartesian robot; 3 where all do alike.
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
    """The means over the cells of a grid of ``shape`` in a region, of x, y and z of P.

    Raises:
        UnreachableError: If a point is not reachable on ``branch``.
        SingularityError: If a point is singular.
        ConfigurationError: If a point is in another assembly mode.
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
    """Rods and factors at theta, where J exists."""
    jacobian.velocity(theta, branch, geometry)  # raises where it does not, and says why
    a, b, c = np.moveaxis(finite_points("theta", theta), -1, 0)
    cos, sin = equations.arms((a, b, c), geometry, NUMPY)
    found = equations.assembly_at(cos, sin, *branch.signs, geometry, NUMPY)[0]
    bars = equations.rods(cos, sin, found, geometry)
    return bars, equations.factors(cos, sin, found, bars, geometry)


def _over_legs(rows: FloatArray, legs: FloatArray, geometry: Geometry) -> FloatArray:
    """Rows (..., 3, 3) over the diagonal of B (..., 3), or what is singular."""
    scaled = legs / (geometry.l3 * geometry.l4)
    if scaled.size and np.abs(scaled).min() < equations.SINGULAR:
        smallest = scaled.flat[np.abs(scaled).argmin()].item()
        raise SingularityError("a factor of det B", smallest)
    quotient: FloatArray = rows / legs[..., None]
    return quotient
