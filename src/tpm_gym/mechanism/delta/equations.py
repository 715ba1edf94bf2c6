"""Closed-form equations of the Delta, for floats, arrays and tensors.

Three legs stand at 0, 120 and 240 degrees about z. In the frame of a leg, x points outwards, and z
points from the base to the platform. The arm turns about -y: it points along x at theta = 0, and
along z at theta = pi/2. The platform only translates. So each leg keeps P on a sphere of radius l4,
whose centre is the elbow B_i displaced inwards by l2.

* Forward kinematics: P is one of the two points where three spheres intersect.
* Inverse kinematics: the elbow is one of the two points where a circle and a sphere intersect.
* Velocity v of P: B_iC_i . v = B_iC_i . dB_i/dtheta_i theta_dot_i, in short A v = B theta_dot. The
  rods are the rows of A; det A is zero at parallel singularities. B is diagonal; one of its entries
  is zero at a serial singularity.
* Constraint: the two rods of a leg lie in one plane, and keep the platform from turning about the
  normal of this plane. Where the three normals are coplanar, the platform can turn.

As in :mod:`tpm_gym.kinematics.equations`, the functions take floats, arrays or tensors, check
nothing, and return whether a solution exists.
"""

import math
from typing import NamedTuple

from tpm_gym.kinematics.equations import ROUNDING, SINGULAR, Triple, arm, arms
from tpm_gym.kinematics.namespaces import Namespace, Numbers
from tpm_gym.mechanism.delta.geometry import AnyDelta

Pair = tuple[float, float]

_HALF, _ROOT = 0.5, math.sqrt(0.75)
ONE: Pair = (1.0, 0.0)
"""Direction of leg 1 in the base plane."""
TWO: Pair = (-_HALF, _ROOT)
THREE: Pair = (-_HALF, -_ROOT)


class Pose(NamedTuple):
    """Configuration of a Delta.

    Attributes:
        cos: l3 cos(theta_i), m.
        sin: l3 sin(theta_i), m.
        position: Point P, m.
        rods: Vectors B_iC_i in the frames of their legs, m.
        bars: Vectors B_iC_i in the base's frame, m.
        parallel: det A, m^3.
        serial: B_iC_i . dB_i/dtheta_i, m^2/rad.
        constraint: Determinant of the three normals of the planes of the rods, m^3.
    """

    cos: Triple
    sin: Triple
    position: Triple
    rods: tuple[Triple, Triple, Triple]
    bars: tuple[Triple, Triple, Triple]
    parallel: Numbers
    serial: Triple
    constraint: Numbers


def dot(a: Triple, b: Triple) -> Numbers:
    """Compute the dot product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Triple, b: Triple) -> Triple:
    """Compute the cross product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def inwards(leg: Pair, v: Triple) -> Triple:
    """Convert a vector from the base's frame to the frame of a leg."""
    return leg[0] * v[0] + leg[1] * v[1], leg[0] * v[1] - leg[1] * v[0], v[2]


def outwards(leg: Pair, v: Triple) -> Triple:
    """Convert a vector from the frame of a leg to the base's frame."""
    return leg[0] * v[0] - leg[1] * v[1], leg[0] * v[1] + leg[1] * v[0], v[2]


def assembly_at(
    cos: Triple, sin: Triple, side: Numbers, g: AnyDelta, ns: Namespace
) -> tuple[Triple, Numbers, Numbers]:
    """Compute P, one of two points where three spheres intersect, for the sign ``side`` of det A.

    Returns:
        P, m; whether it is real; and the squared distance of P to the plane of the centres, m^2,
        which is negative if the spheres do not intersect.
    """
    inner = g.l1 - g.l2
    b1 = outwards(ONE, (inner + cos[0], 0.0, sin[0]))
    b2 = outwards(TWO, (inner + cos[1], 0.0, sin[1]))
    b3 = outwards(THREE, (inner + cos[2], 0.0, sin[2]))
    a = b2[0] - b1[0], b2[1] - b1[1], b2[2] - b1[2]
    b = b3[0] - b1[0], b3[1] - b1[1], b3[2] - b1[2]
    normal = cross(a, b)
    square = dot(normal, normal)
    # From the first centre to the middle of the circle through all three
    (px, py, pz), (qx, qy, qz) = cross(b, normal), cross(normal, a)
    f, h = dot(a, a) / (2.0 * square), dot(b, b) / (2.0 * square)
    foot = f * px + h * qx, f * py + h * qy, f * pz + h * qz
    height2 = g.l4 * g.l4 - dot(foot, foot)
    real = height2 >= -ROUNDING * g.l4 * g.l4  # False for NaN: the centres are on a line
    up = side * ns.root(height2 / square)
    position = (
        b1[0] + foot[0] + up * normal[0],
        b1[1] + foot[1] + up * normal[1],
        b1[2] + foot[2] + up * normal[2],
    )
    return position, real, height2


def posture_at(point: Triple, bends: Triple, g: AnyDelta, ns: Namespace) -> tuple[Triple, Numbers]:
    """Compute theta in (-pi, pi] for the signs of a working mode, and whether theta is real."""
    inner = g.l2 - g.l1
    (x1, y1, z), (x2, y2, _) = inwards(ONE, point), inwards(TWO, point)
    x3, y3, _ = inwards(THREE, point)
    one, real1 = arm(x1 + inner, z, y1, bends[0], g, ns)
    two, real2 = arm(x2 + inner, z, y2, bends[1], g, ns)
    three, real3 = arm(x3 + inner, z, y3, bends[2], g, ns)
    return (one, two, three), real1 & real2 & real3


def pose_at(theta: Triple, side: Numbers, g: AnyDelta, ns: Namespace) -> tuple[Pose, Numbers]:
    """Assemble a Delta; return the configuration, and whether it is real."""
    cos, sin = arms(theta, g, ns)
    position, real, _ = assembly_at(cos, sin, side, g, ns)
    return pose_of(cos, sin, position, g), real


def pose_of(cos: Triple, sin: Triple, position: Triple, g: AnyDelta) -> Pose:
    """Compute the configuration from P and the arms' components ``cos`` and ``sin``, all in m.

    The distances from B_i to C_i have to be l4, which is not checked.
    """
    r1 = rod(ONE, position, cos[0], sin[0], g)
    r2 = rod(TWO, position, cos[1], sin[1], g)
    r3 = rod(THREE, position, cos[2], sin[2], g)
    bars = outwards(ONE, r1), outwards(TWO, r2), outwards(THREE, r3)
    parallel = dot(bars[0], cross(bars[1], bars[2]))
    serial = (
        r1[2] * cos[0] - r1[0] * sin[0],
        r2[2] * cos[1] - r2[0] * sin[1],
        r3[2] * cos[2] - r3[0] * sin[2],
    )
    constraint = _ROOT * (r1[0] * r2[2] * r3[2] + r1[2] * r2[0] * r3[2] + r1[2] * r2[2] * r3[0])
    return Pose(cos, sin, position, (r1, r2, r3), bars, parallel, serial, constraint)


def rod(leg: Pair, position: Triple, cos: Numbers, sin: Numbers, g: AnyDelta) -> Triple:
    """Compute B_iC_i in the frame of a leg, m."""
    x, y, z = inwards(leg, position)
    return x + (g.l2 - g.l1) - cos, y, z - sin


def regular(pose: Pose, g: AnyDelta) -> Numbers:
    """Return whether det A is not zero, so that J exists."""
    return abs(pose.parallel) >= SINGULAR * g.l4 * g.l4 * g.l4


def resolve(pose: Pose, h: Triple) -> Triple:
    """Solve B_iC_i . v = h_i for v, a velocity or an acceleration of P."""
    one, two, three = pose.bars
    a, b, c = cross(two, three), cross(three, one), cross(one, two)
    p, q, r = h[0] / pose.parallel, h[1] / pose.parallel, h[2] / pose.parallel
    return (
        p * a[0] + q * b[0] + r * c[0],
        p * a[1] + q * b[1] + r * c[1],
        p * a[2] + q * b[2] + r * c[2],
    )


def velocity(pose: Pose) -> tuple[Triple, Triple, Triple]:
    """Compute the rows of J (v = J theta_dot), m/rad; J exists at serial singularities too."""
    one, two, three = pose.bars
    a, b, c = cross(two, three), cross(three, one), cross(one, two)
    p, q, r = pose.serial
    p, q, r = p / pose.parallel, q / pose.parallel, r / pose.parallel
    return (
        (p * a[0], q * b[0], r * c[0]),
        (p * a[1], q * b[1], r * c[1]),
        (p * a[2], q * b[2], r * c[2]),
    )
