"""Closed-form forward and inverse kinematics, batched.

Everything here is in the paper's frame O-xyz: origin in the middle of the base, base plane z = 0,
z from the base towards the platform. Lengths are in metres, angles in radians.

The mechanism has two loops of coupling degree zero, so both problems reduce to intersecting
circles. We solve those intersections as vectors and as ``a cos + b sin = c``, not with the paper's
half-angle forms (Eqs. 13 and 15), which break where ``g_i = 0`` or ``theta_i = pi``.

Branches are named, ordered and returned as :mod:`tpm_gym.kinematics.modes` has it; its names are available
here too.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.arrays import Vector
from tpm_gym.errors import InputError
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.kinematics.modes import (
    ASSEMBLY_MODES,
    DEFAULT_ASSEMBLY,
    ELBOWS_OUT,
    WORKING_MODES,
    AssemblyMode,
    ForwardSolutions,
    InverseSolutions,
    PassiveAngles,
    WorkingMode,
)
from tpm_gym.kinematics.single import ROUNDING, assemble, posture
from tpm_gym.kinematics.unreachable import no_assembly, no_posture

__all__ = [
    "ASSEMBLY_MODES",
    "DEFAULT_ASSEMBLY",
    "ELBOWS_OUT",
    "WORKING_MODES",
    "AssemblyMode",
    "ForwardSolutions",
    "InverseSolutions",
    "PassiveAngles",
    "WorkingMode",
    "forward",
    "forward_all",
    "inverse",
    "inverse_all",
    "passive_angles",
]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_BLOCK = 4096  # rows solved at a time

# Row of the 12 distinct angles (sign of cos(beta), leg, bend) that each slot and leg holds.
_ROW_OF_SLOT = np.array(
    [
        [
            3 * (mode.cos_beta + 1) + 2 * leg + (bend + 1) // 2
            for leg, bend in enumerate((mode.leg1, mode.leg2, mode.leg3))
        ]
        for mode in WORKING_MODES
    ]
)


def forward_all(theta: ArrayLike, geometry: Geometry = PAPER) -> ForwardSolutions:
    """Solve the forward kinematics on all 4 branches (Eqs. 6 to 11, corrected).

    Args:
        theta: (..., 3) rad, actuated angles theta_1, theta_2, theta_3.
        geometry: Link lengths.

    Returns:
        All solutions; a branch keeps its slot as theta moves, and holds NaN where it is not real.
        Entries of theta that are not finite give invalid branches.

    Raises:
        InputError: If the last axis of theta does not have length 3.
    """
    theta = _points("theta", theta)
    flat = theta.reshape(-1, 3)
    position, beta = np.empty((len(flat), 4, 3)), np.empty((len(flat), 4))
    valid = np.empty((len(flat), 4), dtype=np.bool_)
    with np.errstate(all="ignore"):
        for rows in _blocks(len(flat)):
            _forward_block(flat[rows].T, geometry, position[rows], beta[rows], valid[rows])
    shape = theta.shape[:-1]
    return ForwardSolutions(
        position.reshape(*shape, 4, 3),
        beta.reshape(*shape, 4),
        valid.reshape(*shape, 4),
        geometry,
    )


def inverse_all(position: ArrayLike, geometry: Geometry = PAPER) -> InverseSolutions:
    """Solve the inverse kinematics on all 16 branches (Eqs. 12 to 15, corrected).

    Args:
        position: (..., 3) m, point P in the paper frame.
        geometry: Link lengths.

    Returns:
        All solutions, NaN where a branch is not real. Entries of position that are not finite give
        invalid branches.

    Raises:
        InputError: If the last axis of position does not have length 3.
    """
    position = _points("position", position)
    flat = position.reshape(-1, 3)
    theta, beta = np.empty((len(flat), 16, 3)), np.empty((len(flat), 16))
    valid = np.empty((len(flat), 16), dtype=np.bool_)
    with np.errstate(all="ignore"):
        for rows in _blocks(len(flat)):
            _inverse_block(flat[rows].T, geometry, theta[rows], beta[rows], valid[rows])
    shape = position.shape[:-1]
    return InverseSolutions(
        theta.reshape(*shape, 16, 3), beta.reshape(*shape, 16), valid.reshape(*shape, 16)
    )


def forward(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> FloatArray:
    """Platform position on one named branch of the forward kinematics.

    Args:
        theta: (..., 3) rad, actuated angles.
        branch: The assembly mode.
        geometry: Link lengths.

    Returns:
        (..., 3) m, point P in the paper frame. Both y and -y belong to the same angles: the default
        branch gives y > 0, ``AssemblyMode(-1, -1)`` its mirror image.

    Raises:
        InputError: If theta has the wrong shape or is not finite.
        UnreachableError: If the branch does not exist for some entry of theta.
    """
    theta = _finite_points("theta", theta)
    if theta.ndim == 1:
        return np.array(assemble(_vector(theta), branch, geometry)[:3])
    solutions = forward_all(theta, geometry)
    slot = branch.index
    valid = solutions.valid[..., slot]
    if not valid.all():
        raise no_assembly(theta[~valid][0], branch, geometry)
    return solutions.position[..., slot, :]


def inverse(
    position: ArrayLike, branch: WorkingMode = ELBOWS_OUT, geometry: Geometry = PAPER
) -> FloatArray:
    """Actuated angles on one named branch of the inverse kinematics.

    Args:
        position: (..., 3) m, point P in the paper frame.
        branch: The working mode.
        geometry: Link lengths.

    Returns:
        (..., 3) rad; theta_1 and theta_3 in (-pi, pi], theta_2 in [0, 2 pi).

    Raises:
        InputError: If position has the wrong shape or is not finite.
        UnreachableError: If the branch does not exist for some entry of position.
    """
    position = _finite_points("position", position)
    if position.ndim == 1:
        return np.array(posture(_vector(position), branch, geometry))
    solutions = inverse_all(position, geometry)
    slot = branch.index
    valid = solutions.valid[..., slot]
    if not valid.all():
        raise no_posture(position[~valid][0], branch, geometry)
    return solutions.theta[..., slot, :]


def passive_angles(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> PassiveAngles:
    """Directions of all passive links, in closed form, on one branch of the forward kinematics.

    Args:
        theta: (..., 3) rad, actuated angles.
        branch: The assembly mode.
        geometry: Link lengths.

    Raises:
        InputError: If theta has the wrong shape or is not finite.
        UnreachableError: If the branch does not exist for some entry of theta.
    """
    theta = _finite_points("theta", theta)
    solutions = forward_all(theta, geometry)
    slot = branch.index
    valid = solutions.valid[..., slot]
    if not valid.all():
        raise no_assembly(theta[~valid][0], branch, geometry)
    link3 = solutions.link3[..., slot, :]
    x_c, z_c = link3[..., 0], link3[..., 1]
    x, y = solutions.position[..., slot, 0], solutions.position[..., slot, 1]
    l4, l6 = geometry.l4, geometry.l6
    cos, sin = geometry.l3 * np.cos(theta), geometry.l3 * np.sin(theta)
    y1, x2, x3 = geometry.l1 + cos[..., 0], cos[..., 1] - geometry.l1, cos[..., 2] + geometry.l1
    return PassiveAngles(
        beta=solutions.beta[..., slot],
        rod4_swing=np.arctan2(z_c - sin[..., 0], -y1),
        rod4_tilt=np.arcsin(np.clip(x_c / l4, -1, 1)),
        rod6_swing=np.arctan2(z_c - sin[..., 1], x_c - 2 * geometry.l5 - x2),
        rod11_swing=np.arctan2(z_c + l6 - sin[..., 2], x + geometry.l2 - x3),
        rod11_tilt=np.arcsin(np.clip(y / l4, -1, 1)),
    )


def _blocks(count: int) -> Iterator[slice]:
    """Row ranges small enough for all intermediate results to stay in the cache."""
    for start in range(0, count, _BLOCK):
        yield slice(start, start + _BLOCK)


def _forward_block(
    theta: FloatArray,
    geometry: Geometry,
    position: FloatArray,
    beta: FloatArray,
    valid: BoolArray,
) -> None:
    """Solve (3, n) angles into position (n, 4, 3), beta (n, 4) and valid (n, 4)."""
    l1, l2, l3, l4, l5, l6, l7 = vars(geometry).values()
    cos, sin = l3 * np.cos(theta), l3 * np.sin(theta)
    # Eq. (6): C1 is on the circle about (0, z1) with radius^2 = l4^2 - y1^2 and on the circle about
    # (dx, z1 + dz) with radius l4. Of the two intersections, the one on the left of the line from
    # the first to the second centre has a positive planar factor.
    y1_squared, z1 = np.square(cos[0] + l1), sin[0]
    dx, dz = cos[1] + (2 * l5 - l1), sin[1] - z1
    inverse_distance2 = 1 / (dx * dx + dz * dz)
    along = 0.5 - 0.5 * y1_squared * inverse_distance2
    across2 = (l4 * l4 - y1_squared) * inverse_distance2 - along * along
    # Both terms can be large against their difference; scale the tolerance by them.
    real = across2 >= -ROUNDING * (1 + along * along)
    across = np.sqrt(np.maximum(across2, 0.0))
    # Rounding in C1 grows as the inverse of the planar factor, and in cos(beta) again as that of u;
    # the cap keeps what the clipped cosine leaves of a gap in rod 11 below l4 / 1e12.
    blur = np.minimum(1 + l4 * l4 * inverse_distance2 / across, 64) * (ROUNDING * l4 * l4)
    x_foot, z_foot = along * dx, z1 + along * dz
    for planar in (-1, 1):
        x_c, z_c = x_foot - planar * across * dz, z_foot + planar * across * dx
        # Eqs. (9) and (10), with z_C3 = z_C + l6
        u, w = x_c - (cos[2] + (l1 - 2 * l2)), z_c - (sin[2] - l6)
        cos_beta = (l4 * l4 - l7 * l7 - u * u - w * w) / (2 * l7 * u)
        assembled = real & (np.abs(cos_beta) <= 1 + blur / np.abs(2 * l7 * u))
        cos_beta = np.clip(cos_beta, -1.0, 1.0)
        if not assembled.all():
            cos_beta[~assembled] = z_c[~assembled] = np.nan
        angle, y = np.arccos(cos_beta), l7 * np.sqrt((1 - cos_beta) * (1 + cos_beta))
        slot = planar + 1  # sin(beta) < 0 comes first
        position[:, slot : slot + 2, 0] = (x_c + l7 * cos_beta + l2)[:, None]
        position[:, slot, 1], position[:, slot + 1, 1] = -y, y
        position[:, slot : slot + 2, 2] = (z_c + 2 * l6)[:, None]
        beta[:, slot], beta[:, slot + 1] = -angle, angle
        valid[:, slot : slot + 2] = assembled[:, None]


def _inverse_block(
    position: FloatArray,
    geometry: Geometry,
    theta: FloatArray,
    beta: FloatArray,
    valid: BoolArray,
) -> None:
    """Solve (3, n) points into theta (n, 16, 3), beta (n, 16) and valid (n, 16)."""
    l1, l2, _, _, l5, l6, l7 = vars(geometry).values()
    x, y, z = np.ascontiguousarray(position)
    sin_beta = y / l7
    cos_beta = np.sqrt(_clip_rounding((1 - sin_beta) * (1 + sin_beta)))
    z_c = z - 2 * l6
    # (C_i - A_i) as: level in the arm's plane, vertical in it, out of it (squared)
    angle1 = np.arctan2(z_c, -l1)
    leg3 = _solve_leg(x + (l2 - l1), z - l6, y * y, None, geometry)
    small_beta = np.arcsin(np.clip(sin_beta, -1.0, 1.0))
    distinct = np.empty((12, len(x)))  # a row for each sign of cos(beta), leg and bend
    for index, sign in enumerate((-1, 1)):
        x_c = x - l2 - sign * l7 * cos_beta
        leg1 = _solve_leg(np.full_like(x, -l1), z_c, x_c * x_c, angle1, geometry)
        leg2 = _solve_leg(x_c + (l1 - 2 * l5), z_c, 0.0, None, geometry)
        rows = distinct[6 * index : 6 * index + 6]
        for bend in (0, 1):
            rows[bend], rows[2 + bend], rows[4 + bend] = leg1[bend], leg2[bend], leg3[bend]
        # One leg without a solution voids the branch; both bends of a leg fail together.
        real = np.isfinite(rows[0] + rows[2] + rows[4])
        angle = small_beta if sign > 0 else np.copysign(np.pi, y) - small_beta
        if not real.all():
            rows[:, ~real] = np.nan
            angle = np.where(real, angle, np.nan)
        beta[:, 8 * index : 8 * index + 8] = angle[:, None]
        valid[:, 8 * index : 8 * index + 8] = real[:, None]
    rows = distinct.reshape(2, 3, 2, -1)
    # Arms 1 and 3 are cut where they point inwards, at theta = pi; arm 2 does so at theta = 0.
    rows[:, ::2] -= 2 * np.pi * (rows[:, ::2] > np.pi)
    rows[:, ::2] += 2 * np.pi * (rows[:, ::2] <= -np.pi)
    rows[:, 1] += 2 * np.pi * (rows[:, 1] < 0)
    np.take(np.ascontiguousarray(distinct.T), _ROW_OF_SLOT, axis=1, out=theta, mode="clip")


def _solve_leg(
    a: FloatArray,
    b: FloatArray,
    out2: FloatArray | float,
    angle: FloatArray | None,
    geometry: Geometry,
) -> tuple[FloatArray, FloatArray]:
    """Solve |C - A - l3 e(theta)| = l4, i.e. a cos + b sin = c; NaN where not real.

    The serial factor BC . dB/dtheta is l3 (b cos - a sin), so its sign tells the two angles apart:
    the first has it negative, the second positive. ``angle`` is atan2(b, a), if it is known.
    """
    radius2 = a * a + b * b
    c = (radius2 + out2 + (geometry.l3**2 - geometry.l4**2)) / (2 * geometry.l3)
    ratio = c / np.sqrt(radius2)
    ratio[np.abs(ratio) > 1 + ROUNDING] = np.nan
    apart = np.arccos(np.clip(ratio, -1.0, 1.0))
    angle = np.arctan2(b, a) if angle is None else angle
    return angle + apart, angle - apart


def _clip_rounding(value: FloatArray) -> FloatArray:
    """Zero where ``value`` is negative by rounding alone, NaN where it is truly negative."""
    clipped = np.maximum(value, 0.0)
    clipped[value < -ROUNDING] = np.nan
    return clipped


def _vector(array: FloatArray) -> Vector:
    a, b, c = array.tolist()
    return a, b, c


def _points(name: str, value: ArrayLike) -> FloatArray:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(name, value, "an array of numbers of shape (..., 3)") from error
    if array.ndim == 0 or array.shape[-1] != 3:
        raise InputError(name, array.shape, "an array of shape (..., 3), by shape")
    return array


def _finite_points(name: str, value: ArrayLike) -> FloatArray:
    array = _points(name, value)
    # For a single point, plain floats are several times faster than numpy's calls.
    finite = (
        all(map(math.isfinite, array.tolist())) if array.ndim == 1 else np.isfinite(array).all()
    )
    if not finite:
        bad = array[~np.isfinite(array).all(axis=-1)]
        raise InputError(name, bad.reshape(-1, 3)[0].tolist(), "finite")
    return array
