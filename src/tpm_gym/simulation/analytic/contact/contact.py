"""Objects on a table, the cup above them, and the vacuum between: many tables, each by itself.

A time step (:mod:`.stepping`) finds contacts (:mod:`.collision`), solves them (:mod:`.solver`),
moves the objects, and lets the vacuum take or drop one (:mod:`.grasp`).

Left out: an object stands on the table as long as its centre is over it, and then falls past it;
the stem and the platform pass through objects; the cup's spring has no end stop; the lip passes
through the table; point P does not yield to contacts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray, IntArray
from tpm_gym.simulation.analytic.contact.state import CUP_STATE, OBJECT, Setting, slots, work_for
from tpm_gym.simulation.analytic.contact.stepping import advance
from tpm_gym.simulation.state import Block

__all__ = ["Contact", "Reading"]


class Reading(NamedTuple):
    """State of n tables with k objects each.

    Attributes:
        position: (n, k, 3) m, world, of the centres.
        quaternion: (n, k, 4), x, y, z, w.
        velocity: (n, k, 3) m/s.
        angular_velocity: (n, k, 3) rad/s, world.
        held: (n,) index of the held object; -1 for none.
        vacuum: (n,) Pa.
    """

    position: FloatArray
    quaternion: FloatArray
    velocity: FloatArray
    angular_velocity: FloatArray
    held: IntArray
    vacuum: FloatArray


class Contact:
    """Objects, cups and vacuum of n robots, each over a table of its own.

    Args:
        blocks: The objects, k.
        count: n.
        time_step: s.
        table: Half edges of the tables along x and y, m.
        frame: Factors (3,) and origin (3,) m of the machine's frame.
    """

    def __init__(
        self,
        blocks: Sequence[Block],
        count: int,
        time_step: float,
        table: tuple[float, float],
        frame: tuple[FloatArray, FloatArray],
    ) -> None:
        """Put all objects in the middle of their tables, one on the other."""
        self._blocks, number = tuple(blocks), len(blocks)
        half = np.array([block.half for block in blocks]).reshape(number, 3)
        self._setting, self._frame = Setting(half, table, time_step), frame
        self._objects = np.zeros((count, number), OBJECT)
        self._cups = np.zeros(count, CUP_STATE)
        self._forces = np.zeros((count, slots(number), 3))
        everything = np.arange(count)
        self.alter(everything, np.ones(count), np.ones(count))
        middle = np.zeros((count, number, 3))
        middle[..., 2] = 2 * half[:, 2].cumsum() - half[:, 2]
        self.place(everything, middle)

    def alter(self, rows: Any, mass_factor: FloatArray, friction_factor: FloatArray) -> None:
        """Make objects ``mass_factor`` (r,) times as heavy as nominal; friction likewise."""
        mass, friction = (
            np.array([getattr(block, name) for block in self._blocks])
            for name in ("mass", "friction")
        )
        self._objects["mass"][rows] = mass_factor[:, None] * mass
        self._objects["friction"][rows] = friction_factor[:, None] * friction

    def place(
        self, rows: Any, positions: FloatArray, quaternions: FloatArray | None = None
    ) -> None:
        """Let go, empty the cups, and put objects at rest.

        Args:
            rows: Which tables, r.
            positions: (r, k, 3) m, world, of the centres.
            quaternions: (r, k, 4); None for upright.
        """
        objects = self._objects[rows]
        objects["position"] = positions
        objects["quaternion"] = (0.0, 0.0, 0.0, 1.0) if quaternions is None else quaternions
        objects["velocity"] = objects["spin"] = 0.0
        objects["rest"] = 0.0
        self._objects[rows] = objects
        empty = np.zeros((), CUP_STATE)
        empty["held"] = -1
        self._cups[rows] = empty
        self._forces[rows] = 0.0

    def advance(
        self, rows: IntArray, path: tuple[FloatArray, FloatArray, FloatArray], vacuum_on: BoolArray
    ) -> tuple[FloatArray, FloatArray]:
        """Run K time steps.

        Args:
            rows: (r,) which tables.
            path: Point P, m, machine's frame: before the last time step (r, 3), now (r, 3), and
                after each time step to come (r, K, 3); contiguous.
            vacuum_on: (r,) whether the vacuum is on.

        Returns:
            (r, K, 3) N, machine's frame: force of cup and objects on the platform in each time
            step, beside weight and inertia of the cup at rest in it. (r,) kg: what the cups hold.
        """
        force, carried = np.zeros(path[2].shape), np.zeros(len(rows))
        if self._blocks:
            states = self._objects, self._cups, self._forces
            # Threads may advance different rows at the same time, so each call has its own
            work = work_for(len(self._blocks))
            advance(states, rows, path, self._frame, vacuum_on, self._setting, work, force, carried)
        return force, carried

    def read(self) -> Reading:
        """Return copies of the state of all tables."""
        objects, cups = self._objects, self._cups
        return Reading(
            objects["position"].copy(),
            objects["quaternion"].copy(),
            objects["velocity"].copy(),
            objects["spin"].copy(),
            cups["held"].astype(np.int64),
            cups["vacuum"].copy(),
        )

    def copy(self) -> tuple[Any, ...]:
        """Return copies of the records of all tables; several times as fast as :meth:`save`."""
        return self._objects.copy(), self._cups.copy(), self._forces.copy()

    def repeat(self, rows: IntArray, copies: tuple[Any, ...]) -> None:
        """Put some tables back to copies of :meth:`copy`."""
        for own, earlier in zip((self._objects, self._cups, self._forces), copies, strict=True):
            own[rows] = earlier[rows]

    def save(self, rows: Any) -> FloatArray:
        """Return everything that the next time steps of some tables depend on, (r, c)."""
        parts = self._objects[rows], self._cups[rows], self._forces[rows]
        return np.concatenate([p.view(np.float64).reshape(len(p), -1) for p in parts], axis=1)

    def restore(self, rows: Any, saved: FloatArray) -> None:
        """Continue from what :meth:`save` returned."""
        parts, first = (self._objects, self._cups, self._forces), 0
        for part in parts:
            plain = part.view(np.float64).reshape(len(part), -1)
            plain[rows] = saved[:, first : first + plain.shape[1]]
            first += plain.shape[1]
