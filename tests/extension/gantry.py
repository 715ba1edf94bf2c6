"""A gantry: three slides at right angles, in one file outside the package."""

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym import register_machine
from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism import Machine, Mount
from tpm_gym.mechanism.bodies import Joint, Link, Mechanism, Solid
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.machine import Reading
from tpm_gym.mechanism.parts import load

ALUMINIUM = 2700.0  # kg/m^3
SLIDES = ("slide_x", "slide_y", "slide_z")
IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def beam(size: Vector, wall: float, centre: Vector, colour: str) -> Solid:
    """A hollow aluminium box, closed at its ends."""
    x, y, z = size
    bore = (x - 2 * wall, y - 2 * wall, z - 2 * wall)
    return Solid("box", size, centre, ALUMINIUM, bore, colour=colour)


class Gantry(Machine):
    """The positions of the slides (m) are the coordinates of P."""

    def inverse(self, position: ArrayLike, built: FloatArray | None = None) -> FloatArray:
        """Every point is reached."""
        return np.array(position, dtype=float)

    def evaluate(self, theta: ArrayLike, built: FloatArray | None = None) -> Reading:
        """No singularity anywhere."""
        position = np.array(theta, dtype=float)
        shape = position.shape[:-1]
        jacobian = np.broadcast_to(np.eye(3), (*shape, 3, 3))
        return Reading(position, jacobian, np.ones(shape), np.ones(shape, dtype=bool))

    def joint_positions(self, theta: Vector) -> dict[str, float]:
        """A tree: no loop to close."""
        return {**dict(zip(SLIDES, theta, strict=True)), "cup_slide": 0.0}

    @cached_property
    def mechanism(self) -> Mechanism:
        """Base, bridge along x, trolley along y, ram along z."""
        ends = list(zip(self.region.low, self.region.high, strict=True))

        def slide(axis: int, parent: str) -> Joint:
            low, high = ends[axis]
            return Joint(
                SLIDES[axis], "prismatic", parent, (0.0, 0.0, 0.0), IDENTITY[axis],
                lower=low - 0.02, upper=high + 0.02, effort=200.0, speed=2.0,
            )  # fmt: skip

        rails = tuple(beam((0.9, 0.04, 0.04), 0.004, (0.0, y, 0.0), "white") for y in (-0.3, 0.3))
        links = (
            Link("base", rails),
            Link("bridge", (beam((0.06, 0.6, 0.04), 0.003, (0.0, 0.0, 0.04), "blue"),),
                 slide(0, "base")),
            Link("trolley", (beam((0.08, 0.08, 0.06), 0.004, (0.0, 0.0, 0.09), "yellow"),),
                 slide(1, "bridge")),
            Link("ram", (beam((0.03, 0.03, 0.9), 0.002, (0.0, 0.0, -0.45), "orange"),
                         CUP.stem((0.0, 0.0, 0.0)), *load(self.payload, (0.0, 0.0, 0.0))),
                 slide(2, "trolley")),
            CUP.link("ram", (0.0, 0.0, 0.0)),
        )  # fmt: skip
        return Mechanism(
            links, (), platform="ram", point_p=(0.0, 0.0, 0.0), tool="cup", lip=CUP.lip,
            actuated=SLIDES,
        )  # fmt: skip


GANTRY = Gantry(
    name="gantry",
    mount=Mount(height=0.97),
    region=Region(low=(-0.25, -0.15, 0.60), high=(0.25, 0.15, 0.903)),
    goal_region=Region(low=(-0.22, -0.12, 0.65), high=(0.22, 0.12, 0.90)),
    home=(0.0, 0.0, 0.80),
    joint_limit=0.03,
)
register_machine("gantry", GANTRY)
