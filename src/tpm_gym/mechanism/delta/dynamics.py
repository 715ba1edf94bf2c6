"""Dynamics of the Delta in closed form, without solver or iteration.

    torque = M(theta) theta_ddot + C(theta, theta_dot) theta_dot + g(theta)

The model of the masses is exact for the bodies of :mod:`tpm_gym.mechanism.delta.bodies`:

* arms turn about the motors' axes;
* a rod is a bar between B_i and C_i, with the kinetic energy of two coupled points
  (:mod:`tpm_gym.mechanism.inertia`). It also turns about its own axis as it swings;
* crosses swing with their rods;
* platform, cup and payload translate as P does. The cup's slide is assumed to be at rest.

Forces of inertia and weight act at B_i and P. The forces in the rods solve three linear equations;
the columns of their matrix are the vectors B_iC_i. The forces in the rods give the torques.

Units are SI. In the base's frame, gravity points along +z, as the base hangs upside down.
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from tpm_gym.arrays import Vector
from tpm_gym.errors import SingularityError, UnreachableError
from tpm_gym.kinematics.equations import Triple
from tpm_gym.kinematics.namespaces import Namespace, Numbers
from tpm_gym.mechanism.delta.bodies import Inertia, build, inertia_of
from tpm_gym.mechanism.delta.equations import (
    ONE,
    THREE,
    TWO,
    Pair,
    Pose,
    cross,
    dot,
    inwards,
    outwards,
    pose_at,
    regular,
    resolve,
    velocity,
)
from tpm_gym.mechanism.delta.geometry import IRB_360, DeltaGeometry, require_delta, require_side
from tpm_gym.mechanism.delta.kinematics import no_assembly
from tpm_gym.mechanism.equation_of_motion import EquationOfMotion, Formulas
from tpm_gym.mechanism.inertia import Swing, swing_force


class _Leg(NamedTuple):
    """Arm and rod in the frame of a leg, and the leg's constants from :class:`.bodies.Inertia`.

    ``cos`` is l3 cos(theta), ``sin`` is l3 sin(theta), and ``rod`` is B_iC_i, all in metres.
    """

    cos: Numbers
    sin: Numbers
    rod: Triple
    motor: Numbers
    weight: Numbers
    couple: Numbers
    swing: Swing


def legs(pose: Pose, m: Inertia) -> tuple[_Leg, _Leg, _Leg]:
    """Collect arm, rod and constants of each leg."""
    (c1, c2, c3), (s1, s2, s3), (r1, r2, r3) = pose.cos, pose.sin, pose.rods
    return (
        _Leg(c1, s1, r1, m.motors[0], m.weights[0], m.couples[0], Swing(m.fixed[0], m.spin[0])),
        _Leg(c2, s2, r2, m.motors[1], m.weights[1], m.couples[1], Swing(m.fixed[1], m.spin[1])),
        _Leg(c3, s3, r3, m.motors[2], m.weights[2], m.couples[2], Swing(m.fixed[2], m.spin[2])),
    )


def torques(pose: Pose, rates: Triple, changes: Triple, gravity: Triple, m: Inertia) -> Triple:
    """Compute the torques for rates (rad/s), their changes (rad/s^2) and gravity (m/s^2)."""
    one, two, three = legs(pose, m)
    p, q, r = pose.serial
    v = resolve(pose, (p * rates[0], q * rates[1], r * rates[2]))
    v1, v2, v3 = inwards(ONE, v), inwards(TWO, v), inwards(THREE, v)
    a = resolve(
        pose,
        (
            _drift(one, v1, rates[0]) + p * changes[0],
            _drift(two, v2, rates[1]) + q * changes[1],
            _drift(three, v3, rates[2]) + r * changes[2],
        ),
    )
    f1, t1 = _inertial(ONE, one, v1, a, rates[0], changes[0], gravity)
    f2, t2 = _inertial(TWO, two, v2, a, rates[1], changes[1], gravity)
    f3, t3 = _inertial(THREE, three, v3, a, rates[2], changes[2], gravity)
    total = (
        m.platform * (a[0] - gravity[0]) + f1[0] + f2[0] + f3[0],
        m.platform * (a[1] - gravity[1]) + f1[1] + f2[1] + f3[1],
        m.platform * (a[2] - gravity[2]) + f1[2] + f2[2] + f3[2],
    )
    g1, g2, g3 = gather(pose, total)
    return t1 + g1, t2 + g2, t3 + g3


def gather(pose: Pose, force: Triple) -> Triple:
    """Compute J^T force, the torques (N m) with which the motors exert ``force`` (N) at P."""
    one, two, three = pose.bars
    p, q, r = pose.serial
    return (
        p * dot(force, cross(two, three)) / pose.parallel,
        q * dot(force, cross(three, one)) / pose.parallel,
        r * dot(force, cross(one, two)) / pose.parallel,
    )


def masses(pose: Pose, j: tuple[Triple, Triple, Triple], m: Inertia) -> tuple[Numbers, ...]:
    """Compute the upper triangle of M, kg m^2, by rows, from the bodies' kinetic energy.

    Args:
        pose: Configuration.
        j: Rows of the velocity Jacobian, m/rad.
        m: Constants of the bodies.
    """
    one, two, three = legs(pose, m)
    (xa, xb, xc), (ya, yb, yc), (za, zb, zc) = j
    a, b, c = (xa, ya, za), (xb, yb, zb), (xc, yc, zc)  # velocities of P for unit rates
    a1, b1, c1 = inwards(ONE, a), inwards(ONE, b), inwards(ONE, c)
    a2, b2, c2 = inwards(TWO, a), inwards(TWO, b), inwards(TWO, c)
    a3, b3, c3 = inwards(THREE, a), inwards(THREE, b), inwards(THREE, c)
    # For each leg and motor: coupling of P with the elbow, and rate of the swing
    k1a, k1b, k1c = _along(one, a1), _along(one, b1), _along(one, c1)
    k2a, k2b, k2c = _along(two, a2), _along(two, b2), _along(two, c2)
    k3a, k3b, k3c = _along(three, a3), _along(three, b3), _along(three, c3)
    w1a, w1b, w1c = _turn(one, a1, 1.0), _turn(one, b1, 0.0), _turn(one, c1, 0.0)
    w2a, w2b, w2c = _turn(two, a2, 0.0), _turn(two, b2, 1.0), _turn(two, c2, 0.0)
    w3a, w3b, w3c = _turn(three, a3, 0.0), _turn(three, b3, 0.0), _turn(three, c3, 1.0)
    i1, i2, i3 = _swinging(one), _swinging(two), _swinging(three)
    p = m.platform
    return (
        one.motor + p * dot(a, a) + 2.0 * k1a + i1 * w1a * w1a + i2 * w2a * w2a + i3 * w3a * w3a,
        p * dot(a, b) + k1b + k2a + i1 * w1a * w1b + i2 * w2a * w2b + i3 * w3a * w3b,
        p * dot(a, c) + k1c + k3a + i1 * w1a * w1c + i2 * w2a * w2c + i3 * w3a * w3c,
        two.motor + p * dot(b, b) + 2.0 * k2b + i1 * w1b * w1b + i2 * w2b * w2b + i3 * w3b * w3b,
        p * dot(b, c) + k2c + k3b + i1 * w1b * w1c + i2 * w2b * w2c + i3 * w3b * w3c,
        three.motor + p * dot(c, c) + 2.0 * k3c + i1 * w1c * w1c + i2 * w2c * w2c + i3 * w3c * w3c,
    )


def potential(pose: Pose, gravity: Triple, m: Inertia) -> Numbers:
    """Compute the potential energy, J, up to a constant."""
    one, two, three = legs(pose, m)
    e1 = outwards(ONE, (one.cos, 0.0, one.sin))
    e2 = outwards(TWO, (two.cos, 0.0, two.sin))
    e3 = outwards(THREE, (three.cos, 0.0, three.sin))
    at_p = m.platform + one.couple + two.couple + three.couple
    return -(
        (one.weight + one.couple) * dot(gravity, e1)
        + (two.weight + two.couple) * dot(gravity, e2)
        + (three.weight + three.couple) * dot(gravity, e3)
        + at_p * dot(gravity, pose.position)
    )


def _drift(leg: _Leg, v: Triple, rate: Numbers) -> Numbers:
    """Compute B_iC_i . a, m^2/s^2, where a is the acceleration of P if theta_ddot is 0.

    This product follows from the second derivative by time of the closure |B_iC_i|^2 = l4^2.
    """
    x, _, z = leg.rod
    u, w = v[0] + leg.sin * rate, v[2] - leg.cos * rate
    return -(x * leg.cos + z * leg.sin) * rate * rate - (u * u + v[1] * v[1] + w * w)


def _inertial(
    at: Pair, leg: _Leg, v: Triple, a: Triple, rate: Numbers, change: Numbers, gravity: Triple
) -> tuple[Triple, Numbers]:
    """Compute the force and the torque that a leg's inertia and weight require.

    Args:
        at: Direction of the leg.
        leg: The leg.
        v: Velocity of P in the leg's frame, m/s.
        a: Acceleration of P in the base's frame, m/s^2.
        rate: Joint velocity, rad/s.
        change: Joint acceleration, rad/s^2.
        gravity: Gravity in the base's frame, m/s^2.

    Returns:
        The force at P in the base's frame, N, and the torque of the leg's motor, N m.
    """
    cos, sin, (x, y, z), motor, weight, couple, swing = leg
    (ax, _, az), (gx, gy, gz) = inwards(at, a), inwards(at, gravity)
    bx, bz = -sin * change - cos * rate * rate, cos * change - sin * rate * rate
    moving = v[1], v[0] + sin * rate, v[2] - cos * rate
    out, level, up = swing_force((y, x, z), moving, (ax - bx, az - bz), swing)
    force = couple * (bx - gx) + level, out - couple * gy, couple * (bz - gz) + up
    along = couple * (ax - gx) - weight * gx - level
    above = couple * (az - gz) - weight * gz - up
    return outwards(at, force), motor * change - sin * along + cos * above


def _along(leg: _Leg, v: Triple) -> Numbers:
    """Compute ``couple`` times the dot product of dB_i/dtheta_i and v."""
    return leg.couple * (leg.cos * v[2] - leg.sin * v[0])


def _turn(leg: _Leg, v: Triple, rate: float) -> Numbers:
    """Compute the rate of the rods' swing, rad/s."""
    x, _, z = leg.rod
    return (x * (v[2] - leg.cos * rate) - z * (v[0] + leg.sin * rate)) / (x * x + z * z)


def _swinging(leg: _Leg) -> Numbers:
    """Compute the moment of inertia of a leg's swing, kg m^2, from :class:`.inertia.Swing`."""
    out = leg.rod[1]
    return leg.swing.fixed + leg.swing.spin * out * out


@dataclass(frozen=True, kw_only=True)
class DeltaDynamics(EquationOfMotion):
    """The dynamics of a Delta; see :class:`EquationOfMotion`.

    Attributes:
        geometry: Lengths.
        side: Assembly mode, the sign of det A.
    """

    geometry: DeltaGeometry = IRB_360
    side: float = 1.0

    _formulas: ClassVar = Formulas(build, inertia_of, torques, masses, velocity, potential)

    def __post_init__(self) -> None:
        """Reject lengths and modes of other mechanisms."""
        super().__post_init__()
        require_delta(self.geometry)
        require_side(self.side)

    def _pose(self, theta: Triple, ns: Namespace) -> tuple[Pose, Numbers, Numbers]:
        pose, real = pose_at(theta, self.side, self.geometry, ns)
        return pose, real, regular(pose, self.geometry)

    def _refusal(self, theta: Vector) -> UnreachableError | SingularityError:
        return no_assembly(theta, self.side, self.geometry)
