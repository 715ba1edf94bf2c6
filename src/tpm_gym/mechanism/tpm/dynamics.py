"""The dynamics of the mechanism in closed form, without solver or iteration.

    torque = M(theta) theta_ddot + C(theta, theta_dot) theta_dot + g(theta)

The coupling degree is zero, so there are formulas for position, velocity and acceleration of every
point. The closures |B_iC_i| = l4, differentiated twice, give the accelerations of C1 and then of P
from the accelerations of B_i, each by one division (:func:`_resolve`). Forces of inertia and weight
at B_i, C1 and P give the forces in the rods, each by one division. The forces in the rods give the
torques of the motors (:func:`gather`). Sixteen constants describe the bodies
(:mod:`tpm_gym.mechanism.tpm.inertia`):

* the arms turn about the motors' axes;
* a rod is a bar between B_i and C_i, with the kinetic energy of two coupled points. Rods 4 and 11
  also turn about their own axes as they swing. Some bodies swing with rods: end link 9 with rods
  11, and the crosses (the middle pieces of the universal joints at arm 2) with rods 4. Separate
  constants describe this turning of the rods and the swing of these bodies; see ``Swing`` in
  :mod:`tpm_gym.mechanism.inertia`;
* link 3' translates in the plane y = 0, as C1 does;
* link 7 turns about z. It is a bar between C1 and P, except for constant offsets;
* platform, cup, payload and end link 10 translate as P does. The cup's slide is assumed to be at
  rest. End link 10 can also roll about its own axis. This roll does not change the motors' torques
  and is left out.

Units are SI. In the machine's frame, gravity points along +z, as the base hangs upside down.
Functions with a Pose take floats, arrays or tensors, as in :mod:`tpm_gym.kinematics.equations`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from tpm_gym.arrays import Vector
from tpm_gym.errors import InputError, SingularityError, UnreachableError
from tpm_gym.kinematics import DEFAULT_ASSEMBLY, AssemblyMode, equations, jacobian
from tpm_gym.kinematics.equations import Triple
from tpm_gym.kinematics.geometry import PAPER, AnyLengths, Geometry
from tpm_gym.kinematics.modes import require_mode
from tpm_gym.kinematics.namespaces import Namespace, Numbers
from tpm_gym.mechanism.equation_of_motion import Energy as Energy
from tpm_gym.mechanism.equation_of_motion import EquationOfMotion, Formulas
from tpm_gym.mechanism.inertia import swing_force
from tpm_gym.mechanism.tpm.bodies import build
from tpm_gym.mechanism.tpm.inertia import Inertia, inertia_of

_Pair = tuple[Numbers, Numbers]


class Pose(NamedTuple):
    """Configuration of the mechanism.

    Attributes:
        cos: l3 cos(theta_i), m.
        sin: l3 sin(theta_i), m.
        found: P, C1 and the direction of link 7.
        rods: Vectors B_iC_i, m.
        factors: Factors of the Jacobians' determinants.
        per_planar: 1 / ``factors.planar``, 1/m^2. Divisions take longest, so each divisor is
            inverted once.
        per_k: 1 / (``factors.sin_beta`` ``factors.level3``), 1/m.
        lengths: Link lengths, m.
    """

    cos: Triple
    sin: Triple
    found: equations.Assembly
    rods: tuple[Triple, Triple, Triple]
    factors: equations.Factors
    per_planar: Numbers
    per_k: Numbers
    lengths: AnyLengths


def pose_at(
    theta: Triple, signs: tuple[Numbers, ...], g: AnyLengths, ns: Namespace
) -> tuple[Pose, Numbers]:
    """Assemble the mechanism at joint angles, for the signs of an assembly mode.

    Returns:
        The configuration, and whether it exists.
    """
    cos, sin = equations.arms(theta, g, ns)
    found, real, _ = equations.assembly_at(cos, sin, signs[0], signs[1], g, ns)
    rods = equations.rods(cos, sin, found, g)
    factors = equations.factors(cos, sin, found, rods, g)
    per_k = 1.0 / (factors.sin_beta * factors.level3)
    return Pose(cos, sin, found, rods, factors, 1.0 / factors.planar, per_k, g), real


def torques(pose: Pose, rates: Triple, changes: Triple, gravity: Triple, m: Inertia) -> Triple:
    """Compute the motors' torques, N m.

    Args:
        pose: Configuration.
        rates: Joint velocities, rad/s.
        changes: Joint accelerations, rad/s^2.
        gravity: Acceleration of gravity in the machine's frame, m/s^2. Subtracting it from the
            accelerations of all points has the same effect as adding the weights.
        m: Constants of the bodies.
    """
    turn, moved = velocities(pose, rates)
    elbows, (cx, cz), (px, py, pz) = accelerations(pose, rates, changes, turn, moved)
    (c1, c2, c3), (s1, s2, s3), (r1, _, r3), (d1, _, d3) = pose.cos, pose.sin, pose.rods, moved
    (b1y, b1z), (b2x, b2z), (b3x, b3z) = elbows
    f1x, f1y, f1z = swing_force(r1, d1, (-b1y, cz - b1z), m.swing1)
    f3y, f3x, f3z = swing_force(
        (r3[1], r3[0], r3[2]), (d3[1], d3[0], d3[2]), (px - b3x, pz - b3z), m.swing3
    )
    gx, gy, gz = gravity
    cx, cz, px, py, pz = cx - gx, cz - gz, px - gx, py - gy, pz - gz
    (k1, k2, k3), (w1, w2, w3), (j1, j2, j3) = m.couples, m.weights, m.motors
    one, two, three = gather(
        pose,
        (
            m.link3 * cx - k1 * gx + k2 * (b2x - gx) + m.link7 * px + f1x,
            m.link3 * cz + k1 * (b1z - gz) + k2 * (b2z - gz) + m.link7 * pz + f1z,
        ),
        (
            m.platform * px + k3 * (b3x - gx) + m.link7 * cx + f3x,
            m.platform * py - (k3 + m.link7) * gy + f3y,
            m.platform * pz + k3 * (b3z - gz) + m.link7 * cz + f3z,
        ),
    )
    return (
        one + j1 * changes[0] + s1 * ((k1 + w1) * gy + f1y) + c1 * (k1 * cz - w1 * gz - f1z),
        two + j2 * changes[1] - s2 * (k2 * cx - w2 * gx) + c2 * (k2 * cz - w2 * gz),
        three + j3 * changes[2] - s3 * (k3 * px - w3 * gx - f3x) + c3 * (k3 * pz - w3 * gz - f3z),
    )


def masses(pose: Pose, j: tuple[Triple, Triple, Triple], m: Inertia) -> tuple[Numbers, ...]:
    """Compute the upper triangle of M, kg m^2, by rows, from the bodies' kinetic energy.

    Args:
        pose: Configuration.
        j: Rows of the velocity Jacobian, m/rad; motor 3 moves neither C1 nor the height of P.
        m: Constants of the bodies.
    """
    (c1, c2, c3), (s1, s2, s3), f = pose.cos, pose.sin, pose.factors
    (r1x, r1y, r1z), (_, _, r2z), (r3x, r3y, r3z) = pose.rods
    (p1, p2, p3), (q1, q2, q3), (z1, z2, _) = j  # P along x and y; P and C1 along z
    x1, x2 = r2z * f.leg1 * pose.per_planar, -r1z * f.leg2 * pose.per_planar  # C1
    (j1, j2, j3), (k1, k2, k3) = m.motors, m.couples
    over1, over3 = 1.0 / (r1y * r1y + r1z * r1z), 1.0 / (r3x * r3x + r3z * r3z)
    u1, u2 = (r1y * (z1 - c1) - r1z * s1) * over1, r1y * z2 * over1  # swing of leg 1
    v1, v2 = (r3x * z1 - r3z * p1) * over3, (r3x * z2 - r3z * p2) * over3  # of leg 3
    v3 = -(r3x * c3 + r3z * (p3 + s3)) * over3
    swing1 = m.swing1.fixed + m.swing1.spin * r1x * r1x
    swing3 = m.swing3.fixed + m.swing3.spin * r3y * r3y
    platform, link7, rising = m.platform, m.link7, m.link3 + m.platform + 2 * m.link7
    # Momenta of C1 and P along x
    h1, h2 = m.link3 * x1 + link7 * p1, m.link3 * x2 + link7 * p2
    g1, g2, g3 = platform * p1 + link7 * x1, platform * p2 + link7 * x2, platform * p3
    b1, b2 = k2 * (c2 * z1 - s2 * x1), k2 * (c2 * z2 - s2 * x2)
    d1, d2 = k3 * (c3 * z1 - s3 * p1), k3 * (c3 * z2 - s3 * p2)
    return (
        j1 + h1 * x1 + g1 * p1 + platform * q1 * q1 + rising * z1 * z1
        + swing1 * u1 * u1 + swing3 * v1 * v1 + 2 * k1 * c1 * z1,
        h1 * x2 + g1 * p2 + platform * q1 * q2 + rising * z1 * z2
        + swing1 * u1 * u2 + swing3 * v1 * v2 + k1 * c1 * z2 + b1,
        g1 * p3 + platform * q1 * q3 + swing3 * v1 * v3 + d1,
        j2 + h2 * x2 + g2 * p2 + platform * q2 * q2 + rising * z2 * z2
        + swing1 * u2 * u2 + swing3 * v2 * v2 + 2 * b2,
        g2 * p3 + platform * q2 * q3 + swing3 * v2 * v3 + d2,
        j3 + g3 * p3 + platform * q3 * q3 + swing3 * v3 * v3 - 2 * k3 * s3 * p3,
    )  # fmt: skip


def potential(pose: Pose, gravity: Triple, m: Inertia) -> Numbers:
    """Compute the potential energy, J, up to a constant."""
    (c1, c2, c3), (s1, s2, s3), found = pose.cos, pose.sin, pose.found
    (k1, k2, k3), (gx, gy, gz) = m.couples, gravity
    w1, w2, w3 = (weight + couple for weight, couple in zip(m.weights, m.couples, strict=True))
    at_c, at_p = m.link3 + k1 + k2 + m.link7, m.platform + k3 + m.link7
    return -(
        gx * (w2 * c2 + w3 * c3 + at_c * found.x_c + at_p * found.x)
        + gy * (w1 * c1 + at_p * found.y)
        + gz * (w1 * s1 + w2 * s2 + w3 * s3 + at_c * found.z_c + at_p * found.z)
    )


def velocities(pose: Pose, rates: Triple) -> tuple[Numbers, tuple[Triple, Triple, Triple]]:
    """Compute l7 times the angular velocity of link 7, and the rates of the vectors B_iC_i, m/s.

    These velocities follow from the first derivatives of the closures.
    """
    (c1, c2, c3), (s1, s2, s3), (u1, u2, u3), f = pose.cos, pose.sin, rates, pose.factors
    x, z, turn = _resolve(pose, f.leg1 * u1, f.leg2 * u2, f.leg3 * u3)
    px, py = x - f.sin_beta * turn, f.cos_beta * turn
    rod1, rod2 = (x, s1 * u1, z - c1 * u1), (x + s2 * u2, 0.0, z - c2 * u2)
    return turn, (rod1, rod2, (px + s3 * u3, py, z - c3 * u3))


def accelerations(
    pose: Pose,
    rates: Triple,
    changes: Triple,
    turn: Numbers,
    moved: tuple[Triple, Triple, Triple],
) -> tuple[tuple[_Pair, _Pair, _Pair], _Pair, Triple]:
    """Compute accelerations, m/s^2, from the second derivatives of the closures.

    Returns:
        Accelerations of B1 along y and z, of B2 and B3 along x and z, of C1 along x and z, and of
        P.
    """
    (c1, c2, c3), (s1, s2, s3), f = pose.cos, pose.sin, pose.factors
    (_, r1y, r1z), (r2x, _, r2z), (r3x, r3y, r3z) = pose.rods
    (u1, u2, u3), (a1, a2, a3) = rates, changes
    (d1x, d1y, d1z), (d2x, _, d2z), (d3x, d3y, d3z) = moved
    b1y, b1z = -s1 * a1 - c1 * u1 * u1, c1 * a1 - s1 * u1 * u1
    b2x, b2z = -s2 * a2 - c2 * u2 * u2, c2 * a2 - s2 * u2 * u2
    b3x, b3z = -s3 * a3 - c3 * u3 * u3, c3 * a3 - s3 * u3 * u3
    inwards = turn * turn / pose.lengths.l7
    ex, ey = inwards * f.cos_beta, inwards * f.sin_beta
    x, z, turning = _resolve(
        pose,
        r1y * b1y + r1z * b1z - d1x * d1x - d1y * d1y - d1z * d1z,
        r2x * b2x + r2z * b2z - d2x * d2x - d2z * d2z,
        r3x * (b3x + ex) + r3y * ey + r3z * b3z - d3x * d3x - d3y * d3y - d3z * d3z,
    )
    platform = (x - f.sin_beta * turning - ex, f.cos_beta * turning - ey, z)
    return ((b1y, b1z), (b2x, b2z), (b3x, b3z)), (x, z), platform


def _resolve(pose: Pose, h1: Numbers, h2: Numbers, h3: Numbers) -> Triple:
    """Solve B_iC_i . a_i = h_i for the motion of C1 and the rotation of link 7.

    If the results are velocities, a_i is the velocity of C_i. If the results are accelerations, a_i
    is the acceleration of C_i. But a_3 does not include the centripetal acceleration that the
    rotation of link 7 causes.

    Returns:
        Velocity (m/s) or acceleration (m/s^2) of C1 along x and along z; then the angular velocity
        or angular acceleration of link 7 times l7 (m/s or m/s^2).
    """
    (r1x, _, r1z), (r2x, _, r2z), (r3x, _, r3z) = pose.rods
    x, z = (r2z * h1 - r1z * h2) * pose.per_planar, (r1x * h2 - r2x * h1) * pose.per_planar
    return x, z, (h3 - r3x * x - r3z * z) * pose.per_k


def gather(pose: Pose, at_c: _Pair, at_p: Triple) -> Triple:
    """Compute the motor torques (N m) that exert a force at C1 and a force at P.

    Args:
        pose: Configuration.
        at_c: Force at C1 along x and z, N.
        at_p: Force at P, N.
    """
    (r1x, _, r1z), (r2x, _, r2z), (r3x, _, r3z) = pose.rods
    (cx, cz), (px, py, pz), f = at_c, at_p, pose.factors
    rod3 = (f.cos_beta * py - f.sin_beta * px) * pose.per_k  # its force, over l4
    x, z = (cx + px - rod3 * r3x) * pose.per_planar, (cz + pz - rod3 * r3z) * pose.per_planar
    return f.leg1 * (x * r2z - z * r2x), f.leg2 * (z * r1x - x * r1z), f.leg3 * rod3


def velocity(pose: Pose) -> tuple[Triple, Triple, Triple]:
    """Compute the rows of J, m/rad."""
    return equations.velocity(pose.rods, pose.factors)


@dataclass(frozen=True, kw_only=True)
class Dynamics(EquationOfMotion):
    """The dynamics of the TPM; see :class:`EquationOfMotion`.

    Attributes:
        geometry: Link lengths.
        branch: Assembly mode.
    """

    geometry: Geometry = PAPER
    branch: AssemblyMode = DEFAULT_ASSEMBLY

    _formulas: ClassVar = Formulas(build, inertia_of, torques, masses, velocity, potential)

    def __post_init__(self) -> None:
        """Reject lengths and modes of other mechanisms."""
        super().__post_init__()
        if not isinstance(self.geometry, AnyLengths):
            raise InputError("geometry", self.geometry, "a tpm_gym.Geometry")
        require_mode(self.branch, AssemblyMode)

    def _pose(self, theta: Triple, ns: Namespace) -> tuple[Pose, Numbers, Numbers]:
        pose, real = pose_at(theta, self.branch.signs, self.geometry, ns)
        return pose, real, equations.regular(pose.factors, self.geometry)

    def _refusal(self, theta: Vector) -> UnreachableError | SingularityError:
        try:
            jacobian.velocity(theta, self.branch, self.geometry)
        except (UnreachableError, SingularityError) as error:
            return error
        raise AssertionError(theta)
