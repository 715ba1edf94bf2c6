"""Table, floor, goal markers and light of all engines; world frame."""

from __future__ import annotations

from typing import Final, NamedTuple

from tpm_gym.arrays import Vector

__all__ = ["FLOOR", "FLOOR_EDGE", "LIGHT", "MARKER_COLOUR", "TABLE", "Slab"]

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


TABLE: Final = Slab(0.0, 0.02, 1.0, (0.80, 0.78, 0.74, 1.0))
"""Table; the machine defines its length and width."""

FLOOR: Final = Slab(-0.5, 0.02, 0.5, (0.90, 0.91, 0.93, 1.0))
FLOOR_EDGE: Final = 2.0
"""Half edge length of the floor, m."""

MARKER_COLOUR: Final[Colour] = (0.0, 0.75, 0.2, 0.7)
"""Colour of the goal markers."""

LIGHT: Final[Vector] = (1.0, -1.2, 2.5)
"""Direction from the scene to the light."""
