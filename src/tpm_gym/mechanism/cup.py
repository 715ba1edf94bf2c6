"""The vacuum cup below the platform: its size, its spring, and what it can hold.

Engines simulate it; :func:`sealed` says, for all of them, when it can hold an object.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from tpm_gym.arrays import Vector, rotate
from tpm_gym.mechanism.bodies import ALUMINIUM, STEEL, Joint, Link, Solid

__all__ = ["CUP", "VacuumCup", "sealed"]

_SILICONE = 1150.0  # kg/m^3


class VacuumCup(NamedTuple):
    """A cup on a spring-loaded plunger, a level compensator.

    Attributes:
        length: From point P of the platform to the lip, m.
        radius: Radius of the lip, m.
        bellows: Length of the part of that radius, m.
        stroke: How far the cup slides back into its stem when it meets something, m.
        preload: Force with which the spring keeps the cup out, N: more than the vacuum can hold.
        vacuum: How far below the ambient's the ejector gets the pressure in the cup, Pa.
        area: On which the vacuum acts, m^2: what lies within the lip.
        evacuation_time: Time constant with which the vacuum builds up once the cup is sealed, s.
            An ejector of 5 l/min empties a cup and hose of 1.6 cm^3 so.
        venting_time: The same when air comes in, through the valve or below the lip, s.
        least_vacuum: At which the lip comes off when the vacuum is off, Pa.
        friction: Of the open lip, times an object's is the Coulomb coefficient between them.
        seal_friction: Coulomb coefficient of the sealed lip: clean silicone on something smooth,
            the best there is. Makers of cups reckon with 0.5 for dry metal, glass or wood.
        seal_gap: Largest distance between lip and object at which the vacuum seals, m.
        seal_tilt: Largest angle between the cup's axis and the object's that the lip follows, rad.
    """

    length: float = 0.040
    radius: float = 0.008
    bellows: float = 0.015
    stroke: float = 0.020
    preload: float = 15.0
    vacuum: float = 60e3
    area: float = 200e-6
    evacuation_time: float = 0.020
    venting_time: float = 0.010
    least_vacuum: float = 3e3
    friction: float = 0.5
    seal_friction: float = 1.0
    seal_gap: float = 0.002
    seal_tilt: float = math.radians(10.0)

    @property
    def pull_off(self) -> float:
        """Largest force that the whole vacuum holds, in any direction but up, N."""
        return self.vacuum * self.area

    @property
    def lip(self) -> Vector:
        """Centre of the lip in the cup's frame, m."""
        return (0.0, 0.0, self.length)

    def stem(self, point_p: Vector) -> Solid:
        """The tube below point P (m, in the platform's frame) in which the cup slides."""
        x, y, z = point_p
        half = (self.length - self.bellows) / 2
        size = (0.005, 2 * half, 0.0)
        return Solid("cylinder", size, (x, y, z + half), ALUMINIUM, colour="steel")

    def link(self, platform: str, point_p: Vector) -> Link:
        """The cup as a link that slides in the platform of that name."""
        bellows = Solid(
            "cylinder",
            (self.radius, self.bellows, 0.0),
            (0.0, 0.0, self.length - self.bellows / 2),
            _SILICONE,
            colour="red",
            collides=True,
        )
        plunger = Solid(
            "cylinder", (0.003, 0.04, 0.0), (0.0, 0.0, self.length - 0.02), STEEL, colour="steel"
        )
        # The stop lies a millimetre beyond the rest position, or the engine would let them fight.
        slide = Joint(
            "cup_slide",
            "prismatic",
            platform,
            point_p,
            lower=-self.stroke,
            upper=0.001,
            effort=self.preload,
            speed=1.0,
        )
        return Link("cup", (bellows, plunger), slide)


CUP = VacuumCup()
"""The cup of all machines here."""


def sealed(
    lip: Any,
    axis: Any,
    position: Any,
    quaternion: Any,
    size: tuple[float, float],
    cup: VacuumCup = CUP,
) -> Any:
    """Whether the whole lip lies on the top face of a square block.

    Arrays (n,) in place of numbers give an array (n,).

    Args:
        lip: Centre of the lip, m, world.
        axis: Outward axis of the cup, world.
        position: Centre of the block, m, world.
        quaternion: Its orientation (x, y, z, w).
        size: Its width and height, m.
        cup: The cup.
    """
    qx, qy, qz, qw = quaternion
    inverse = (-qx, -qy, -qz, qw)
    x, y, z = position
    local = rotate(inverse, (lip[0] - x, lip[1] - y, lip[2] - z))
    width, height = size
    gap = local[2] - height / 2
    margin = width / 2 - cup.radius
    covered = (abs(local[0]) <= margin) & (abs(local[1]) <= margin)
    aligned = -rotate(inverse, axis)[2] >= math.cos(cup.seal_tilt)
    return (abs(gap) <= cup.seal_gap) & covered & aligned
