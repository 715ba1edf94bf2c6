"""Closed-form forward and inverse kinematics, batched.

Everything here is in the paper's frame O-xyz: origin in the middle of the base, base plane z = 0,
z from the base towards the platform. Lengths are in metres, angles in radians.

The mechanism has two loops of coupling degree zero, so both problems reduce to intersecting
circles. We solve those intersections as vectors and as ``a cos + b sin = c``, not with the paper's
half-angle forms (Eqs. 13 and 15), which break where ``g_i = 0`` or ``theta_i = pi``.

Branches are named, ordered and returned as :mod:`tpm_gym.branches` has it; its names are available
here too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.branches import (
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
from tpm_gym.errors import InputError, UnreachableError
from tpm_gym.geometry import PAPER, Geometry

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

# Where two solutions merge, rounding alone can push a discriminant (here always scaled to order
# one) below zero by a few units in the last place. Those are solutions, not misses.
_ROUNDING = 64 * np.finfo(np.float64).eps


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
    with np.errstate(invalid="ignore", divide="ignore"):
        y1, z1, x2, z2, x3, z3 = _elbows(theta, geometry)
        x_c, z_c, real12 = _intersect_circles(y1, z1, x2 + 2 * geometry.l5, z2, geometry.l4)
        # Leg 3, Eqs. (9) and (10) with z_C3 = z_C + l6.
        u = x_c - x3[..., None] + 2 * geometry.l2
        dz = z_c + geometry.l6 - z3[..., None]
        cos_beta = (geometry.l4**2 - geometry.l7**2 - u**2 - dz**2) / (2 * u * geometry.l7)
        valid = real12 & (np.abs(cos_beta) <= 1 + _ROUNDING)
        sin_half = np.sqrt(np.maximum(0.0, 1 - cos_beta**2))
        sign = np.array([mode.sin_beta for mode in ASSEMBLY_MODES], dtype=float)
        beta = np.arctan2(sign * sin_half, cos_beta)
        position = np.stack(
            [
                x_c + geometry.l7 * np.clip(cos_beta, -1, 1) + geometry.l2,
                geometry.l7 * sign * sin_half,
                z_c + 2 * geometry.l6,
            ],
            axis=-1,
        )
    beta[~valid] = np.nan
    position[~valid] = np.nan
    link3 = np.stack([x_c, z_c], axis=-1)
    link3[~valid] = np.nan
    return ForwardSolutions(position, beta, link3, valid)


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
    x, y, z = position[..., 0], position[..., 1], position[..., 2]
    with np.errstate(invalid="ignore"):
        cos_abs = np.sqrt(_clip_rounding(1 - (y / geometry.l7) ** 2))
        per_leg = []
        for cos_sign in (-1, 1):
            x_c = x - geometry.l2 - geometry.l7 * cos_sign * cos_abs
            z_c = z - 2 * geometry.l6
            per_leg.append(_solve_legs(x_c, z_c, x, y, z, geometry))
    shape = position.shape[:-1]
    theta = np.empty((*shape, 16, 3))
    beta = np.empty((*shape, 16))
    for slot, mode in enumerate(WORKING_MODES):
        legs = per_leg[(mode.cos_beta + 1) // 2]
        for leg, bend in enumerate((mode.leg1, mode.leg2, mode.leg3)):
            theta[..., slot, leg] = legs[leg][(bend + 1) // 2]
        beta[..., slot] = np.arctan2(y / geometry.l7, mode.cos_beta * cos_abs)
    valid = np.isfinite(theta).all(axis=-1) & np.isfinite(beta)
    theta[~valid] = np.nan
    beta[~valid] = np.nan
    return InverseSolutions(theta, beta, valid)


def forward(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> FloatArray:
    """Platform position on one named branch of the forward kinematics.

    Args:
        theta: (..., 3) rad, actuated angles.
        branch: The assembly mode.
        geometry: Link lengths.

    Returns:
        (..., 3) m, point P in the paper frame.

    Raises:
        InputError: If theta has the wrong shape or is not finite.
        UnreachableError: If the branch does not exist for some entry of theta.
    """
    theta = _finite_points("theta", theta)
    solutions = forward_all(theta, geometry)
    slot = branch.index
    valid = solutions.valid[..., slot]
    if not valid.all():
        raise _no_assembly(theta[~valid][0], branch, geometry)
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
    solutions = inverse_all(position, geometry)
    slot = branch.index
    valid = solutions.valid[..., slot]
    if not valid.all():
        raise _no_posture(position[~valid][0], branch, geometry)
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
        raise _no_assembly(theta[~valid][0], branch, geometry)
    y1, z1, x2, z2, x3, z3 = _elbows(theta, geometry)
    x_c, z_c = solutions.link3[..., slot, 0], solutions.link3[..., slot, 1]
    x, y = solutions.position[..., slot, 0], solutions.position[..., slot, 1]
    l4, l6 = geometry.l4, geometry.l6
    return PassiveAngles(
        beta=solutions.beta[..., slot],
        rod4_swing=np.arctan2(z_c - z1, -y1),
        rod4_tilt=np.arcsin(np.clip(x_c / l4, -1, 1)),
        rod6_swing=np.arctan2(z_c - z2, x_c - 2 * geometry.l5 - x2),
        rod11_swing=np.arctan2(z_c + l6 - z3, x + geometry.l2 - x3),
        rod11_tilt=np.arcsin(np.clip(y / l4, -1, 1)),
    )


def _elbows(theta: FloatArray, geometry: Geometry) -> tuple[FloatArray, ...]:
    """Coordinates yB1, zB1, xB2, zB2, xB3, zB3 of the arms' ends."""
    reach, height = geometry.l3 * np.cos(theta), geometry.l3 * np.sin(theta)
    return (
        geometry.l1 + reach[..., 0],
        height[..., 0],
        -geometry.l1 + reach[..., 1],
        height[..., 1],
        geometry.l1 + reach[..., 2],
        height[..., 2],
    )


def _intersect_circles(
    y1: FloatArray, z1: FloatArray, x2: FloatArray, z2: FloatArray, l4: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Point C1 in the plane y = 0, Eq. (6), one column per assembly mode.

    C1 lies on the circle about (0, z1) with radius^2 = l4^2 - y1^2 and on the circle about
    (x2, z2) with radius l4. Of the two intersections, the one on the left of the line from the
    first to the second centre has a positive planar factor.
    """
    dx, dz = x2, z2 - z1
    distance2 = dx**2 + dz**2
    along = ((l4**2 - y1**2 - l4**2) / distance2 + 1) / 2
    across2 = (l4**2 - y1**2) / distance2 - along**2
    # Both terms can be large against their difference; scale the tolerance by them.
    real = across2 >= -_ROUNDING * (1 + along**2)
    across = np.sqrt(np.maximum(0.0, across2))[..., None] * [m.planar for m in ASSEMBLY_MODES]
    x_c = along[..., None] * dx[..., None] - across * dz[..., None]
    z_c = z1[..., None] + along[..., None] * dz[..., None] + across * dx[..., None]
    return x_c, z_c, np.broadcast_to(real[..., None], x_c.shape)


def _solve_legs(
    x_c: FloatArray,
    z_c: FloatArray,
    x: FloatArray,
    y: FloatArray,
    z: FloatArray,
    geometry: Geometry,
) -> list[tuple[FloatArray, FloatArray]]:
    """Both angles of each leg, ordered by the sign of its serial factor (-1, +1)."""
    l1, l5, l6 = geometry.l1, geometry.l5, geometry.l6
    zero = np.zeros_like(x_c)
    # (C_i - A_i) as (in the arm's plane and level, in the arm's plane and vertical, out of plane)
    leg1 = _solve_leg(zero - l1, z_c, x_c, geometry)
    leg2 = _solve_leg(x_c - 2 * l5 + l1, z_c, zero, geometry)
    leg3 = _solve_leg(x + geometry.l2 - l1, z - l6, y, geometry)
    # Arm 2 points outwards at theta_2 = pi: keep the cut of the arctangent away from there.
    return [leg1, (np.mod(leg2[0], 2 * np.pi), np.mod(leg2[1], 2 * np.pi)), leg3]


def _solve_leg(
    a: FloatArray, b: FloatArray, out: FloatArray, geometry: Geometry
) -> tuple[FloatArray, FloatArray]:
    """Solve |C - A - l3 e(theta)| = l4, i.e. a cos + b sin = c; NaN where not real.

    The serial factor BC . dB/dtheta is l3 (b cos - a sin), so its sign tells the two angles apart.
    """
    radius2 = a**2 + b**2
    c = (radius2 + out**2 + geometry.l3**2 - geometry.l4**2) / (2 * geometry.l3)
    s = np.sqrt(_clip_rounding((radius2 - c**2) / geometry.l4**2)) * geometry.l4
    # theta = atan2(b, a) -+ atan2(s, c), in one arctangent each
    return (
        np.arctan2(b * c + a * s, a * c - b * s),
        np.arctan2(b * c - a * s, a * c + b * s),
    )


def _clip_rounding(value: FloatArray) -> FloatArray:
    """Zero where ``value`` is negative by rounding alone, NaN where it is truly negative."""
    return np.where(value >= -_ROUNDING, np.maximum(value, 0.0), np.nan)


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
    if not np.isfinite(array).all():
        bad = array[~np.isfinite(array).all(axis=-1)]
        raise InputError(name, bad.reshape(-1, 3)[0].tolist(), "finite")
    return array


def _no_assembly(theta: FloatArray, branch: AssemblyMode, geometry: Geometry) -> UnreachableError:
    """Say which loop cannot be assembled at ``theta``."""
    y1, z1, x2, z2, x3, z3 = _elbows(theta, geometry)
    x2 = x2 + 2 * geometry.l5
    x_c, z_c, real = _intersect_circles(y1, z1, x2, z2, geometry.l4)
    hint = f"choose joint angles within reach (branch {branch})"
    if not real.any():
        radius2 = geometry.l4**2 - y1**2
        distance2 = x2**2 + (z2 - z1) ** 2
        along = (radius2 - geometry.l4**2) / distance2 / 2 + 0.5
        margin = float(radius2 - along**2 * distance2)
        return UnreachableError(
            theta.tolist(), "loop 1 (circles of B1C1, B2C2)", margin, hint, "m^2"
        )
    u = x_c[branch.index] - x3 + 2 * geometry.l2
    dz = z_c[branch.index] + geometry.l6 - z3
    needed = geometry.l4**2 - geometry.l7**2 - u**2 - dz**2
    margin = float(abs(2 * u * geometry.l7) - abs(needed))
    return UnreachableError(theta.tolist(), "loop 2 (beta, rod B3C3)", margin, hint, "m^2")


def _no_posture(position: FloatArray, branch: WorkingMode, geometry: Geometry) -> UnreachableError:
    """Say which part of the mechanism cannot reach ``position``, and by how much."""
    x, y, z = position
    hint = f"choose a point of the workspace (branch {branch}; see tpm_gym.workspace)"
    if abs(y) > geometry.l7:
        return UnreachableError(position.tolist(), "beta (|y| <= l7)", geometry.l7 - abs(y), hint)
    x_c = x - geometry.l2 - branch.cos_beta * np.sqrt(geometry.l7**2 - y**2)
    z_c = z - 2 * geometry.l6
    worst = ("leg 1", np.inf)
    legs = (
        ("leg 1", (-geometry.l1, z_c, x_c)),
        ("leg 2", (x_c - 2 * geometry.l5 + geometry.l1, z_c, 0.0)),
        ("leg 3", (x + geometry.l2 - geometry.l1, z - geometry.l6, y)),
    )
    for name, (a, b, out) in legs:
        in_plane = np.hypot(a, b)
        # The rod's projection on the arm's plane has this length; arm and it form a triangle.
        rod = np.sqrt(max(0.0, geometry.l4**2 - out**2))
        margin = min(geometry.l3 + rod - in_plane, in_plane - abs(geometry.l3 - rod))
        if margin < worst[1]:
            worst = (name, margin)
    return UnreachableError(position.tolist(), worst[0], worst[1], hint)
