"""State of objects and cups, and workspace of the contact solver."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import BoolArray, FloatArray, Vector

Record = Any
"""One element of a structured array; NumPy has no type for such elements."""
Records = NDArray[np.void]
"""A structured array."""

OBJECT: Final = np.dtype(
    [
        ("position", "f8", 3),  # centre; m, world
        ("quaternion", "f8", 4),  # x, y, z, w
        ("velocity", "f8", 3),  # m/s
        ("spin", "f8", 3),  # angular velocity; rad/s, world
        ("mass", "f8"),  # kg
        ("friction", "f8"),  # Coulomb coefficient
        ("rest", "f8"),  # number of time steps since the last motion; AT_REST or more: at rest
    ],
    align=True,
)
AT_REST: Final = 2

CUP_STATE: Final = np.dtype(
    [
        ("slide", "f8"),  # m, displacement of the cup into its stem
        ("slide_rate", "f8"),  # m/s
        ("vacuum", "f8"),  # Pa
        ("held", "f8"),  # index of the held object; -1 for none
        ("grip", "f8", 3),  # m, vector from P to the centre of the held object at slide 0
    ],
    align=True,
)

BODY: Final = np.dtype(
    [
        ("velocity", "f8", 3),  # m/s
        ("spin", "f8", 3),  # rad/s, angular velocity
        ("lightness", "f8", 3),  # 1/kg, inverse mass along the world's axes
        ("across", "f8"),  # 1/(kg m^2), inverse inertia about the object's x and y axes
        ("along", "f8"),  # 1/(kg m^2), inverse inertia about the object's z axis
        ("axis", "f8", 3),  # the object's z axis, world
    ],
    align=True,
)
"""Body in the solver: body 0 is the cup with the held object, body 1 + i is object i.

The last body is the belt, which has a velocity and an infinite mass.
"""

CONTACT: Final = np.dtype(
    [
        ("a", "i8"),  # index of a body; -1 for the table
        ("b", "i8"),  # index of a body
        ("arm_a", "f8", 3),  # m, from the centre of the body to the contact
        ("arm_b", "f8", 3),
        ("normal", "f8", 3),  # unit vector from a to b
        ("gap", "f8"),  # m; negative if the bodies penetrate
        ("friction", "f8"),  # Coulomb coefficient
        ("slot", "i8"),  # index of the stored force of the last time step
        ("impulse", "f8", 3),  # N s, on b
        ("press", "f8"),  # N s, normal component of the impulse
        ("speed", "f8"),  # m/s, smallest allowed relative velocity along the normal
        ("reply", "f8", 3),  # (m/s)/(N s), relative velocity per unit normal impulse
        ("ease_n", "f8"),  # N s/(m/s), normal impulse per velocity error in a sweep
        ("ease_t", "f8"),  # N s/(m/s), friction impulse per slip velocity in a sweep
        ("enough", "f8"),  # (N s)^2, square of the largest negligible change of the impulse
    ],
    align=True,
)

TABLE_SLOTS, LIP_SLOTS, PAIR_SLOTS = 8, 4, 8
"""Largest number of contacts of an object with the table, with the lip, and with another object."""


class Setting(NamedTuple):
    """Constants of a simulation.

    Attributes:
        half: (k, 3) m, half edge lengths of the k objects.
        table: Three bounds of the surface that table and belt form together, m: lowest x, highest
            x, and highest y (half of the surface's width).
        belt_end: Highest x of the belt, m; minus infinity without a belt.
        step: Time step, s.
        turn: Signs (1 or -1). The components of a vector in the machine's frame times these signs
            are its components in the world frame.
        origin: Origin of the machine's frame in the world frame, m.
    """

    half: FloatArray
    table: tuple[float, float, float]
    belt_end: float
    step: float
    turn: Vector
    origin: Vector


class Tables(NamedTuple):
    """State of n tables with k objects each.

    Attributes:
        objects: (n, k) records of :data:`OBJECT`.
        cups: (n,) records of :data:`CUP_STATE`.
        forces: (n, slots(k), 3) N, contact forces of the last time step.
        awake: (n,) False if all objects on a table are at rest, and the cup is empty, with vacuum
            and slide at 0. Time steps of this table are then skipped until the lip may touch an
            object.
        belts: (n,) m/s, speeds of the belts along x.
    """

    objects: Records
    cups: Records
    forces: FloatArray
    awake: BoolArray
    belts: FloatArray


class Route(NamedTuple):
    """Motion of point P in K time steps, for r robots.

    Points are in metres, in the machine's frame. The arrays are contiguous.

    Attributes:
        before: (r, 3), P one time step before the beginning.
        now: (r, 3), P at the beginning.
        controls: (r, c, 3), c control points for each robot. Their convex hull contains the motion.
        weights: (K, c), weights for each time step. P at the end of a time step is the sum of the
            control points, each multiplied by its weight.
    """

    before: FloatArray
    now: FloatArray
    controls: FloatArray
    weights: FloatArray


class Work(NamedTuple):
    """Workspace of the solver for k objects; every time step overwrites it.

    Attributes:
        bodies: (k + 2,) records of :data:`BODY`: the cup, the objects, the belt.
        contacts: (slots(k),) records of :data:`CONTACT`.
        polygons: (2, 12, 3) m, corners of two polygons with up to 12 corners each, for the overlap
            of two faces.
    """

    bodies: Records
    contacts: Records
    polygons: FloatArray


def slots(objects: int) -> int:
    """Return the largest possible number of contacts between ``objects`` objects, table and lip."""
    pairs = objects * (objects - 1) // 2
    return objects * (TABLE_SLOTS + LIP_SLOTS) + pairs * PAIR_SLOTS


def work_for(objects: int) -> Work:
    """Allocate the workspace for ``objects`` objects."""
    bodies, contacts = np.zeros(objects + 2, BODY), np.zeros(slots(objects), CONTACT)
    return Work(bodies, contacts, np.zeros((2, 12, 3)))


def tables_for(count: int, objects: int) -> Tables:
    """Allocate the state of ``count`` tables with ``objects`` objects each."""
    records, cups = np.zeros((count, objects), OBJECT), np.zeros(count, CUP_STATE)
    forces, awake = np.zeros((count, slots(objects), 3)), np.zeros(count, np.bool_)
    return Tables(records, cups, forces, awake, np.zeros(count))
