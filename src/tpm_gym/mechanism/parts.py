"""Sizes and materials of the arms, rods and motors of mechanisms."""

from __future__ import annotations

from dataclasses import replace
from typing import Final, Literal

import numpy as np

from tpm_gym.arrays import Vector
from tpm_gym.mechanism.bodies import ALUMINIUM, LEVEL, STEEL, Joint, Link, Solid
from tpm_gym.mechanism.motor import TORQUE_MOTOR

CARBON_FIBRE = 1600.0  # kg/m^3
SLIDES: Final = ("platform_x", "platform_y", "platform_z")
"""Prismatic joints of :func:`free_platform`; their positions are the coordinates of P, m."""
TURNS: Final = ("platform_roll", "platform_pitch", "platform_yaw")
"""Revolute joints of :func:`free_platform`; their positions are always 0 rad."""
FREE: Final = ("along_x", "along_y", "along_z", "rolling", "pitching")
"""Links of :func:`free_platform` between base and platform."""

_AXES: Final[tuple[Vector, ...]] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_SPECK = 0.005  # m, edge of a cube of 1 kg/m^3: 1e-7 kg, too light to change torques

# Largest angles, rad, by which an arm can turn from pointing level outwards: towards the base, and
# towards the platform.
ARM_RAISED, ARM_LOWERED = np.deg2rad(75.0), np.deg2rad(115.0)


def displaced(axis: str, value: float, centre: Vector = (0.0, 0.0, 0.0)) -> Vector:
    """Displace ``centre`` by ``value`` along ``axis``."""
    x, y, z = (c + value if name == axis else c for name, c in zip("xyz", centre, strict=True))
    return x, y, z


def tube(axis: Literal["x", "y"], length: float, height: float, width: float, wall: float) -> Solid:
    """Build a rectangular aluminium tube from the link's origin along ``axis``; sizes in m."""
    outer = (length, width, height) if axis == "x" else (width, length, height)
    inner, low = width - 2 * wall, height - 2 * wall
    bore = (length, inner, low) if axis == "x" else (inner, length, low)
    return Solid("box", outer, displaced(axis, length / 2), ALUMINIUM, bore=bore, colour="orange")


def bar(
    axis: Literal["x", "y", "z"],
    half: float,
    radius: float = 0.008,
    centre: Vector = (0.0, 0.0, 0.0),
    colour: str = "steel",
    density: float = ALUMINIUM,
) -> Solid:
    """Build a round solid bar of half length ``half`` about ``centre``."""
    return Solid("cylinder", (radius, 2 * half, 0.0), centre, density, axis=axis, colour=colour)


def load(payload: float, centre: Vector) -> tuple[Solid, ...]:
    """Build a steel cube of ``payload`` (kg) in a gripper; nothing for 0 kg."""
    edge = (payload / STEEL) ** (1 / 3)
    return (Solid("box", (edge, edge, edge), centre, STEEL, colour="red"),) if payload else ()


def rod(axis: Literal["x", "y"], length: float) -> tuple[Solid, ...]:
    """Build a carbon-fibre tube (diameter 16 mm, wall 1.5 mm) with steel rod ends."""
    fibre = bar(axis, length / 2, 0.008, displaced(axis, length / 2), "carbon", CARBON_FIBRE)
    ends = (
        bar(axis, 0.008, 0.009, displaced(axis, at), density=STEEL)
        for at in (0.008, length - 0.008)
    )
    return (replace(fibre, bore=(0.0065, length, 0.0)), *ends)


def motor(
    name: str, axis: Vector, origin: Vector, level: float, sense: int, rpy: Vector = LEVEL
) -> Joint:
    """Build the joint of a motor.

    The motor's arm points outwards at theta = ``level``. ``sense`` (1 or -1) is the direction of
    theta in which the arm turns towards the platform.
    """
    lower, upper = sorted((level - sense * ARM_RAISED, level + sense * ARM_LOWERED))
    line = TORQUE_MOTOR.peak_torque, TORQUE_MOTOR.no_load_speed, TORQUE_MOTOR.corner_speed
    return Joint(name, "revolute", "base", origin, axis, lower, upper, *line, rpy)


def saddles(axis: Literal["x", "y"], centre: Vector) -> list[Solid]:
    """Build the boxes that fix a motor's two housings to the base; the motor is along ``axis``."""
    size = (0.06, 0.12, 0.09) if axis == "x" else (0.12, 0.06, 0.09)
    middles = (displaced("z", -0.06, half) for half in TORQUE_MOTOR.halves(axis, centre))
    return [Solid("box", size, middle, ALUMINIUM, colour="white") for middle in middles]


def arm(axis: Literal["x", "y"], across: Literal["x", "y"], length: float) -> tuple[Solid, ...]:
    """Build an arm: the motor's shaft and rotor, a rectangular tube, and a bar across the elbow."""
    shaft = bar(across, TORQUE_MOTOR.reach, 0.022, density=STEEL)
    return (
        shaft,
        *TORQUE_MOTOR.rotor(across),
        tube(axis, length, 0.045, 0.030, 0.003),
        bar(across, 0.02, 0.015, displaced(axis, length)),
    )


def free_platform(solids: tuple[Solid, ...], reach: float) -> list[Link]:
    """Build a platform that belongs to no leg; its origin is P.

    Three slides and three revolutes, with almost no mass between them, let it move freely. So every
    leg can end in loop closures, and every closure connects two branches of the tree. PyBullet's
    direct solver needs this. ``reach`` is the largest distance from the base's origin to P, m.
    """
    speck = Solid("box", (_SPECK,) * 3, LEVEL, 1.0, colour="yellow")
    links, parent = [], "base"
    for name, joint, axis in zip((*FREE, "platform"), (*SLIDES, *TURNS), _AXES * 2, strict=True):
        held = Joint(joint, "continuous", parent, LEVEL, axis)
        if joint in SLIDES:
            held = replace(held, kind="prismatic", lower=-reach, upper=reach)
        links.append(Link(name, solids if name == "platform" else (speck,), held))
        parent = name
    return links
