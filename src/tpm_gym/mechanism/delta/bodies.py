"""Links, joints and loop closures of a Delta, its inertias, and the angles of its passive joints.

A universal joint, with a small cross, connects a rod to its arm, so that the rod cannot spin freely
about its own axis. A ball joint connects the rod to the platform and closes a loop. The platform
belongs to no leg (:func:`tpm_gym.mechanism.parts.free_platform`). When all joints are at zero, the
frames of an arm, its crosses and its rods have x along the arm and y along the motor's axis. The
frame of the platform is parallel to the base's frame.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from tpm_gym.arrays import Vector
from tpm_gym.kinematics.equations import Triple
from tpm_gym.kinematics.namespaces import Numbers
from tpm_gym.mechanism import parts
from tpm_gym.mechanism.bodies import ALUMINIUM, STEEL, Closure, Joint, Link, Mechanism, Solid
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.delta.equations import ONE, THREE, TWO, Pair, Pose, outwards
from tpm_gym.mechanism.delta.geometry import DeltaGeometry
from tpm_gym.mechanism.inertia import Bodies, X, Y, three
from tpm_gym.mechanism.motor import TORQUE_MOTOR

LEGS: Final = {1: ONE, 2: TWO, 3: THREE}
SIDES: Final = {"a": 1.0, "b": -1.0}
_MINUS_Y, _PLUS_Z, _ORIGIN = (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)


class Inertia(NamedTuple):
    """Constants of the dynamics; a, b, ``fixed``, ``spin``: see :mod:`tpm_gym.mechanism.inertia`.

    Attributes:
        motors: For each leg, moment of inertia about the motor's axis, kg m^2. It is the sum for
            the arm and for masses at B_i: the crosses, and the constants a of the rods.
        weights: For each leg, mass at B_i minus the leg's entry of ``couples``, kg.
        couples: For each leg, sum of the constants b of its two rods B_iC_i, kg.
        platform: Mass at P, kg.
        fixed: For each leg, moment of inertia of its crosses about the axis of their swing, kg m^2.
        spin: For each leg, moment of inertia of the rods about their own axes, divided by
            l4^2, kg.
    """

    motors: Triple
    weights: Triple
    couples: Triple
    platform: Numbers
    fixed: Triple
    spin: Triple


def build(g: DeltaGeometry, payload: float = 0.0) -> Mechanism:
    """Build the mechanism with a payload (kg); cross-sections and materials are as in the TPM."""
    links, closures = [_base(g)], []
    for number, leg in LEGS.items():
        links += _leg(number, leg, g)
        for suffix, side in SIDES.items():
            name, end = f"{number}{suffix}", outwards(leg, (g.l2, side * g.l5, 0.0))
            closures.append(Closure(f"S{name}", f"rod_{name}", (g.l4, 0.0, 0.0), "platform", end))
    return Mechanism(
        links=(*links, *_platform(g, payload)),
        closures=tuple(closures),
        platform="platform",
        point_p=_ORIGIN,
        tool="cup",
        lip=CUP.lip,
        actuated=("R1", "R2", "R3"),
        name="delta",
    )


def joint_positions(pose: Pose, theta: Vector, l4: float) -> dict[str, float]:
    """Compute the positions of all joints, rad or m, from a configuration and its theta, rad."""
    found = {"cup_slide": 0.0} | dict.fromkeys(parts.TURNS, 0.0)
    found |= dict(zip(parts.SLIDES, map(float, pose.position), strict=True))
    for number, angle, (x, y, z) in zip(LEGS, theta, pose.rods, strict=True):
        found[f"R{number}"] = angle
        for suffix in SIDES:
            found[f"swing_{number}{suffix}"] = math.atan2(z, x) - angle
            found[f"tilt_{number}{suffix}"] = math.asin(max(-1.0, min(1.0, y / l4)))
    return found


def inertia_of(bodies: Bodies, g: DeltaGeometry) -> Inertia:
    """Compute the constants from the bodies of :func:`build`."""
    motors, weights, couples, fixed, spin = (np.zeros(3) for _ in range(5))
    platform = sum(bodies.mass(name) for name in ("platform", "cup", *parts.FREE))
    for i, number in enumerate(LEGS):
        _, couple, far = bodies.bar(f"arm_{number}", X, Y, g.l3)
        motors[i], weights[i] = far, couple + far
        for suffix in SIDES:
            near, between, end = bodies.round_bar(f"rod_{number}{suffix}", X, g.l4)
            mass, moment = bodies.shaft(f"cross_{number}{suffix}", Y)
            motors[i] += near + mass
            weights[i] += near + mass
            couples[i] += between
            platform += end
            fixed[i] += moment
            spin[i] += bodies.moment(f"rod_{number}{suffix}", X) / g.l4**2
    bodies.require_all_known()
    motors *= g.l3**2
    return Inertia(
        three(motors), three(weights), three(couples), platform, three(fixed), three(spin)
    )


def _base(g: DeltaGeometry) -> Link:
    """Build the base, a plate with a motor at each pivot; it never moves."""
    plate = Solid(
        "cylinder", (g.l1 + 0.05, 0.02, 0.0), (0.0, 0.0, -0.105), ALUMINIUM, colour="white"
    )
    pivot = (g.l1, 0.0, 0.0)
    housed = (*parts.saddles("y", pivot), *TORQUE_MOTOR.stator("y", pivot))
    return Link(
        "base", (plate, *(_turned(solid, leg) for leg in LEGS.values() for solid in housed))
    )


def _leg(number: int, leg: Pair, g: DeltaGeometry) -> list[Link]:
    """Build an arm with a short link across its end, two crosses and two rods."""
    arm, pivot = f"arm_{number}", outwards(leg, (g.l1, 0.0, 0.0))
    across = parts.bar("y", g.l5, 0.010, (g.l3, 0.0, 0.0))
    motor = parts.motor(f"R{number}", _MINUS_Y, pivot, level=0.0, sense=1, rpy=_yaw(leg))
    links = [Link(arm, (*parts.arm("x", "y", g.l3), across), motor)]
    for suffix, side in SIDES.items():
        name, cross = f"{number}{suffix}", f"cross_{number}{suffix}"
        elbow = (g.l3, side * g.l5, 0.0)
        swing = Joint(f"swing_{name}", "continuous", arm, elbow, _MINUS_Y)
        tilt = Joint(f"tilt_{name}", "continuous", cross, _ORIGIN, _PLUS_Z)
        pin = parts.bar("z", 0.010, 0.009, density=STEEL)
        links.append(Link(cross, (pin,), swing))
        links.append(Link(f"rod_{name}", parts.rod("x", g.l4), tilt))
    return links


def _platform(g: DeltaGeometry, payload: float) -> list[Link]:
    """Build platform and cup."""
    plate = Solid("cylinder", (g.l2 + 0.015, 0.008, 0.0), _ORIGIN, ALUMINIUM, colour="yellow")
    bar = parts.bar("y", g.l5 + 0.01, 0.007, (g.l2, 0.0, 0.0))
    bars = (_turned(bar, leg) for leg in LEGS.values())
    solids = (plate, *bars, CUP.stem(_ORIGIN), *parts.load(payload, _ORIGIN))
    free = parts.free_platform(solids, 10 * (g.l1 + g.l3 + g.l4))
    return [*free, CUP.link("platform", _ORIGIN)]


def _yaw(leg: Pair) -> Vector:
    return (0.0, 0.0, math.atan2(leg[1], leg[0]))


def _turned(solid: Solid, leg: Pair) -> Solid:
    """Turn a solid of leg 1 about z to another leg."""
    return replace(solid, centre=outwards(leg, solid.centre), rpy=_yaw(leg))
