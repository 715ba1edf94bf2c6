"""The kinematics of one configuration in plain floats, for loops that run at every time step.

For a single point, numpy's calls cost ten times what they compute. The formulas are those of
:mod:`tpm_gym.kinematics.position` and :mod:`tpm_gym.kinematics.jacobian`, where they are explained; tests hold the two
together. Inputs are not checked here: three finite floats are expected.
"""

from __future__ import annotations

import math
import sys
from typing import NamedTuple

import numpy as np

from tpm_gym.arrays import Vector
from tpm_gym.errors import SingularityError
from tpm_gym.kinematics.geometry import Geometry
from tpm_gym.kinematics.modes import AssemblyMode, WorkingMode
from tpm_gym.kinematics.unreachable import no_assembly, no_posture

__all__ = ["ROUNDING", "SINGULAR", "Assembly", "assemble", "evaluate", "posture"]

ROUNDING = 64 * sys.float_info.epsilon
"""Where two solutions merge, rounding alone can push a discriminant (always scaled to order one)
below zero by a few units in the last place. Those are solutions, not misses."""
SINGULAR = 1e-6
"""A factor of det A below this cannot be told from zero: cos(beta) is known to about 1e-14, and
where it is 1, sin(beta) to the square root of that only (y to 50 nm)."""


class Assembly(NamedTuple):
    """The mechanism assembled at three actuated angles: P and C1 in m, and link 7's direction."""

    x: float
    y: float
    z: float
    x_c: float
    z_c: float
    cos_beta: float
    sin_beta: float


def assemble(theta: Vector, branch: AssemblyMode, geometry: Geometry) -> Assembly:
    """Forward kinematics on one branch (Eqs. 6 to 11, corrected).

    Args:
        theta: (3) rad.
        branch: The assembly mode.
        geometry: Link lengths.

    Raises:
        UnreachableError: If the branch does not exist at theta.
    """
    theta_1, theta_2, theta_3 = theta
    g, l3, l4 = geometry, geometry.l3, geometry.l4
    y1, z1 = g.l1 + l3 * math.cos(theta_1), l3 * math.sin(theta_1)
    dx, dz = l3 * math.cos(theta_2) + (2 * g.l5 - g.l1), l3 * math.sin(theta_2) - z1
    distance2 = dx * dx + dz * dz
    if distance2 == 0.0:
        raise no_assembly(np.array(theta), branch, geometry)
    along = 0.5 - 0.5 * y1 * y1 / distance2
    across2 = (l4 * l4 - y1 * y1) / distance2 - along * along
    if across2 < -ROUNDING * (1 + along * along):
        raise no_assembly(np.array(theta), branch, geometry)
    across = branch.planar * math.sqrt(max(0.0, across2))
    x_c, z_c = along * dx - across * dz, z1 + along * dz + across * dx
    u = x_c - (l3 * math.cos(theta_3) + (g.l1 - 2 * g.l2))
    w = z_c - (l3 * math.sin(theta_3) - g.l6)
    numerator, denominator = l4 * l4 - g.l7 * g.l7 - u * u - w * w, 2 * g.l7 * u
    gain = 1 + l4 * l4 / (distance2 * abs(across)) if across else 64
    blur = min(gain, 64) * ROUNDING * l4 * l4
    if abs(numerator) > abs(denominator) + blur or denominator == 0.0:
        raise no_assembly(np.array(theta), branch, geometry)
    cos_beta = min(1.0, max(-1.0, numerator / denominator))
    sin_beta = branch.sin_beta * math.sqrt((1 - cos_beta) * (1 + cos_beta))
    return Assembly(
        x_c + g.l7 * cos_beta + g.l2,
        g.l7 * sin_beta,
        z_c + 2 * g.l6,
        x_c,
        z_c,
        cos_beta,
        sin_beta,
    )


def posture(point: Vector, branch: WorkingMode, geometry: Geometry) -> Vector:
    """Inverse kinematics on one branch (Eqs. 12 to 15, corrected).

    Args:
        point: (3) m, point P in the paper frame.
        branch: The working mode.
        geometry: Link lengths.

    Returns:
        (3) rad, in the ranges of :func:`tpm_gym.kinematics.position.inverse`.

    Raises:
        UnreachableError: If the branch does not exist at the point.
    """
    x, y, z = point
    g = geometry
    sin_beta = y / g.l7
    cos2 = (1 - sin_beta) * (1 + sin_beta)
    if cos2 < -ROUNDING:
        raise no_posture(np.array(point), branch, geometry)
    x_c = x - g.l2 - branch.cos_beta * g.l7 * math.sqrt(max(0.0, cos2))
    z_c = z - 2 * g.l6
    try:
        # (C_i - A_i): level in the arm's plane, vertical in it, out of it (squared)
        theta_1 = _solve_leg(-g.l1, z_c, x_c * x_c, branch.leg1, g)
        theta_2 = _solve_leg(x_c + g.l1 - 2 * g.l5, z_c, 0.0, branch.leg2, g)
        theta_3 = _solve_leg(x + g.l2 - g.l1, z - g.l6, y * y, branch.leg3, g)
    except (ValueError, ZeroDivisionError):  # out of reach, or a rod's end at the pivot
        raise no_posture(np.array(point), branch, geometry) from None
    return _cut(theta_1), theta_2 if theta_2 >= 0 else theta_2 + 2 * math.pi, _cut(theta_3)


def _solve_leg(a: float, b: float, out2: float, bend: int, geometry: Geometry) -> float:
    """An arm's angle from a cos + b sin = c; ValueError where the leg does not reach."""
    l3, l4 = geometry.l3, geometry.l4
    radius2 = a * a + b * b
    ratio = (radius2 + out2 + (l3 * l3 - l4 * l4)) / (2 * l3 * math.sqrt(radius2))
    if not abs(ratio) <= 1 + ROUNDING:  # so that a NaN, from lengths without end, fails too
        raise ValueError("out of reach")
    return math.atan2(b, a) - bend * math.acos(min(1.0, max(-1.0, ratio)))


def _cut(angle: float) -> float:
    """The angle in (-pi, pi]."""
    if angle > math.pi:
        return angle - 2 * math.pi
    return angle + 2 * math.pi if angle <= -math.pi else angle


def evaluate(
    theta: Vector, branch: AssemblyMode, geometry: Geometry
) -> tuple[Assembly, tuple[Vector, Vector, Vector], float]:
    """The assembly, the rows of the velocity Jacobian J (m/rad) and the conditioning 1/cond(J).

    Args:
        theta: (3) rad.
        branch: The assembly mode.
        geometry: Link lengths.

    Raises:
        UnreachableError: If the branch does not exist at theta.
        SingularityError: If theta is a parallel singularity.
    """
    g = geometry
    assembly = assemble(theta, branch, geometry)
    x, _, _, x_c, z_c, cos_beta, sin_beta = assembly
    cos, sin = [g.l3 * math.cos(a) for a in theta], [g.l3 * math.sin(a) for a in theta]
    # Rods B_iC_i, and their products with dB_i/dtheta_i
    r1x, r1y, r1z = x_c, -g.l1 - cos[0], z_c - sin[0]
    r2x, r2z = x_c - 2 * g.l5 + g.l1 - cos[1], z_c - sin[1]
    r3x, r3z = x + g.l2 - g.l1 - cos[2], z_c + g.l6 - sin[2]
    b1 = r1z * cos[0] - r1y * sin[0]
    b2 = r2z * cos[1] - r2x * sin[1]
    b3 = r3z * cos[2] - r3x * sin[2]
    planar, level3 = r1x * r2z - r1z * r2x, g.l7 * cos_beta - r3x
    parallel = {
        "sin(beta)": sin_beta,
        "(l1 + l3 cos(theta_3) - xC - 2 l2) / l4": level3 / g.l4,
        "planar factor / l4^2": planar / g.l4**2,
    }
    for name, value in parallel.items():
        if abs(value) < SINGULAR:
            raise SingularityError(name, value)
    # Rates of xC, zC and l7 beta for a unit rate of each motor
    x_rate = (r2z * b1 / planar, -r1z * b2 / planar, 0.0)
    z_rate = (-r2x * b1 / planar, r1x * b2 / planar, 0.0)
    k = sin_beta * level3
    turn = [-(r3x * dx + r3z * dz) / k for dx, dz in zip(x_rate, z_rate, strict=True)]
    turn[2] = b3 / k
    (x1, x2, _), (z1, z2, _), (t1, t2, t3) = x_rate, z_rate, turn
    rows = (
        (x1 - sin_beta * t1, x2 - sin_beta * t2, -sin_beta * t3),
        (cos_beta * t1, cos_beta * t2, cos_beta * t3),
        (z1, z2, 0.0),
    )
    return assembly, rows, _conditioning(rows)


def _conditioning(rows: tuple[Vector, Vector, Vector]) -> float:
    """Smallest over largest singular value, s3 / s1, of a matrix (3, 3).

    The cofactors have s1 s2 as their largest singular value, and |det| = s1 s2 s3; the smallest
    one, as the root of the smallest eigenvalue of J J^T, would lose half of its digits. Where the
    two largest nearly coincide, the result is good to 1e-9 only.
    """
    (a, b, c), (d, e, f), (g, h, i) = rows
    first = (e * i - f * h, f * g - d * i, d * h - e * g)
    second = (h * c - i * b, i * a - g * c, g * b - h * a)
    third = (b * f - c * e, c * d - a * f, a * e - b * d)
    determinant = a * first[0] + b * first[1] + c * first[2]
    scale = _largest_singular_value(rows) * _largest_singular_value((first, second, third))
    return abs(determinant) / scale if scale else 0.0


def _largest_singular_value(rows: tuple[Vector, Vector, Vector]) -> float:
    """From the trigonometric roots of the characteristic polynomial of M M^T."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    xx, yy, zz = a * a + b * b + c * c, d * d + e * e + f * f, g * g + h * h + i * i
    xy, xz, yz = a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i
    mean = (xx + yy + zz) / 3
    p, q, r = xx - mean, yy - mean, zz - mean
    spread = math.sqrt((p * p + q * q + r * r + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    if spread == 0.0:
        return math.sqrt(mean)
    half = (p * (q * r - yz * yz) - xy * (xy * r - yz * xz) + xz * (xy * yz - q * xz)) / spread**3
    turn = math.acos(min(1.0, max(-1.0, half / 2))) / 3
    return math.sqrt(mean + 2 * spread * math.cos(turn))
