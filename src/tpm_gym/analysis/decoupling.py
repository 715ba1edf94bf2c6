"""Partial decoupling of the mechanism: which motor moves which coordinate.

Let r_i be the vector B_iC_i, w_i the speed of motor i, leg_i the factor of leg i in Eq. (17), and
k = sin(beta) level3, the product of two factors in Eq. (16). Both equations are used as corrected
in docs/paper.md. The derivatives of the closures by time are

    leg_1 w_1 = r_1x xC_dot + r_1z zC_dot
    leg_2 w_2 = r_2x xC_dot + r_2z zC_dot
    leg_3 w_3 = r_3x xC_dot + r_3z zC_dot + k l7 beta_dot

Only motors 1 and 2 move link 3'. If motor 3 turns alone, link 3' stays at rest and link 7 turns, so
P moves along (-sin(beta), cos(beta), 0).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.analysis.aspects import require_shape
from tpm_gym.arrays import FloatArray, finite_points
from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics import inverse, jacobian
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.kinematics.jacobian import link_velocity as link_velocity
from tpm_gym.kinematics.modes import DEFAULT_ASSEMBLY, ELBOWS_OUT, AssemblyMode, WorkingMode
from tpm_gym.kinematics.workspace import Region

PLATFORM = np.array([[True, True, True], [True, True, True], [True, True, False]])
"""Entries of J that are not always zero: rows x, y, z of P, columns motors 1, 2, 3."""

LINKS = np.array([[True, True, False], [True, True, False], [True, True, True]])
"""Entries of d(xC, zC, beta) / d(theta) that are not always zero; columns motors 1, 2, 3.

The inverse matrix has its zeros at the same places. xC and zC belong to link 3', beta to link 7.
"""


@dataclass(frozen=True, eq=False)
class Index:
    """Averages of :func:`shares` (3, 3) and :func:`motors` (3,) in a region, from :func:`over`."""

    shares: FloatArray
    motors: FloatArray


def shares(velocity: ArrayLike) -> FloatArray:
    """Compute the share of each motor in the motion of each coordinate, (..., 3, 3), in [0, 1].

    The share is J_ij^2 / sum_j J_ij^2, where J is the argument ``velocity``, the velocity Jacobian
    (..., 3, 3) of any mechanism whose joint positions all have the same unit. If the speeds of the
    motors are independent and have equal variances, motor j causes this share of the variance of
    the speed of coordinate i. Rows add up to 1. The row of a coordinate that cannot move is NaN.
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
    """Compute the averages of :func:`shares` and :func:`motors` in a region, for x, y, z of P.

    The averages are over a grid with ``shape`` points along x, y, z.

    Raises:
        UnreachableError: If a point is out of reach.
        SingularityError: If a point is singular.
        ConfigurationError: If a point is in another assembly mode, or the shape is not possible.
    """
    require_shape(shape, 1)
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
