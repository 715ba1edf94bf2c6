"""Jacobians, their singular factors, and conditioning, batched, in the paper frame.

With f_i = |B_iC_i|^2 - l4^2 = 0 and the platform velocity v, differentiation gives
A v = B theta_dot (section "Singularity analysis"). Configurations are given by the actuated angles
and the assembly mode, so every function here takes ``theta`` (..., 3) in rad.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.errors import SingularityError
from tpm_gym.kinematics import single
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.kinematics.position import DEFAULT_ASSEMBLY, AssemblyMode, forward, forward_all
from tpm_gym.kinematics.single import SINGULAR

__all__ = [
    "Evaluation",
    "Factors",
    "conditioning",
    "evaluate",
    "factors",
    "parallel",
    "serial",
    "velocity",
]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class _Configuration:
    """What all Jacobians are made of."""

    position: FloatArray  # (..., 3) m
    rods: FloatArray  # (..., 3, 3) m, row i is B_iC_i
    serial: FloatArray  # (..., 3) m^2/rad, B_iC_i . dB_i/dtheta_i
    sin_beta: FloatArray  # (...,)
    cos_beta: FloatArray  # (...,)
    planar: FloatArray  # (...,) m^2, third factor of Eq. (16)
    level3: FloatArray  # (...,) m, second factor of Eq. (16)


@dataclass(frozen=True)
class Factors:
    """Factors of both Jacobian determinants; a configuration is singular where one is zero.

    Attributes:
        parallel: (..., 3): sin(beta); l1 + l3 c3 - xC - 2 l2 (m); the planar factor (m^2), as in
            Eq. (16), corrected.
        serial: (..., 4): cos(beta); B_iC_i . dB_i/dtheta_i (m^2/rad) for i = 1, 2, 3, as in
            Eq. (17), corrected.
    """

    parallel: FloatArray
    serial: FloatArray


@dataclass(frozen=True)
class Evaluation:
    """What :func:`evaluate` returns.

    Attributes:
        position: (..., 3) m, point P.
        velocity: (..., 3, 3) m/rad, J.
        conditioning: (...,) 1/cond(J).
    """

    position: FloatArray
    velocity: FloatArray
    conditioning: FloatArray


def parallel(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> FloatArray:
    """Parallel Jacobian A of A v = B theta_dot.

    Eliminating the passive angle beta through y = l7 sin(beta) gives dxC = dx + tan(beta) dy. Rows
    1 and 2 are multiplied by cos(beta), which keeps A finite at y = +-l7; so
    det A = -cos(beta) times the product of the factors of Eq. (16).

    Args:
        theta: (..., 3) rad.
        branch: The assembly mode.
        geometry: Link lengths.

    Returns:
        (..., 3, 3) m.

    Raises:
        UnreachableError: If the branch does not exist at some theta.
    """
    c = _configuration(theta, branch, geometry)
    a = np.empty_like(c.rods)
    for leg in (0, 1):
        # C1 and C2 move with (dx + tan(beta) dy, 0, dz)
        a[..., leg, 0] = c.cos_beta * c.rods[..., leg, 0]
        a[..., leg, 1] = c.sin_beta * c.rods[..., leg, 0]
        a[..., leg, 2] = c.cos_beta * c.rods[..., leg, 2]
    a[..., 2, :] = c.rods[..., 2, :]
    return a


def serial(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> FloatArray:
    """Serial Jacobian B of A v = B theta_dot, with the row scaling of :func:`parallel`.

    So det B = cos(beta) times the product of the factors of Eq. (17).

    Args:
        theta: (..., 3) rad.
        branch: The assembly mode.
        geometry: Link lengths.

    Returns:
        (..., 3, 3) m^2/rad, diagonal.

    Raises:
        UnreachableError: If the branch does not exist at some theta.
    """
    c = _configuration(theta, branch, geometry)
    b = np.zeros_like(c.rods)
    b[..., 0, 0] = c.cos_beta * c.serial[..., 0]
    b[..., 1, 1] = c.cos_beta * c.serial[..., 1]
    b[..., 2, 2] = c.serial[..., 2]
    return b


def velocity(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> FloatArray:
    """Velocity Jacobian J with v = J theta_dot; J = A^-1 B wherever A can be inverted.

    J exists at the serial singularities too (where cos(beta) = 0 makes both A and B singular).

    Args:
        theta: (..., 3) rad.
        branch: The assembly mode.
        geometry: Link lengths.

    Returns:
        (..., 3, 3) m/rad.

    Raises:
        UnreachableError: If the branch does not exist at some theta.
        SingularityError: If theta is a parallel singularity, where J does not exist.
    """
    return _velocity(_configuration(theta, branch, geometry), geometry)


def conditioning(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> FloatArray:
    """Inverse condition number 1/cond(J) in [0, 1]: 0 at a singularity, 1 where J is isotropic.

    It exists at singularities too, where it is 0 up to rounding. The three inputs share one unit
    and so do the three outputs, so the number is meaningful without any scaling.

    Args:
        theta: (..., 3) rad.
        branch: The assembly mode.
        geometry: Link lengths.

    Returns:
        (...,) in [0, 1].

    Raises:
        UnreachableError: If the branch does not exist at some theta.
    """
    return _conditioning(_configuration(theta, branch, geometry), geometry)


def evaluate(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> Evaluation:
    """Position, J and conditioning at once, for the price of one solution.

    Args:
        theta: (..., 3) rad.
        branch: The assembly mode.
        geometry: Link lengths.

    Raises:
        UnreachableError: If the branch does not exist at some theta.
        SingularityError: If theta is a parallel singularity.
    """
    angles = np.asarray(theta, dtype=np.float64)
    if angles.shape == (3,):
        assembly, rows, quality = single.evaluate(tuple(angles.tolist()), branch, geometry)
        return Evaluation(np.array(assembly[:3]), np.array(rows), np.array(quality))
    c = _configuration(theta, branch, geometry)
    return Evaluation(c.position, _velocity(c, geometry), _conditioning(c, geometry))


def factors(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> Factors:
    """Closed-form factors of det A and det B (Eqs. 16 and 17, corrected).

    Args:
        theta: (..., 3) rad.
        branch: The assembly mode.
        geometry: Link lengths.

    Raises:
        UnreachableError: If the branch does not exist at some theta.
    """
    c = _configuration(theta, branch, geometry)
    return Factors(
        parallel=np.stack([c.sin_beta, c.level3, c.planar], axis=-1),
        serial=np.concatenate([c.cos_beta[..., None], c.serial], axis=-1),
    )


def _configuration(theta: ArrayLike, branch: AssemblyMode, geometry: Geometry) -> _Configuration:
    """Solve the forward kinematics and collect the rods."""
    angles = np.asarray(theta, dtype=np.float64)
    solutions = forward_all(angles, geometry)
    slot = branch.index
    if not solutions.valid[..., slot].all():
        forward(angles, branch, geometry)  # raises, and says why
    l1, l2, l3 = geometry.l1, geometry.l2, geometry.l3
    cos_beta = np.cos(solutions.beta[..., slot])
    x, y = solutions.position[..., slot, 0], solutions.position[..., slot, 1]
    x_c = x - l2 - geometry.l7 * cos_beta
    z_c = solutions.position[..., slot, 2] - 2 * geometry.l6
    cos, sin = np.cos(angles), np.sin(angles)
    rod1 = [x_c, -l1 - l3 * cos[..., 0], z_c - l3 * sin[..., 0]]
    rod2 = [x_c - 2 * geometry.l5 + l1 - l3 * cos[..., 1], 0 * x_c, z_c - l3 * sin[..., 1]]
    rod3 = [x + l2 - l1 - l3 * cos[..., 2], y, z_c + geometry.l6 - l3 * sin[..., 2]]
    rods = np.stack([np.stack(rod, axis=-1) for rod in (rod1, rod2, rod3)], axis=-2)
    # Arm 1 turns in the yz plane, arms 2 and 3 in the xz plane.
    in_plane = np.stack([rod1[1], rod2[0], rod3[0]], axis=-1)
    return _Configuration(
        position=solutions.position[..., slot, :],
        rods=rods,
        serial=l3 * (rods[..., 2] * cos - in_plane * sin),
        sin_beta=y / geometry.l7,
        cos_beta=cos_beta,
        planar=rod1[0] * rod2[2] - rod1[2] * rod2[0],
        level3=geometry.l7 * cos_beta - rod3[0],  # = xB3 - xC - 2 l2
    )


def _velocity(c: _Configuration, geometry: Geometry) -> FloatArray:
    scaled, determinant = _scaled_velocity(c, geometry)
    name, value = _smallest_parallel_factor(c, geometry)
    if abs(value) < SINGULAR:
        raise SingularityError(name, value)
    result: FloatArray = scaled / determinant[..., None, None]
    return result


def _conditioning(c: _Configuration, geometry: Geometry) -> FloatArray:
    # det K cancels in the ratio of the singular values, so this exists at det K = 0 as well.
    scaled, _ = _scaled_velocity(c, geometry)
    singular_values = np.linalg.svd(scaled, compute_uv=False)
    largest = singular_values[..., 0]
    result: FloatArray = singular_values[..., 2] / np.where(largest > 0, largest, 1.0)
    return result


def _scaled_velocity(c: _Configuration, geometry: Geometry) -> tuple[FloatArray, FloatArray]:
    """(det K) J and det K, where K is the parallel Jacobian in the variables (xC, zC, beta).

    K = [[r1x, r1z, 0], [r2x, r2z, 0], [r3x, r3z, k]] with k = l7 sin(beta) level3, so that
    det K = k planar; neither it nor (det K) J contains a division.
    """
    k = geometry.l7 * c.sin_beta * c.level3
    r1, r2, r3 = c.rods[..., 0, :], c.rods[..., 1, :], c.rods[..., 2, :]
    b1, b2, b3 = c.serial[..., 0], c.serial[..., 1], c.serial[..., 2]
    zero = np.zeros_like(k)
    # planar times the rates of xC and zC per unit of theta_dot, and det K times that of beta
    x_rate = np.stack([r2[..., 2] * b1, -r1[..., 2] * b2, zero], axis=-1)
    z_rate = np.stack([-r2[..., 0] * b1, r1[..., 0] * b2, zero], axis=-1)
    beta_rate = -r3[..., 0, None] * x_rate - r3[..., 2, None] * z_rate
    beta_rate[..., 2] += c.planar * b3
    beta_rate *= geometry.l7
    scaled = np.stack(
        [
            k[..., None] * x_rate - c.sin_beta[..., None] * beta_rate,
            c.cos_beta[..., None] * beta_rate,
            k[..., None] * z_rate,
        ],
        axis=-2,
    )
    return scaled, k * c.planar


def _smallest_parallel_factor(c: _Configuration, geometry: Geometry) -> tuple[str, float]:
    """Name and value (in units of l4) of the parallel factor nearest to zero over the batch."""
    values = {
        "sin(beta)": c.sin_beta,
        "(l1 + l3 cos(theta_3) - xC - 2 l2) / l4": c.level3 / geometry.l4,
        "planar factor / l4^2": c.planar / geometry.l4**2,
    }
    smallest = {
        name: float(value.flat[np.abs(value).argmin()]) if value.size else np.inf
        for name, value in values.items()
    }
    name = min(smallest, key=lambda key: abs(smallest[key]))
    return name, smallest[name]
