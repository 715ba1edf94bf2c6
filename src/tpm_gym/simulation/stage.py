"""Table, floor, camera and light of all engines; world frame."""

from __future__ import annotations

from typing import Final, NamedTuple

from tpm_gym.arrays import Vector

__all__ = ["CAMERA", "FLOOR", "FLOOR_EDGE", "LIGHT", "MARKER_COLOUR", "TABLE", "Camera", "Slab"]

Colour = tuple[float, float, float, float]


class Slab(NamedTuple):
    """Static horizontal board.

    Attributes:
        top: Height of the upper face, m.
        half_height: Half the thickness, m.
        friction: Coulomb coefficient; a contact uses the product of both bodies' coefficients.
        colour: Red, green, blue and opacity, each from 0 to 1.
    """

    top: float
    half_height: float
    friction: float
    colour: Colour


TABLE: Final = Slab(0.0, 0.02, 1.0, (0.86, 0.84, 0.80, 1.0))
"""Table; the machine defines its length and width."""

FLOOR: Final = Slab(-0.5, 0.02, 0.5, (0.70, 0.72, 0.75, 1.0))
FLOOR_EDGE: Final = 2.0
"""Half edge length of the floor, m."""

MARKER_COLOUR: Final[Colour] = (0.1, 0.8, 0.2, 0.6)
"""Colour of the goal markers."""


class Camera(NamedTuple):
    """Camera of the pictures.

    Attributes:
        target: Point in the middle of the picture, m.
        distance: Distance from the target, m.
        yaw: Rotation about the vertical, degrees; at 0 the camera looks along +y.
        pitch: Angle above the horizon, degrees; negative to look down.
        opening: Vertical field of view, degrees.
    """

    target: Vector
    distance: float
    yaw: float
    pitch: float
    opening: float


CAMERA: Final = Camera((-0.01, 0.0, 0.47), 1.85, 32.0, -13.0, 42.0)
LIGHT: Final[Vector] = (1.0, -1.2, 2.5)
"""Direction from the scene to the light."""
