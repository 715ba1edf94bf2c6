"""The links of the mechanism: what each is made of, and the joint on which it hangs.

Sections and materials are those of a machine of the size of the paper's case study. All frames are
parallel to the paper frame when all joints are at zero (see :mod:`tpm_gym.mechanism.tree`).
Units: metres, radians, kilograms.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from tpm_gym.kinematics.geometry import Geometry
from tpm_gym.mechanism.bodies import Joint, Link, Solid, Vector

__all__ = [
    "CUP_LENGTH",
    "CUP_PRELOAD",
    "CUP_RADIUS",
    "CUP_STROKE",
    "MOTOR_EFFORT",
    "MOTOR_SPEED",
    "base",
    "branch_1",
    "branch_2",
    "branch_3",
]

# Materials, kg/m^3.
ALUMINIUM, STEEL, CARBON_FIBRE, SILICONE = 2700.0, 7850.0, 1600.0, 1150.0

# Direct-drive torque motors of the class used in light delta robots: peak torque and speed.
MOTOR_EFFORT = 100.0  # N m
MOTOR_SPEED = 12.0  # rad/s
# How far each arm may turn from pointing level outwards, towards the base and the platform.
ARM_RAISED, ARM_LOWERED = np.deg2rad(75.0), np.deg2rad(115.0)

CUP_LENGTH = 0.040
"""From point P of the platform to the lip of the vacuum cup, m."""
CUP_RADIUS = 0.008
"""Radius of the lip of the vacuum cup, m."""
CUP_STROKE = 0.020
"""How far the cup slides back into its stem when it meets something, m."""
CUP_PRELOAD = 15.0
"""Force with which the spring keeps the cup out, N: more than the vacuum can hold."""
_BELLOWS = 0.015  # length of the cup's bellows, m


_ALONG: dict[str, int] = {"x": 0, "y": 1, "z": 2}


def _vector(axis: str, value: float, centre: Vector = (0.0, 0.0, 0.0)) -> Vector:
    """``centre`` displaced by ``value`` along ``axis``."""
    moved = list(centre)
    moved[_ALONG[axis]] += value
    return (moved[0], moved[1], moved[2])


def _tube(
    axis: Literal["x", "y"], length: float, height: float, width: float, wall: float
) -> Solid:
    """A rectangular aluminium tube from the link's origin along ``axis``."""
    outer = (length, width, height) if axis == "x" else (width, length, height)
    inner = tuple(edge if i == _ALONG[axis] else edge - 2 * wall for i, edge in enumerate(outer))
    return Solid(
        "box",
        outer,
        _vector(axis, length / 2),
        ALUMINIUM,
        bore=(inner[0], inner[1], inner[2]),
        colour="orange",
    )


def _bar(
    axis: Literal["x", "y", "z"],
    half: float,
    radius: float = 0.008,
    centre: Vector = (0.0, 0.0, 0.0),
    colour: str = "steel",
    density: float = ALUMINIUM,
) -> Solid:
    """A round solid bar of half length ``half`` about ``centre``."""
    return Solid("cylinder", (radius, 2 * half, 0.0), centre, density, axis=axis, colour=colour)


def _rod(axis: Literal["x", "y"], length: float) -> tuple[Solid, ...]:
    """A carbon-fibre tube, 16 mm by 1.5 mm, with a steel rod end at both ends."""
    tube = Solid(
        "cylinder",
        (0.008, length, 0.0),
        _vector(axis, length / 2),
        CARBON_FIBRE,
        bore=(0.0065, length, 0.0),
        axis=axis,
        colour="carbon",
    )
    ends = tuple(
        _bar(axis, 0.008, 0.009, _vector(axis, at), density=STEEL) for at in (0.008, length - 0.008)
    )
    return (tube, *ends)


def _motor(name: str, axis: Vector, origin: Vector, level: float, sense: int) -> Joint:
    """A motor whose arm points level outwards at ``level`` and lowers in the ``sense`` of theta."""
    lower, upper = sorted((level - sense * ARM_RAISED, level + sense * ARM_LOWERED))
    return Joint(name, "revolute", "base", origin, axis, lower, upper, MOTOR_EFFORT, MOTOR_SPEED)


def base(g: Geometry) -> Link:
    """Base 0: a plate with a motor at each pivot. Its mass does not matter, it never moves."""
    plate = Solid(
        "cylinder", (g.l1 + 0.06, 0.02, 0.0), (0.0, 0.0, -0.07), ALUMINIUM, colour="white"
    )
    motors = (
        _bar("x", 0.055, 0.042, (0.0, g.l1, 0.0), "dark"),
        _bar("y", 0.055, 0.042, (-g.l1, 0.0, 0.0), "dark"),
        _bar("y", 0.055, 0.042, (g.l1, 0.0, 0.0), "dark"),
    )
    brackets = tuple(
        Solid("box", (0.08, 0.08, 0.05), (x, y, -0.04), ALUMINIUM, colour="white")
        for x, y in ((0.0, g.l1), (-g.l1, 0.0), (g.l1, 0.0))
    )
    return Link("base", (plate, *brackets, *motors))


def _arm(axis: Literal["x", "y"], across: Literal["x", "y"], g: Geometry) -> tuple[Solid, ...]:
    """An actuated arm: hub with the motor's rotor, rectangular tube, elbow bar across."""
    hub = _bar(across, 0.058, 0.022, colour="steel", density=STEEL)
    return (
        hub,
        _tube(axis, g.l3, 0.045, 0.030, 0.003),
        _bar(across, 0.02, 0.015, _vector(axis, g.l3)),
    )


def branch_1(g: Geometry) -> tuple[Link, ...]:
    """Arm 2 with short link 3, and the two rods 4 of the 4S parallelogram."""
    short_link = _bar("x", g.l5, 0.010, (0.0, g.l3, 0.0))
    arm = Link(
        "arm_2",
        (*_arm("y", "x", g), short_link),
        _motor("R11", (1.0, 0.0, 0.0), (0.0, g.l1, 0.0), level=0.0, sense=1),
    )
    links = [arm]
    for suffix, ball, side in (("a", "Sa", 1), ("b", "Sb", -1)):
        cross = Link(
            f"cross_4{suffix}",
            (_bar("z", 0.010, 0.009, density=STEEL),),
            Joint(
                f"{ball}_swing", "continuous", "arm_2", (side * g.l5, g.l3, 0.0), (1.0, 0.0, 0.0)
            ),
        )
        rod = Link(
            f"rod_4{suffix}",
            _rod("y", g.l4),
            Joint(f"{ball}_tilt", "continuous", cross.name, (0.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
        )
        links += [cross, rod]
    return tuple(links)


def branch_2(g: Geometry) -> tuple[Link, ...]:
    """Arm 5, rod 6, link 3', link 7, platform 1, the cup that slides in it, end link 10."""
    minus_y = (0.0, -1.0, 0.0)
    link_3p = (
        Solid(
            "box",
            (3 * g.l5, 0.025, 0.018),
            (1.5 * g.l5, 0.0, 0.0),
            ALUMINIUM,
            bore=(3 * g.l5, 0.019, 0.012),
            colour="blue",
        ),
        _bar("y", 0.016, 0.011, density=STEEL),
    )
    link_7 = (
        Solid("box", (g.l7, 0.020, 0.008), (g.l7 / 2, 0.0, 0.0), ALUMINIUM, colour="yellow"),
        _bar("z", 0.008, 0.011, density=STEEL),
        _bar("z", 0.008, 0.011, (g.l7, 0.0, 0.0), density=STEEL),
    )
    return (
        Link("arm_5", _arm("x", "y", g), _motor("R21", minus_y, (-g.l1, 0.0, 0.0), np.pi, -1)),
        Link(
            "rod_6", _rod("x", g.l4), Joint("R22", "continuous", "arm_5", (g.l3, 0.0, 0.0), minus_y)
        ),
        Link("link_3p", link_3p, Joint("R23", "continuous", "rod_6", (g.l4, 0.0, 0.0), minus_y)),
        Link("link_7", link_7, Joint("R12", "continuous", "link_3p", (2 * g.l5, 0.0, g.l6))),
        Link("platform", _platform(g), Joint("R13", "continuous", "link_7", (g.l7, 0.0, 0.0))),
        _cup(g),
        Link(
            "end_link_10",
            (_bar("y", g.l5 + 0.01, 0.007),),
            Joint("R33", "continuous", "platform", (2 * g.l2, 0.0, 0.0), minus_y),
        ),
    )


def _platform(g: Geometry) -> tuple[Solid, ...]:
    """Platform 1: a plate from F1 to D3 and the stem in which the cup slides."""
    point_p = (g.l2, 0.0, g.l6)
    stem = CUP_LENGTH - _BELLOWS
    return (
        Solid("box", (2 * g.l2 + 0.04, 0.045, 0.008), point_p, ALUMINIUM, colour="light"),
        _bar("z", stem / 2, 0.005, _vector("z", stem / 2, point_p)),
    )


def _cup(g: Geometry) -> Link:
    """The vacuum cup on its plunger, a level compensator: a spring pushes it out of the stem."""
    bellows = Solid(
        "cylinder",
        (CUP_RADIUS, _BELLOWS, 0.0),
        (0.0, 0.0, CUP_LENGTH - _BELLOWS / 2),
        SILICONE,
        colour="red",
        collides=True,
    )
    plunger = _bar("z", 0.02, 0.003, (0.0, 0.0, CUP_LENGTH - 0.02), density=STEEL)
    # The stop lies a millimetre beyond the rest position, or the engine would let them fight.
    slide = Joint(
        "cup_slide",
        "prismatic",
        "platform",
        (g.l2, 0.0, g.l6),
        lower=-CUP_STROKE,
        upper=0.001,
        effort=CUP_PRELOAD,
        speed=1.0,
    )
    return Link("cup", (bellows, plunger), slide)


def branch_3(g: Geometry) -> tuple[Link, ...]:
    """Arm 12, end link 9, and the two rods 11 of the second parallelogram."""
    minus_y, plus_z = (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)
    arm = Link("arm_12", _arm("x", "y", g), _motor("R31", minus_y, (g.l1, 0.0, 0.0), 0.0, 1))
    end_link = Link(
        "end_link_9",
        (_bar("y", g.l5 + 0.01, 0.008),),
        Joint("R32", "continuous", "arm_12", (g.l3, 0.0, 0.0), minus_y),
    )
    rods = tuple(
        Link(
            f"rod_11{suffix}",
            _rod("x", g.l4),
            Joint(name, "continuous", "end_link_9", (0.0, side * g.l5, 0.0), plus_z),
        )
        for suffix, name, side in (("a", "Re", 1), ("b", "Rf", -1))
    )
    return (arm, end_link, *rods)
