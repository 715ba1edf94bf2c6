"""Closed-form equations of the mechanism, for floats, arrays and tensors.

The paper's frame O-xyz has its origin in the middle of the base. The base lies in the plane z = 0,
and z points from the base towards the platform. Units are metres and radians. The mechanism has two
loops of coupling degree zero, so forward and inverse kinematics reduce to intersections of circles.
The intersections are computed with vectors, or from equations ``a cos + b sin = c``. The paper's
half-angle forms (Eqs. 13 and 15), quadratic equations in tan(theta_i / 2), are not used. They fail
where theta_i = pi, or where the coefficient of the squared tangent (the paper's g_i) is zero.

The functions compute with the numbers of their namespace ``ns``: arrays and tensors
(:mod:`tpm_gym.kinematics.namespaces`), or floats in compiled code
(:mod:`tpm_gym.kinematics.compiled`). Components (x, y, z or theta_1 to theta_3) are separate
numbers (...,), and signs of branches broadcast with them. These functions do not check their
arguments, and raise no errors. Besides a solution, they return whether the solution is real, and
the lengths that explain why it is not real.
"""

import math
import sys
from typing import NamedTuple, Protocol

import numpy as np

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.errors import UnreachableError
from tpm_gym.kinematics.geometry import AnyLengths, Geometry
from tpm_gym.kinematics.modes import AssemblyMode, WorkingMode
from tpm_gym.kinematics.namespaces import NUMPY, Namespace, Numbers, namespace_of

ROUNDING = 64 * sys.float_info.epsilon
"""A discriminant, scaled to order one, counts as zero if it is below zero by at most this amount.
Where two solutions merge, rounding can make it negative although the solutions exist."""
_REACH = 1.0 + ROUNDING
SINGULAR = 1e-6
"""Limit below which a factor of det A, divided by lengths, counts as zero. With the paper's
lengths, sin(beta) is below this limit where P is less than 50 nm from y = 0. sin(beta) is computed
from cos(beta), whose error is about 1e-14. So where sin(beta) is almost zero, its error is about
1e-7, which is below the limit."""
LEAST = 1e-30
"""Smallest det A, m^3, for which the conditioning is computed. For a smaller det A, terms of the
conditioning could overflow."""

_TINY = sys.float_info.min  # the smallest divisor

Triple = tuple[Numbers, Numbers, Numbers]
_Four = tuple[Numbers, Numbers, Numbers, Numbers]


class LegLengths(Protocol):
    """Lengths of arms and rods, m, of any mechanism."""

    @property
    def l3(self) -> Numbers:
        """Length of the arms A_iB_i."""

    @property
    def l4(self) -> Numbers:
        """Length of the rods B_iC_i."""


class Assembly(NamedTuple):
    """Mechanism assembled at three actuated angles: P and C1, m, and the direction of link 7."""

    x: Numbers
    y: Numbers
    z: Numbers
    x_c: Numbers
    z_c: Numbers
    cos_beta: Numbers
    sin_beta: Numbers


class Factors(NamedTuple):
    """Factors of det A (Eq. 16, corrected) and of det B (Eq. 17, corrected), and the elevation.

    A configuration is singular where a factor or the elevation is zero.

    Attributes:
        level3: l1 + l3 cos(theta_3) - xC - 2 l2, m.
        planar: Cross product, m^2, of B1C1 and B2C2, both projected on y = 0; zero where the
            projections are parallel.
        leg1: B_1C_1 . dB_1/dtheta_1, m^2/rad; zero where leg 1, seen along x, is stretched or
            folded.
        leg2: B_2C_2 . dB_2/dtheta_2, m^2/rad.
        leg3: B_3C_3 . dB_3/dtheta_3, m^2/rad.
        elevation: z_C1 - z_B1, m. Zero is a constraint singularity: there, the rods of the 4S
            parallelogram no longer keep link 3' from turning about y.
    """

    sin_beta: Numbers
    level3: Numbers
    planar: Numbers
    cos_beta: Numbers
    leg1: Numbers
    leg2: Numbers
    leg3: Numbers
    elevation: Numbers

    @property
    def parallel(self) -> FloatArray:
        """(..., 3), factors of det A: ``sin_beta``, ``level3``, ``planar`` of this class."""
        found: FloatArray = namespace_of(self.planar).stack(self[:3])
        return found

    @property
    def serial(self) -> FloatArray:
        """(..., 4), factors of det B: cos_beta, leg1, leg2, leg3."""
        found: FloatArray = namespace_of(self.leg1).stack(self[3:7])
        return found


def arms(theta: Triple, g: LegLengths, ns: Namespace) -> tuple[Triple, Triple]:
    """Compute the arms A_iB_i in their planes: l3 cos(theta_i), and l3 sin(theta_i), m."""
    one, two, three = theta
    cos, sin, l3 = ns.cos, ns.sin, g.l3
    level = l3 * cos(one), l3 * cos(two), l3 * cos(three)
    return level, (l3 * sin(one), l3 * sin(two), l3 * sin(three))


def assembly_at(
    cos: Triple, sin: Triple, planar: Numbers, side: Numbers, g: AnyLengths, ns: Namespace
) -> tuple[Assembly, Numbers, tuple[Numbers, Numbers, Numbers, Numbers, Numbers]]:
    """Solve forward kinematics (Eqs. 6 to 11, corrected) in a given assembly mode.

    The sign of the planar factor is ``planar``, and the sign of sin(beta) is ``side``. ``cos`` and
    ``sin`` are from :func:`arms`.

    Eq. (6): in the plane y = 0, C1 is on two circles. With the elbow B1 at (0, y1, z1), the first
    circle has the centre (0, z1) and radius^2 = l4^2 - y1^2. The second circle has the radius l4.
    Its centre (dx, z1 + dz) is the elbow B2 displaced by 2 l5 along x. The intersection on the left
    of the line from the first to the second centre has a positive planar factor, the other
    intersection a negative one.

    Returns:
        The assembly, whether it is real, and five values that explain why it is not. In this order,
        the values are:

        * whether the circles meet and rod 11 fits. If this is true although the assembly is not
          real, then a2 = b2 = 0 in Eq. (10), and rod 11 fits for every beta;
        * y1, m;
        * the squared distance of the circles' centres, m^2;
        * the horizontal distance from B3 to C3 that a link 7 of length 0 would give, m;
        * the vertical distance from B3 to C3 that a link 7 of length 0 would give, m.
    """
    l4, l7 = g.l4, g.l7
    y1, z1 = g.l1 + cos[0], sin[0]
    dx, dz = cos[1] + (2.0 * g.l5 - g.l1), sin[1] - z1
    distance2 = dx * dx + dz * dz
    along = 0.5 - 0.5 * y1 * y1 / distance2
    across2 = (l4 * l4 - y1 * y1) / distance2 - along * along
    # Both terms can be large against their difference; scale the tolerance by them.
    meet = across2 >= -ROUNDING * (1.0 + along * along)
    root = ns.root(across2)
    across = planar * root
    x_c, z_c = along * dx - across * dz, z1 + along * dz + across * dx
    # Eqs. (9) and (10), with z_C3 = z_C + l6
    u, w = x_c - (cos[2] + (g.l1 - 2.0 * g.l2)), z_c - (sin[2] - g.l6)
    numerator, denominator = l4 * l4 - l7 * l7 - u * u - w * w, 2.0 * l7 * u
    # Rounding in C1 grows as 1 / (planar factor), and rounding in cos(beta) also as 1 / u. With the
    # cap of 64, clipping the cosine leaves a gap in rod 11 below l4 / 1e12.
    blur = (1.0 + l4 * l4 / ns.maximum(distance2 * root, l4 * l4 / 63.0)) * (ROUNDING * l4 * l4)
    turned = abs(denominator)
    reached = meet & (abs(numerator) <= turned + blur)
    real = reached & (turned > blur)
    cos_beta = ns.clip(numerator / denominator)
    sin_beta = side * ns.root((1.0 - cos_beta) * (1.0 + cos_beta))
    x, y, z = x_c + l7 * cos_beta + g.l2, l7 * sin_beta, z_c + 2.0 * g.l6  # Eq. (11)
    found = Assembly(x, y, z, x_c, z_c, cos_beta, sin_beta)
    return found, real, (reached, y1, distance2, u, w)


def posture_at(
    point: Triple, signs: tuple[Numbers, ...], g: AnyLengths, ns: Namespace
) -> tuple[Triple, Numbers, _Four, _Four]:
    """Solve inverse kinematics (Eqs. 12 to 15, corrected) in the working mode with given ``signs``.

    Returns:
        Four results, in this order.

        * the angles: theta_1 and theta_3 in (-pi, pi], theta_2 in [0, 2 pi). Arms 1 and 3 point
          inwards at pi, arm 2 at 0;
        * whether the angles are real;
        * xC, zC, cos(beta) and sin(beta);
        * for :func:`leg_margin`, distances of C_i from A_i in the arm's plane, m: the horizontal
          distances of legs 1, 2 and 3, and the vertical distance of leg 3.
    """
    x, y, z = point
    side, bend1, bend2, bend3 = signs
    l1 = g.l1
    sin_beta = y / g.l7
    squared = (1.0 - sin_beta) * (1.0 + sin_beta)
    cos_beta = side * ns.root(squared)
    x_c, z_c = x - g.l2 - g.l7 * cos_beta, z - 2.0 * g.l6
    a1, a2, a3, b3 = -l1, x_c + l1 - 2.0 * g.l5, x + g.l2 - l1, z - g.l6
    one, real1 = arm(a1, z_c, x_c, bend1, g, ns)
    two, real2 = arm(a2, z_c, 0.0, bend2, g, ns)
    three, real3 = arm(a3, b3, y, bend3, g, ns)
    real = (squared >= -ROUNDING) & real1 & real2 & real3
    theta = one, ns.positive(two), three
    return theta, real, (x_c, z_c, cos_beta, sin_beta), (a1, a2, a3, b3)


def arm(
    a: Numbers, b: Numbers, out: Numbers, bend: Numbers, g: LegLengths, ns: Namespace
) -> tuple[Numbers, Numbers]:
    """Compute the arm's angle theta in (-pi, pi] from |C - A - l3 e(theta)| = l4.

    Here e(theta) is the unit vector along the arm.

    Args:
        a: Horizontal distance of C from A in the arm's plane, m.
        b: Vertical distance of C from A, m.
        out: Distance of C from the arm's plane, m.
        bend: Sign of BC . dB/dtheta = l3 (b cos(theta) - a sin(theta)); it selects one of the two
            solutions.

    Returns:
        The angle, and whether the leg reaches C.
    """
    l3, l4 = g.l3, g.l4
    radius2 = a * a + b * b
    ratio = (radius2 + out * out + (l3 * l3 - l4 * l4)) / (2.0 * l3 * ns.sqrt(radius2))
    reaches = abs(ratio) <= _REACH  # False for NaN, from infinite lengths
    # Cosine and sine of the angle between the arm and the direction of C
    cos = ns.clip(ratio)
    sin = bend * ns.root((1.0 - cos) * (1.0 + cos))
    return ns.arctan2(b * cos - a * sin, a * cos + b * sin), reaches


def rods(cos: Triple, sin: Triple, found: Assembly, g: AnyLengths) -> tuple[Triple, Triple, Triple]:
    """Compute the vectors B_iC_i, m."""
    x, y, _, x_c, z_c, _, _ = found
    return (
        (x_c, -g.l1 - cos[0], z_c - sin[0]),
        (x_c - 2 * g.l5 + g.l1 - cos[1], 0.0, z_c - sin[1]),
        (x + g.l2 - g.l1 - cos[2], y, z_c + g.l6 - sin[2]),
    )


def factors(
    cos: Triple,
    sin: Triple,
    found: Assembly,
    bars: tuple[Triple, Triple, Triple],
    g: AnyLengths,
) -> Factors:
    """Compute the factors that are zero at singularities, from arms and rods."""
    (r1x, r1y, r1z), (r2x, _, r2z), (r3x, _, r3z) = bars
    # Arm 1 turns in the yz plane, arms 2 and 3 in the xz plane.
    return Factors(
        found.sin_beta,
        g.l7 * found.cos_beta - r3x,
        r1x * r2z - r1z * r2x,
        found.cos_beta,
        r1z * cos[0] - r1y * sin[0],
        r2z * cos[1] - r2x * sin[1],
        r3z * cos[2] - r3x * sin[2],
        r1z,
    )


def regular(values: Factors, g: AnyLengths) -> Numbers:
    """Return whether no factor of det A is zero, so that J exists."""
    flat = SINGULAR * g.l4
    turned = abs(values.sin_beta) >= SINGULAR
    return turned & (abs(values.level3) >= flat) & (abs(values.planar) >= flat * g.l4)


def link_velocity(
    bars: tuple[Triple, Triple, Triple], values: Factors
) -> tuple[tuple[Numbers, Numbers], tuple[Numbers, Numbers], Triple]:
    """Compute the derivatives of xC, zC and the product l7 * beta by the joint positions, m/rad.

    They solve a linear system: the equations of the loop closures, differentiated with respect to
    time. The determinant of this system is the product of sin(beta) and the factors ``level3`` and
    ``planar`` in :class:`Factors`.

    Returns:
        Derivatives of xC and of zC by theta_1 and theta_2 (motor 3 does not move link 3'), and of
        l7 * beta by all three joint positions.
    """
    (r1x, _, r1z), (r2x, _, r2z), (r3x, _, r3z) = bars
    # Divisions take longer than all else, so each divisor is inverted once.
    over, per_k = 1.0 / values.planar, 1.0 / (values.sin_beta * values.level3)
    leg1, leg2 = values.leg1 * over, values.leg2 * over
    x1, x2, z1, z2 = r2z * leg1, -r1z * leg2, -r2x * leg1, r1x * leg2
    turn = -(r3x * x1 + r3z * z1) * per_k, -(r3x * x2 + r3z * z2) * per_k, values.leg3 * per_k
    return (x1, x2), (z1, z2), turn


def velocity(bars: tuple[Triple, Triple, Triple], values: Factors) -> tuple[Triple, Triple, Triple]:
    """Compute the rows of J, v = J theta_dot, m/rad; J exists at serial singularities too."""
    sin_beta, cos_beta = values.sin_beta, values.cos_beta
    (x1, x2), (z1, z2), (turn1, turn2, turn3) = link_velocity(bars, values)
    return (
        (x1 - sin_beta * turn1, x2 - sin_beta * turn2, -sin_beta * turn3),
        (cos_beta * turn1, cos_beta * turn2, cos_beta * turn3),
        (z1, z2, 0.0),
    )


def conditioning(rows: tuple[Triple, Triple, Triple], ns: Namespace) -> Numbers:
    """Compute smallest over largest singular value, s3 / s1, of a matrix M (3, 3).

    |det M| = s1 s2 s3, and the matrix of cofactors has the largest singular value s1 s2. So s3 / s1
    is |det M| divided by s1 and by s1 s2. If s3 were computed as the root of the smallest
    eigenvalue of M M^T, half of its digits would be lost. Where s1 and s2 nearly coincide, the
    result is accurate to 1e-9 only.
    """
    (a, b, c), (d, e, f), (g, h, i) = rows
    first = (e * i - f * h, f * g - d * i, d * h - e * g)
    second = (h * c - i * b, i * a - g * c, g * b - h * a)
    third = (b * f - c * e, c * d - a * f, a * e - b * d)
    determinant = a * first[0] + b * first[1] + c * first[2]
    scale = _largest_singular_value(rows, ns) * _largest_singular_value((first, second, third), ns)
    return ns.clip(abs(determinant) / ns.maximum(scale, _TINY))


def _largest_singular_value(rows: tuple[Triple, Triple, Triple], ns: Namespace) -> Numbers:
    """Compute the largest singular value of M, the root of the largest eigenvalue of M M^T.

    The eigenvalue comes from the trigonometric formula for the characteristic polynomial's roots.
    """
    (a, b, c), (d, e, f), (g, h, i) = rows
    xx, yy, zz = a * a + b * b + c * c, d * d + e * e + f * f, g * g + h * h + i * i
    xy, xz, yz = a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i
    mean = (xx + yy + zz) / 3.0
    p, q, r = xx - mean, yy - mean, zz - mean
    yz2 = yz * yz
    spread = ns.root((p * p + q * q + r * r + 2.0 * (xy * xy + xz * xz + yz2)) / 6.0)
    half = p * (q * r - yz2) - xy * (xy * r - yz * xz) + xz * (xy * yz - q * xz)
    turned = ns.cos_third(half / ns.maximum(spread * spread * spread, _TINY) / 2.0)
    return ns.sqrt(mean + 2.0 * spread * turned)


# -- why there is no configuration, or no velocity -------------------------------------------------


def no_assembly(theta: Vector, branch: AssemblyMode, g: Geometry) -> UnreachableError:
    """Explain which loop does not close in an assembly mode at theta (3,) rad, and by how much."""
    with np.errstate(all="ignore"):
        cos, sin = arms(tuple(map(np.float64, theta)), g, NUMPY)
        _, _, found = assembly_at(cos, sin, branch.planar, branch.sin_beta, g, NUMPY)
    free, y1, distance2, level, vertical = map(float, found)
    hint = f"choose joint angles at which {branch} exists"
    if free:
        return UnreachableError(theta, "loop 2 (beta is free: a2 = b2 = 0)", 0.0, hint)
    if abs(y1) >= g.l4:
        return UnreachableError(theta, "loop 1 (rod B1C1 to y = 0)", g.l4 - abs(y1), hint)
    radius, distance = math.sqrt(g.l4**2 - y1**2), math.sqrt(distance2)
    margin = min(radius + g.l4 - distance, distance - (g.l4 - radius))
    if margin < 0 or distance == 0:
        return UnreachableError(theta, "loop 1 (circles of B1C1 and B2C2)", margin, hint)
    nearest, farthest = (math.hypot(abs(level) + side * g.l7, vertical) for side in (-1, 1))
    margin = min(farthest - g.l4, g.l4 - nearest)
    return UnreachableError(theta, "loop 2 (rod B3C3 to link 7)", margin, hint)


def no_posture(point: Vector, branch: WorkingMode, g: Geometry) -> UnreachableError:
    """Explain which leg does not reach a point (3,) m in a working mode, and by how much."""
    hint = f"choose a point that {branch} reaches (tpm_gym.kinematics.workspace)"
    beyond = g.l7 - abs(point[1])
    if beyond < 0:
        return UnreachableError(point, "beta (|y| <= l7)", beyond, hint)
    with np.errstate(all="ignore"):
        _, _, (x_c, z_c, *_), (a1, a2, a3, b3) = posture_at(
            tuple(map(np.float64, point)), branch.signs, g, NUMPY
        )
    legs = (a1, z_c, x_c), (a2, z_c, 0.0), (a3, b3, point[1])
    margin, leg = min((leg_margin(*leg, g), i) for i, leg in enumerate(legs, 1))
    return UnreachableError(point, f"leg {leg}", margin, hint)


def leg_margin(level: float, vertical: float, out: float, g: LegLengths) -> Numbers:
    """Return the margin by which a leg reaches C, m; negative if the leg does not reach C.

    Args:
        level: Horizontal distance of C from A in the arm's plane, m.
        vertical: Vertical distance of C from A, m.
        out: Distance of C from the arm's plane, m.
        g: Lengths of the leg.
    """
    if abs(out) >= g.l4:
        return g.l4 - abs(out)
    in_plane, rod = math.hypot(level, vertical), math.sqrt(g.l4**2 - out**2)
    return min(g.l3 + rod - in_plane, in_plane - abs(g.l3 - rod))
