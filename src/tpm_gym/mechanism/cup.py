"""The vacuum cup below the platform: its size, its spring, and the condition for sealing.

Engines simulate the cup; all engines use :func:`sealed`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

from tpm_gym.arrays import Vector, rotate
from tpm_gym.mechanism.bodies import ALUMINIUM, STEEL, Joint, Link, Solid

_SILICONE = 1150.0  # kg/m^3


class VacuumCup(NamedTuple):
    """Vacuum cup on a spring-loaded plunger, which makers of cups call a level compensator.

    Attributes:
        length: Distance from point P of the platform to the lip, m.
        radius: Radius of the lip, m.
        bellows: Length of the part with the radius of the lip, m.
        stroke: Distance by which the cup can slide back into its stem, m.
        preload: Force with which the spring keeps the cup out, N. It exceeds ``vacuum * area``.
        vacuum: Largest pressure difference to the ambient air, Pa.
        area: Area within the lip, on which the vacuum acts, m^2.
        evacuation_time: Time constant with which the vacuum builds up in a sealed cup, s, for an
            ejector of 5 l/min and a volume of 1.6 cm^3 in cup and hose.
        venting_time: Time constant with which air enters the cup, s, while the vacuum is off or the
            lip is not sealed.
        least_vacuum: Remaining vacuum at which the lip comes off after the vacuum is switched off,
            Pa.
        friction: Factor for the friction of the lip while it is not sealed. The Coulomb coefficient
            between lip and object is this factor times the friction of the object.
        seal_friction: Coulomb coefficient of the sealed lip, for clean silicone on a smooth
            surface. Makers of cups assume 0.5 for dry metal, glass or wood.
        seal_gap: Largest distance between lip and object at which the vacuum seals, m.
        seal_tilt: Largest angle between the axes of cup and object at which the lip seals, rad.
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
    def lip(self) -> Vector:
        """Centre of the lip in the cup's frame, m."""
        return (0.0, 0.0, self.length)

    def stem(self, point_p: Vector) -> Solid:
        """Build the tube in which the cup slides, below ``point_p`` (m, platform's frame)."""
        x, y, z = point_p
        half = (self.length - self.bellows) / 2
        size = (0.005, 2 * half, 0.0)
        return Solid("cylinder", size, (x, y, z + half), ALUMINIUM, colour="steel")

    def link(self, platform: str, point_p: Vector) -> Link:
        """Build the cup as a link that slides in the link ``platform`` at point P."""
        size, middle = (self.radius, self.bellows, 0.0), (0.0, 0.0, self.length - self.bellows / 2)
        bellows = Solid("cylinder", size, middle, _SILICONE, colour="violet", collides=True)
        size, middle = (0.003, 0.04, 0.0), (0.0, 0.0, self.length - 0.02)
        plunger = Solid("cylinder", size, middle, STEEL, colour="steel")
        # The stop is 1 mm beyond the rest position; else stop and spring would act on each other.
        slide = Joint("cup_slide", "prismatic", platform, point_p, lower=-self.stroke, upper=0.001)
        slide = replace(slide, effort=self.preload, speed=1.0)
        return Link("cup", (bellows, plunger), slide)


CUP = VacuumCup()
"""Cup of all machines of this package."""


def sealed(lip: Any, axis: Any, position: Any, quaternion: Any, size: tuple[float, float]) -> Any:
    """Return whether the whole lip lies on the top face of a square block, so that it seals.

    Gap and tilt may be up to ``CUP.seal_gap`` and ``CUP.seal_tilt``. Vectors are in the world
    frame. The components of the vectors are numbers or arrays (n,). If they are arrays, the result
    is an array (n,).

    Args:
        lip: Centre of the lip, m.
        axis: Outward axis of the cup.
        position: Centre of the block, m.
        quaternion: Orientation (x, y, z, w) of the block.
        size: Width and height of the block, m.
    """
    qx, qy, qz, qw = quaternion
    inverse = (-qx, -qy, -qz, qw)
    x, y, z = position
    local = rotate(inverse, (lip[0] - x, lip[1] - y, lip[2] - z))
    width, height = size
    gap = local[2] - height / 2
    margin = width / 2 - CUP.radius
    covered = (abs(local[0]) <= margin) & (abs(local[1]) <= margin)
    aligned = -rotate(inverse, axis)[2] >= math.cos(CUP.seal_tilt)
    return (abs(gap) <= CUP.seal_gap) & covered & aligned
