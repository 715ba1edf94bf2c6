"""State of the objects on a table and of the cup above them, and the solver's workspace."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import FloatArray

__all__ = [
    "AT_REST",
    "BODY",
    "CONTACT",
    "CUP_STATE",
    "LIP_SLOTS",
    "OBJECT",
    "PAIR_SLOTS",
    "TABLE_SLOTS",
    "Record",
    "Records",
    "Setting",
    "Work",
    "slots",
    "work_for",
]

Record = Any
"""One item of a structured array; NumPy has no type for it."""
Records = NDArray[np.void]
"""A structured array."""

OBJECT: Final = np.dtype(
    [
        ("position", "f8", 3),  # of the centre; m, world
        ("quaternion", "f8", 4),  # x, y, z, w
        ("velocity", "f8", 3),  # m/s
        ("spin", "f8", 3),  # rad/s, world
        ("mass", "f8"),  # kg
        ("friction", "f8"),  # Coulomb coefficient
        ("rest", "f8"),  # time steps in a row without motion; at rest from AT_REST on
    ],
    align=True,
)
AT_REST: Final = 2

CUP_STATE: Final = np.dtype(
    [
        ("slide", "f8"),  # m, by which the cup is pushed back into its stem
        ("slide_rate", "f8"),  # m/s
        ("vacuum", "f8"),  # Pa
        ("held", "f8"),  # index of the object; -1 for none
        ("grip", "f8", 3),  # m, from point P to the centre of the held object at slide 0
    ],
    align=True,
)

BODY: Final = np.dtype(
    [
        ("velocity", "f8", 3),  # m/s
        ("spin", "f8", 3),  # rad/s
        ("lightness", "f8", 3),  # 1/kg, inverse mass along the world's axes
        ("across", "f8"),  # 1/(kg m^2), inverse inertia about the level axes of the block
        ("along", "f8"),  # 1/(kg m^2), inverse inertia about its third axis
        ("axis", "f8", 3),  # the third axis, world
    ],
    align=True,
)
"""A body in the solver: 0 is the cup with what it holds, 1 + i is object i."""

CONTACT: Final = np.dtype(
    [
        ("a", "i8"),  # body; -1 for the table
        ("b", "i8"),  # body
        ("arm_a", "f8", 3),  # m, from the centre of the body to the contact
        ("arm_b", "f8", 3),
        ("normal", "f8", 3),  # unit vector from a to b
        ("gap", "f8"),  # m; negative where the bodies penetrate
        ("friction", "f8"),  # Coulomb coefficient
        ("slot", "i8"),  # where the impulse is stored between time steps
        ("impulse", "f8", 3),  # N s, on b
        ("press", "f8"),  # N s, normal part of the impulse
        ("speed", "f8"),  # m/s, least relative velocity along the normal
        ("reply", "f8", 3),  # (m/s)/(N s), change of the relative velocity by a normal impulse
        ("ease_n", "f8"),  # N s/(m/s), step of the normal impulse
        ("ease_t", "f8"),  # N s/(m/s), step of the friction
        ("enough", "f8"),  # (N s)^2, square of a change of the impulse that does not count
    ],
    align=True,
)

TABLE_SLOTS, LIP_SLOTS, PAIR_SLOTS = 8, 4, 8
"""Contacts of an object with the table, of an object with the lip, and of two objects, at most."""


class Setting(NamedTuple):
    """Constants of a simulation.

    Attributes:
        half: Half edges of the objects, (k, 3) m.
        table: Half edges of the table along x and y, m.
        step: Time step, s.
    """

    half: FloatArray
    table: tuple[float, float]
    step: float


class Work(NamedTuple):
    """Workspace of the solver; holds nothing between time steps.

    Attributes:
        bodies: (k + 1,) of :data:`BODY`.
        contacts: As many of :data:`CONTACT` as there can be.
        polygons: (2, 12, 3) m, for clipping.
    """

    bodies: Records
    contacts: Records
    polygons: FloatArray


def slots(objects: int) -> int:
    """Return the largest number of contacts between a number of objects, table and lip."""
    pairs = objects * (objects - 1) // 2
    return objects * (TABLE_SLOTS + LIP_SLOTS) + pairs * PAIR_SLOTS


def work_for(objects: int) -> Work:
    """Allocate the workspace for a number of objects."""
    bodies, contacts = np.zeros(objects + 1, BODY), np.zeros(slots(objects), CONTACT)
    return Work(bodies, contacts, np.zeros((2, 12, 3)))
