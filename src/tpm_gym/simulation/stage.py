"""Table, floor, camera and light, the same in all engines. World frame."""

from __future__ import annotations

from typing import Final, NamedTuple

from tpm_gym.arrays import Vector

__all__ = ["CAMERA", "FLOOR", "FLOOR_EDGE", "LIGHT", "MARKER_COLOUR", "TABLE", "Camera", "Slab"]

Colour = tuple[float, float, float, float]


class Slab(NamedTuple):
    """Static board.

    Attributes:
        top: Height of its upper face, m.
        half_height: m.
        friction: Coulomb coefficient; a contact has the product of both sides.
        colour: Red, green, blue, opacity.
    """

    top: float
    half_height: float
    friction: float
    colour: Colour


TABLE: Final = Slab(0.0, 0.02, 1.0, (0.86, 0.84, 0.80, 1.0))
"""Table; its length and width are those of the machine."""

FLOOR: Final = Slab(-0.5, 0.02, 0.5, (0.70, 0.72, 0.75, 1.0))
FLOOR_EDGE: Final = 2.0
"""Half edge of the floor, m."""

MARKER_COLOUR: Final[Colour] = (0.1, 0.8, 0.2, 0.6)
"""Colour of the spheres that show a goal."""


class Camera(NamedTuple):
    """Camera of the pictures.

    Attributes:
        target: Point in the middle of the picture, m.
        distance: Distance from the target, m.
        yaw: Turn about the vertical, degrees; at 0 the camera looks along +y.
        pitch: Angle above the horizon, degrees; negative to look down.
        opening: Angle between the picture's lower and upper edge, degrees.
    """

    target: Vector
    distance: float
    yaw: float
    pitch: float
    opening: float


CAMERA: Final = Camera((-0.01, 0.0, 0.47), 1.85, 32.0, -13.0, 42.0)
LIGHT: Final[Vector] = (1.0, -1.2, 2.5)
"""Direction from which the light comes."""
