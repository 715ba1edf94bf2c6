"""The mechanism from a Geometry: links, joints, inertias and loop closures.

Some physics engines need a tree of links, so the loops are cut. The spanning tree, with the links
numbered as in the paper (Fig. 1), is:

    base 0 - arm 2  - two rods 4                                        (branch I, the 4S rods)
    base 0 - arm 5  - rod 6 - link 3' - link 7 - platform 1 - end link 10   (branch II, platform)
    base 0 - arm 12 - end link 9 - two rods 11                          (branch III)

Four ball joints close the loops. They connect the far ends of rods 4 to link 3', and the far ends
of rods 11 to end link 10. A rod with a ball joint at both ends could spin about its own axis. So
rods 4 have a universal joint at the arm instead. Rods 11 turn on the paper's revolutes R_e and R_f.
R_g and R_h are ball joints here, since revolutes would add redundant constraints. So end link 10, a
straight bar through these two ball joints, can roll about its own axis.

When all joints are at zero, all frames are parallel to the machine's frame, and arms and rods point
along +y (branch I) or +x (branches II, III). Units: metres, radians, kilograms.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, Vector, vector
from tpm_gym.errors import InputError
from tpm_gym.kinematics import DEFAULT_ASSEMBLY, AssemblyMode, equations
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.kinematics.modes import ROTATED_MODES, RotatedMode
from tpm_gym.kinematics.namespaces import NUMPY
from tpm_gym.kinematics.position import assembled
from tpm_gym.kinematics.rotated import RotatedPostures, forward_rotated
from tpm_gym.mechanism import parts
from tpm_gym.mechanism.bodies import ALUMINIUM, STEEL, Closure, Joint, Link, Mechanism, Solid
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.motor import TORQUE_MOTOR

ACTUATED_JOINTS = ("R11", "R21", "R31")
"""Joints of the motors, in the order of theta_1, theta_2, theta_3."""


def _base(g: Geometry) -> Link:
    """Build base 0, a plate with a motor at each pivot; it never moves, so its mass is not used."""
    # High enough that the motors fit below it, and small enough that the arms pass it.
    plate = Solid("cylinder", (g.l1, 0.02, 0.0), (0.0, 0.0, -0.105), ALUMINIUM, colour="white")
    pivots: tuple[tuple[Literal["x", "y"], Vector], ...] = (
        ("x", (0.0, g.l1, 0.0)),
        ("y", (-g.l1, 0.0, 0.0)),
        ("y", (g.l1, 0.0, 0.0)),
    )
    motors = [solid for axis, at in pivots for solid in TORQUE_MOTOR.stator(axis, at)]
    saddles = [solid for axis, at in pivots for solid in parts.saddles(axis, at)]
    return Link("base", (plate, *saddles, *motors))


def _branch_1(g: Geometry) -> tuple[Link, ...]:
    """Build arm 2 with short link 3, and the two rods 4 of the 4S parallelogram."""
    short_link = parts.bar("x", g.l5, 0.010, (0.0, g.l3, 0.0))
    arm = Link(
        "arm_2",
        (*parts.arm("y", "x", g.l3), short_link),
        parts.motor("R11", (1.0, 0.0, 0.0), (0.0, g.l1, 0.0), level=0.0, sense=1),
    )
    links = [arm]
    for suffix, ball, side in (("a", "Sa", 1), ("b", "Sb", -1)):
        origin, cross = (side * g.l5, g.l3, 0.0), f"cross_4{suffix}"
        swing = Joint(f"{ball}_swing", "continuous", "arm_2", origin, (1.0, 0.0, 0.0))
        tilt = Joint(f"{ball}_tilt", "continuous", cross, (0.0, 0.0, 0.0), (0.0, 0.0, -1.0))
        links.append(Link(cross, (parts.bar("z", 0.010, 0.009, density=STEEL),), swing))
        links.append(Link(f"rod_4{suffix}", parts.rod("y", g.l4), tilt))
    return tuple(links)


def _branch_2(g: Geometry, payload: float) -> tuple[Link, ...]:
    """Build arm 5, rod 6, link 3', link 7, platform 1, its sliding cup, and end link 10."""
    minus_y, point_p = (0.0, -1.0, 0.0), (g.l2, 0.0, g.l6)
    # From F1 to D3
    plate = Solid("box", (2 * g.l2 + 0.04, 0.045, 0.008), point_p, ALUMINIUM, colour="yellow")
    tube, bore = (3 * g.l5, 0.025, 0.018), (3 * g.l5, 0.019, 0.012)
    link_3p = (
        Solid("box", tube, (1.5 * g.l5, 0.0, 0.0), ALUMINIUM, bore=bore, colour="blue"),
        parts.bar("y", 0.016, 0.011, density=STEEL),
    )
    link_7 = (
        Solid("box", (g.l7, 0.020, 0.008), (g.l7 / 2, 0.0, 0.0), ALUMINIUM, colour="light"),
        parts.bar("z", 0.008, 0.011, density=STEEL),
        parts.bar("z", 0.008, 0.011, (g.l7, 0.0, 0.0), density=STEEL),
    )
    return (
        Link(
            "arm_5",
            parts.arm("x", "y", g.l3),
            parts.motor("R21", minus_y, (-g.l1, 0.0, 0.0), np.pi, -1),
        ),
        Link(
            "rod_6",
            parts.rod("x", g.l4),
            Joint("R22", "continuous", "arm_5", (g.l3, 0.0, 0.0), minus_y),
        ),
        Link("link_3p", link_3p, Joint("R23", "continuous", "rod_6", (g.l4, 0.0, 0.0), minus_y)),
        Link("link_7", link_7, Joint("R12", "continuous", "link_3p", (2 * g.l5, 0.0, g.l6))),
        Link(
            "platform",
            (plate, CUP.stem(point_p), *parts.load(payload, point_p)),
            Joint("R13", "continuous", "link_7", (g.l7, 0.0, 0.0)),
        ),
        CUP.link("platform", point_p),
        Link(
            "end_link_10",
            (parts.bar("y", g.l5 + 0.01, 0.007),),
            Joint("R33", "continuous", "platform", (2 * g.l2, 0.0, 0.0), minus_y),
        ),
    )


def _branch_3(g: Geometry) -> tuple[Link, ...]:
    """Build arm 12, end link 9, and the two rods 11 of the second parallelogram."""
    minus_y, plus_z = (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)
    arm = Link(
        "arm_12", parts.arm("x", "y", g.l3), parts.motor("R31", minus_y, (g.l1, 0.0, 0.0), 0.0, 1)
    )
    end_link = Link(
        "end_link_9",
        (parts.bar("y", g.l5 + 0.01, 0.008),),
        Joint("R32", "continuous", "arm_12", (g.l3, 0.0, 0.0), minus_y),
    )
    rods = tuple(
        Link(
            f"rod_11{suffix}",
            parts.rod("x", g.l4),
            Joint(name, "continuous", "end_link_9", (0.0, side * g.l5, 0.0), plus_z),
        )
        for suffix, name, side in (("a", "Re", 1), ("b", "Rf", -1))
    )
    return (arm, end_link, *rods)


def build(geometry: Geometry = PAPER, payload: float = 0.0) -> Mechanism:
    """Build the mechanism for the given lengths, with a steel cube of ``payload`` (kg) around P.

    Cross-sections and materials do not scale with the lengths. They fit a machine of the size of
    the paper's case study.
    """
    g = geometry
    links = (_base(g), *_branch_1(g), *_branch_2(g, payload), *_branch_3(g))
    closures = (
        Closure("Sc", "rod_4a", (0.0, g.l4, 0.0), "link_3p", (3 * g.l5, 0.0, 0.0)),
        Closure("Sd", "rod_4b", (0.0, g.l4, 0.0), "link_3p", (g.l5, 0.0, 0.0)),
        Closure("Rg", "rod_11a", (g.l4, 0.0, 0.0), "end_link_10", (0.0, g.l5, 0.0)),
        Closure("Rh", "rod_11b", (g.l4, 0.0, 0.0), "end_link_10", (0.0, -g.l5, 0.0)),
    )
    return Mechanism(
        links=links,
        closures=closures,
        platform="platform",
        point_p=(g.l2, 0.0, g.l6),
        tool="cup",
        lip=CUP.lip,
        actuated=ACTUATED_JOINTS,
        name="tpm",
    )


def joint_angles(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> dict[str, float]:
    """Compute the joint angles (rad) of :func:`build` by name, such that all loops are closed.

    The cup's slide is at 0 m.

    Raises:
        InputError: If theta (3,) rad has the wrong shape or is not finite.
        UnreachableError: If the assembly mode ``branch`` does not exist at theta.
    """
    angles = joint_arrays(vector("theta", theta), branch, geometry)
    return {name: float(angle) for name, angle in angles.items()}


def joint_arrays(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> dict[str, FloatArray]:
    """Compute the angles (...,) of all joints for theta (..., 3); see :func:`joint_angles`."""
    solutions, slot = assembled(theta, branch, geometry), branch.index
    one, two, three = np.moveaxis(np.asarray(theta, dtype=np.float64), -1, 0)
    beta = solutions.beta[..., slot]
    x, y, z = np.moveaxis(solutions.position[..., slot, :], -1, 0)
    x_c, z_c = np.moveaxis(solutions.link3[..., slot, :], -1, 0)
    found = equations.Assembly(x, y, z, x_c, z_c, np.cos(beta), np.sin(beta))
    cos, sin = equations.arms((one, two, three), geometry, NUMPY)
    rod4, rod6, rod11 = equations.rods(cos, sin, found, geometry)
    return _by_joint((one, two, three), (rod4, rod4, rod6, rod11), beta, geometry)


def rotated_joint_angles(
    theta: ArrayLike, branch: RotatedMode, geometry: Geometry = PAPER
) -> dict[str, float]:
    """Compute the angles of all joints, rad, in an assembly mode of the rotated operation mode.

    Raises:
        InputError: If theta has the wrong shape or is not finite, or if the assembly mode
            ``branch`` does not exist at theta.
    """
    angles = vector("theta", theta)
    found, slot = forward_rotated(angles, geometry), branch.index
    if not found.valid[slot]:
        real = [str(mode) for mode in ROTATED_MODES if found.valid[mode.index]]
        raise InputError("branch", branch, f"one that exists at theta: {', '.join(real) or 'none'}")
    joints = rotated_joint_arrays(found)
    return {name: float(angles[slot]) for name, angles in joints.items()}


def rotated_joint_arrays(postures: RotatedPostures) -> dict[str, FloatArray]:
    """Compute the angles (...,) rad of all joints in postures (...,) of the rotated mode."""
    one, two, three = np.moveaxis(postures.theta, -1, 0)
    rods = [(x, y, z) for x, y, z in np.moveaxis(postures.rods, (-2, -1), (0, 1))]
    return _by_joint((one, two, three), rods, postures.beta, postures.geometry, postures.tilt)


def _by_joint(
    theta: equations.Triple,
    rods: Sequence[equations.Triple],
    beta: FloatArray,
    g: Geometry,
    turn: FloatArray | float = 0.0,
) -> dict[str, FloatArray]:
    """Compute the angles of all joints, rad, from the vectors along the rods.

    A swing is the angle of a rod in the plane of its arm, and a tilt is the rod's elevation out of
    this plane. A joint angle is a link's angle minus its parent's.

    Args:
        theta: Angles of the motors, rad.
        rods: Vectors (x, y, z) along rods 4a, 4b, 6 and 11, m.
        beta: Angle of link 7 about z, rad.
        turn: Rotation of link 3' and the platform about y, rad. Joints R23 and R33 turn about
            -y.
    """
    theta_1, theta_2, theta_3 = theta
    (x_4a, y_4a, z_4a), (x_4b, y_4b, z_4b), (x_6, _, z_6), (x_11, y_11, z_11) = rods
    swing_6, swing_11 = np.arctan2(z_6, x_6), np.arctan2(z_11, x_11)
    tilt_11 = NUMPY.arcsin(y_11 / g.l4)
    return {
        "R11": theta_1,
        "Sa_swing": np.arctan2(z_4a, y_4a) - theta_1,
        "Sa_tilt": NUMPY.arcsin(x_4a / g.l4),
        "Sb_swing": np.arctan2(z_4b, y_4b) - theta_1,
        "Sb_tilt": NUMPY.arcsin(x_4b / g.l4),
        "R21": theta_2,
        "R22": swing_6 - theta_2,
        "R23": -swing_6 - turn,
        "R12": beta,
        "R13": -beta,
        "cup_slide": 0.0 * theta_1,
        "R33": swing_11 + turn,  # end links 9 and 10 stay parallel
        "R31": theta_3,
        "R32": swing_11 - theta_3,
        "Re": tilt_11,
        "Rf": tilt_11,
    }
