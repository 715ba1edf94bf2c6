"""An object, and the cup above it, as a row of numbers; and what is done with three of them."""

from __future__ import annotations

import math
from typing import NamedTuple

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.simulation.analytic.compiling import compiled
from tpm_gym.simulation.engine import SPRING_GAIN

# Where in the row; world, SI units
X, Y, Z = 0, 1, 2  # of the object's centre
VX, VY, VZ = 3, 4, 5
TURN = 6  # of four: its quaternion (x, y, z, w)
SPIN = 10  # of three
GRIP = 13  # of three: from point P to the centre of what is held
SLIDE = 16  # how far the cup is pushed back
VACUUM = 17
NORMAL = 18  # of three: of the last contact with the lip, if it was the last time step's
HELD, STILL = 21, 22  # 0 or 1
MASS, ROUGH = 23, 24  # ROUGH is the object's Coulomb coefficient on the table
CHANGED = 25  # what the last time step has made of it: TAKEN, TAKEN_PRESSED, LET_GO, or 0
COLUMNS = 26
TAKEN, TAKEN_PRESSED, LET_GO = 1.0, 2.0, 3.0

RECOVERY = 0.08  # share of a penetration that a time step takes out
SLOP = 1e-5  # m; a penetration that stays
SEEN_BY_LIP = 6e-4  # m; at this distance lip and block keep from going deeper than to touch
ROUNDING = 1e-3  # m; of the edges of cup and block for each other
SPRING = 1 - SPRING_GAIN  # share of the cup's way back that a time step leaves of it
SETTLED = 1e-6  # m, and m/s: less is none
LITTLE = 1e-12

_SLIP = 1e-4  # m/s; what is slower has no direction
TILTED_SLIP = 1e-2  # m/s; nor has what tips, and is slower: it turns about what stands still
_LEAST = 0.02  # of friction along an axis, whatever the direction of the slip
UNKNOWN_SLIP = math.sqrt(0.5)  # of friction along either axis, where it is not known yet


class Setting(NamedTuple):
    """What is the same for all objects.

    Attributes:
        half: Half edges of the blocks, m.
        table: Half edges of the tables along x and y, m.
        step: The time step, s.
    """

    half: Vector
    table: tuple[float, float]
    step: float


@compiled
def three(row: FloatArray, first: int) -> Vector:
    """Numbers of a row from there on."""
    return row[first], row[first + 1], row[first + 2]


@compiled
def put(row: FloatArray, first: int, values: Vector) -> None:
    """Write numbers into a row from there on."""
    row[first], row[first + 1], row[first + 2] = values


@compiled
def plus(a: Vector, b: Vector, times: float = 1.0) -> Vector:
    """A + times b."""
    return a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2]


@compiled
def dot(a: Vector, b: Vector) -> float:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def clip(value: float, low: float, high: float) -> float:
    """The nearest number between two."""
    return min(max(value, low), high)


@compiled
def level_length(x: float, y: float) -> float:
    """Length of a level vector: plain, or bits would be those of a machine's own hypot."""
    return math.sqrt(x * x + y * y)


@compiled
def slip_shares(x: float, y: float, least: float = _SLIP) -> tuple[float, float]:
    """Shares of friction along the world's axes for a slip, m/s; below ``least`` it has none."""
    speed = level_length(x, y)
    if speed > least:
        return max(abs(x) / speed, _LEAST), max(abs(y) / speed, _LEAST)
    return UNKNOWN_SLIP, UNKNOWN_SLIP


@compiled
def least_rise(gap: float, seen: float = 0.0) -> float:
    """How far a contact at a distance (m) must open at least in a time step, m.

    A contact is not there before it is as near as ``seen`` (m).
    """
    if gap > 0:
        return -gap if gap < seen else -math.inf
    return RECOVERY * max(-gap - SLOP, 0.0)


@compiled
def axes(row: FloatArray) -> tuple[Vector, Vector, Vector]:
    """The object's own axes in the world."""
    x, y, z, w = row[TURN], row[TURN + 1], row[TURN + 2], row[TURN + 3]
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )
