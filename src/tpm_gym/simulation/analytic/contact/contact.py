"""Simulation of objects, cups and vacuum on many independent tables.

A time step (:mod:`.stepping`) finds contacts (:mod:`.collision`), computes their impulses
(:mod:`.solver`), moves the objects, and applies the vacuum law (:mod:`.grasp`).

Simplifications: The table supports an object only while the object's centre is over the table.
Stem and platform do not collide with objects. The lip does not collide with the table. The cup's
spring has no end stop. Within a time step, contacts do not move point P.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray, IntArray, Vector
from tpm_gym.simulation.analytic.contact.state import Route, Setting, tables_for, work_for
from tpm_gym.simulation.analytic.contact.stepping import advance, place, read
from tpm_gym.simulation.stage import boards
from tpm_gym.simulation.state import Belt, Block


class Reading(NamedTuple):
    """State of the k objects and the cup on each of n tables, in the world frame.

    Attributes:
        position: (n, k, 3) m, centres of the objects.
        quaternion: (n, k, 4), orientations (x, y, z, w) of the objects.
        velocity: (n, k, 3) m/s, velocities of the objects.
        angular_velocity: (n, k, 3) rad/s, angular velocities of the objects.
        held: (n,) index of the object in the cup; -1 for none.
        vacuum: (n,) Pa below the ambient pressure.
    """

    position: FloatArray
    quaternion: FloatArray
    velocity: FloatArray
    angular_velocity: FloatArray
    held: IntArray
    vacuum: FloatArray


class Contact:
    """Objects, cups and vacuum of n robots, each over its own table.

    Args:
        blocks: The k objects on each table.
        count: Number of tables, n.
        time_step: Time step, s.
        table: Half edge lengths of the tables along x and y, m.
        frame: Factors and origin (m) that convert the machine's frame to the world frame.
        belt: Belt of each table; None for none.
    """

    def __init__(
        self,
        blocks: Sequence[Block],
        count: int,
        time_step: float,
        table: tuple[float, float],
        frame: tuple[Vector, Vector],
        belt: Belt | None = None,
    ) -> None:
        """Place the objects in the middle of their tables, stacked on each other."""
        self._blocks, number = tuple(blocks), len(blocks)
        half = np.array([block.half for block in blocks]).reshape(number, 3)
        low, end = boards(table, belt)[-1][1], -math.inf if belt is None else belt.end
        self._setting = Setting(half, (low, *table), end, time_step, *frame)
        self._tables, self._earlier = tables_for(count, number), tables_for(count, number)
        self._work = work_for(number)
        everything = np.arange(count)
        self.alter(everything, np.ones(count), np.ones(count))
        middle = np.zeros((count, number, 7))
        middle[..., 2], middle[..., 6] = 2 * half[:, 2].cumsum() - half[:, 2], 1.0
        self.place(everything, middle)

    def alter(self, rows: Any, mass_factor: FloatArray, friction_factor: FloatArray) -> None:
        """Set the objects' masses and friction coefficients on some tables.

        Args:
            rows: Indices of the r tables.
            mass_factor: (r,) factors of the nominal masses.
            friction_factor: (r,) factors of the nominal friction coefficients.
        """
        for name, factor in (("mass", mass_factor), ("friction", friction_factor)):
            nominal = np.array([getattr(block, name) for block in self._blocks])
            self._tables.objects[name][rows] = factor[:, None] * nominal

    def set_belt(self, rows: Any, speed: FloatArray) -> None:
        """Set the speeds (r,) m/s, along x, of the belts on the tables with indices ``rows``."""
        for tables in (self._tables, self._earlier):
            tables.belts[rows] = speed

    def place(self, rows: IntArray, poses: FloatArray) -> None:
        """Release held objects, set the vacuum to zero, and place all objects with zero velocity.

        If all objects of a table stand upright on the table top, and its belt does not run, they
        count as at rest immediately.

        Args:
            rows: (r,) indices of the tables.
            poses: (r, k, 7) centres (m) and orientations (x, y, z, w) of the objects, world.
        """
        place(self._tables, rows, poses, self._setting)

    def advance(
        self, rows: IntArray, route: Route, vacuum_on: BoolArray, last: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Simulate the time steps of ``route`` for the objects and cups on some tables.

        Args:
            rows: (r,) indices of the tables.
            route: Motion of point P.
            vacuum_on: (r,) whether the vacuum is on.
            last: Number of time steps, at the end of ``route``, for which forces are returned.

        Returns:
            Two arrays: force (r, last, 3) N of cup and objects on the platform in each of the
            ``last`` time steps, machine's frame; and mass (r,) kg of the held objects. The force
            includes the inertia of the cup's motion relative to P. It does not include the cup's
            weight, nor the inertia of a cup that moves as P does, because the machine's dynamics
            include both.
        """
        force, carried = np.zeros((len(rows), last, 3)), np.zeros(len(rows))
        if self._blocks:
            states = self._tables, self._earlier
            advance(*states, rows, route, vacuum_on, self._setting, self._work, force, carried)
        return force, carried

    def read(self) -> Reading:
        """Return the state of the objects and cups on all tables, as copies."""
        count, number = self._tables.objects.shape
        position, velocity, spin = np.empty((3, count, number, 3))
        reading = Reading(
            position, np.empty((count, number, 4)), velocity, spin,
            np.empty(count, np.int64), np.empty(count),
        )  # fmt: skip
        read(self._tables.objects, self._tables.cups, *reading)
        return reading

    def undo(self, rows: IntArray) -> None:
        """Undo the last :meth:`advance` on the tables with the indices ``rows`` (r,)."""
        rows = rows[self._earlier.awake[rows]]  # the others have not changed
        for own, earlier in zip(self._tables, self._earlier, strict=True):
            own[rows] = earlier[rows]

    def save(self) -> FloatArray:
        """Return the state of all tables as an array (n, c): c numbers for each table."""
        return np.concatenate(self._plain(), axis=1)

    def restore(self, saved: FloatArray) -> None:
        """Restore the state of objects, cups and contacts from the result of :meth:`save`."""
        first = 0
        for plain in self._plain():
            plain[:] = saved[:, first : first + plain.shape[1]]
            first += plain.shape[1]
        self._tables.awake[:] = True

    def _plain(self) -> list[FloatArray]:
        """Return views (n, ...) of objects, cups and forces as plain numbers."""
        return [part.view(np.float64).reshape(len(part), -1) for part in self._tables[:3]]
