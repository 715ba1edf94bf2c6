"""Table, belt, floor, goal markers and light of all engines; world frame."""

from __future__ import annotations

from typing import Final, NamedTuple

from tpm_gym.arrays import Vector
from tpm_gym.errors import ConfigurationError
from tpm_gym.simulation.state import Belt, Patch, Scene

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

BELT: Final = TABLE._replace(colour=(0.25, 0.27, 0.30, 1.0))
"""Belt; flush with the table."""

FLOOR: Final = Slab(-0.5, 0.02, 0.5, (0.90, 0.91, 0.93, 1.0))
FLOOR_EDGE: Final = 2.0
"""Half edge length of the floor, m."""

MARKER_COLOUR: Final[Colour] = (0.0, 0.75, 0.2, 0.7)
"""Colour of the goal markers."""

LIGHT: Final[Vector] = (1.0, -1.2, 2.5)
"""Direction from the scene to the light."""

PATCH_HEIGHT: Final = 5e-4
"""Half the thickness of painted rectangles, m. Their centres are at the table top."""
_ARROW: Final[Colour] = (0.95, 0.75, 0.15, 1.0)
_ARROWS_APART, _ARROW_LENGTH, _ARROW_HALF_WIDTH, _SLICES = 0.2, 0.05, 0.04, 10  # m, m, m, count


def boards(table: tuple[float, float], belt: Belt | None) -> list[tuple[Slab, float, float]]:
    """Return the table, then the belt if there is one, each with its lowest and highest x (m).

    ``table`` has the half edge lengths of the table along x and y, m.

    Raises:
        ConfigurationError: If the belt's lowest x is greater than the table's lowest x, or the
            belt's highest x is not on the table.
    """
    edge = table[0]
    if belt is None:
        return [(TABLE, -edge, edge)]
    if belt.start > -edge:
        raise ConfigurationError("start", belt.start, f"at most {-edge} m, the edge of the table")
    if not -edge < belt.end < edge:
        valid = f"a place on the table, between {-edge} and {edge} m"
        raise ConfigurationError("end", belt.end, valid)
    return [(TABLE, belt.end, edge), (BELT, belt.start, belt.end)]


def painted(scene: Scene) -> list[Patch]:
    """Return the scene's painted rectangles, and the rectangles that form arrows on its belt."""
    patches = list(scene.patches)
    if scene.belt is not None:
        tip, thick = scene.belt.end - _ARROW_LENGTH, _ARROW_LENGTH / _SLICES
        while tip - _ARROW_LENGTH > scene.belt.start:
            for k in range(_SLICES):
                half, x = _ARROW_HALF_WIDTH * (k + 0.5) / _SLICES, tip - k * thick
                patches.append(Patch((x - thick, -half), (x, half), _ARROW))
            tip -= _ARROWS_APART
    return patches
