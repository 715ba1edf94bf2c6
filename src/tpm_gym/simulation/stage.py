"""What every engine puts around the robot, and from where it draws it all. World frame."""

from __future__ import annotations

from typing import Final, NamedTuple

from tpm_gym.arrays import Vector

__all__ = ["CAMERA", "FLOOR", "FLOOR_EDGE", "LIGHT", "MARKER_COLOUR", "TABLE", "Camera", "Slab"]

Colour = tuple[float, float, float, float]


class Slab(NamedTuple):
    """A board that lies still.

    Attributes:
        top: Height of its upper face, m.
        half_height: m.
        friction: Coulomb coefficient; that of a contact is the product of both sides'.
        colour: Red, green, blue, opacity.
    """

    top: float
    half_height: float
    friction: float
    colour: Colour


TABLE: Final = Slab(0.0, 0.02, 1.0, (0.86, 0.84, 0.80, 1.0))
"""As long and wide as the machine has it."""

FLOOR: Final = Slab(-0.5, 0.02, 0.5, (0.70, 0.72, 0.75, 1.0))
FLOOR_EDGE: Final = 2.0
"""Half of it, m."""

MARKER_COLOUR: Final[Colour] = (0.1, 0.8, 0.2, 0.6)
"""Of the spheres that show a goal."""


class Camera(NamedTuple):
    """Where pictures are taken from.

    Attributes:
        target: What is in the middle, m.
        distance: From there, m.
        yaw: Turn about the vertical, degrees; at 0 the camera looks along +y.
        pitch: Above the horizon, degrees; negative where it looks down.
        opening: Angle between the picture's lower and upper edge, degrees.
    """

    target: Vector
    distance: float
    yaw: float
    pitch: float
    opening: float


CAMERA: Final = Camera((-0.01, 0.0, 0.47), 1.85, 32.0, -13.0, 42.0)
LIGHT: Final[Vector] = (1.0, -1.2, 2.5)
"""Where the light comes from: a direction."""
