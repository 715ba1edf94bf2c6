"""One object on each of many robots' tables, and the vacuum in each cup."""

from __future__ import annotations

from typing import Any

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray, IntArray
from tpm_gym.simulation.analytic.body import (
    COLUMNS,
    HELD,
    MASS,
    ROUGH,
    SPIN,
    TURN,
    VACUUM,
    VX,
    Setting,
    X,
)
from tpm_gym.simulation.analytic.contact import advance
from tpm_gym.simulation.state import Block

__all__ = ["Pucks"]


class Pucks:
    """One object on each of n robots' tables, and the vacuum in each cup.

    Args:
        block: What the objects are; None for none.
        count: n.
        time_step: s.
        table: Half edges of the tables along x and y, m.
    """

    def __init__(
        self,
        block: Block | None,
        count: int,
        time_step: float,
        table: tuple[float, float] = (np.inf, np.inf),
    ) -> None:
        """Objects in the middle of their tables."""
        self._block, self._numbers = block, np.arange(count)
        self._state: FloatArray = np.zeros((count, COLUMNS))
        if block is not None:
            self._setting = Setting(block.half, table, time_step)
            self._state[:, MASS], self._state[:, ROUGH] = block.mass, block.friction
            middle = np.zeros((count, 3)) + (0.0, 0.0, block.height / 2)
            self.place(slice(None), middle)

    def alter(
        self, rows: slice | IntArray, mass_factor: FloatArray, friction_factor: FloatArray
    ) -> None:
        """Make objects (r,) times as heavy and as rough as nominal."""
        if self._block is not None:
            self._state[rows, MASS] = self._block.mass * mass_factor
            self._state[rows, ROUGH] = self._block.friction * friction_factor

    def place(self, rows: slice | IntArray, positions: FloatArray) -> None:
        """Let go, empty the cups, and put objects upright and at rest.

        Args:
            rows: Which.
            positions: (r, 3) m, world, of their centres.
        """
        self._state[rows, :MASS] = 0.0
        self._state[rows, X : X + 3] = positions
        self._state[rows, TURN + 3] = 1.0

    def advance(self, rows: slice | IntArray, path: FloatArray, on: BoolArray) -> FloatArray:
        """Run K time steps.

        Args:
            rows: r of the machines.
            path: (K + 2, 3, r) m, world: point P before the last time step, now, and after each
                time step to come.
            on: (r,) whether the vacuum is on.

        Returns:
            (K, 3, r) N, world: what cup and object do to the platform in each time step, beside
            the weight and inertia of the cup at rest in it.
        """
        force = np.zeros((len(path) - 2, *path.shape[1:]))
        if self._block is not None:
            way = np.ascontiguousarray(path)
            advance(self._state, self._numbers[rows], way, on, self._setting, force)
        return force

    def carried(self, rows: slice | IntArray) -> FloatArray:
        """What the cups hold, (r,) kg."""
        state = self._state[rows]
        carried: FloatArray = np.where(state[:, HELD], state[:, MASS], 0.0)
        return carried

    def report(self) -> dict[str, Any]:
        """The entries of a :class:`~tpm_gym.simulation.state.State` about objects, rows first."""
        columns = self._state[:, :MASS].T.copy()  # in which tasks compute several times as fast
        some = slice(None if self._block else 0)

        def entries(first: int, count: int = 3) -> FloatArray:
            part: FloatArray = columns[first : first + count].T[:, None][:, some]
            return part

        x, y, z, w = columns[TURN : TURN + 4]
        axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        return {
            "object_position": entries(X),
            "object_quaternion": entries(TURN, 4),
            "object_axis": axis.T[:, None][:, some],
            "object_velocity": entries(VX),
            "object_angular_velocity": entries(SPIN),
            "held": np.where(columns[HELD], 0, -1),
            "vacuum": columns[VACUUM],
        }

    def save(self, rows: slice | IntArray) -> FloatArray:
        """Take down everything that the next steps of rows depend on."""
        saved: FloatArray = self._state[rows].copy()
        return saved

    def restore(self, rows: slice | IntArray, saved: FloatArray) -> None:
        """Go back to what :meth:`save` returned."""
        self._state[rows] = saved
