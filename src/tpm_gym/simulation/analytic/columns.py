"""Columns (3, ..., n) of n machines, over the rows that a :class:`Machine` computes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray, IntArray
from tpm_gym.mechanism.machine import Machine, Motion, Reading

_TRIANGLE = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


class Batch:
    """n machines of one kind, each as it was built."""

    def __init__(self, machine: Machine, count: int) -> None:
        """Build all of them as designed."""
        self._machine, self._count = machine, count
        self._built: FloatArray | None = None

    def build(
        self,
        rows: IntArray,
        lengths: Sequence[tuple[float, ...]],
        link_masses: Sequence[tuple[float, ...]],
    ) -> None:
        """Build some machines anew."""
        if self._built is None:
            if not any(lengths) and not any(link_masses):
                return
            self._built = np.tile(self._machine.built(), (self._count, 1))
        for row, own, masses in zip(rows.tolist(), lengths, link_masses, strict=True):
            self._built[row] = self._machine.built(own, masses)

    def take(self, rows: IntArray) -> Batch:
        """Return some of the machines."""
        part = Batch(self._machine, len(rows))
        part._built = None if self._built is None else self._built[rows]
        return part

    def inverse(self, point: FloatArray) -> FloatArray:
        """Compute joint positions (3, ..., n)."""
        columns: FloatArray = self._machine.inverse(point.T, self._built).T
        return columns

    def forward(self, theta: FloatArray) -> FloatArray:
        """Compute P (3, ..., n)."""
        columns: FloatArray = self._machine.forward(theta.T, self._built).T
        return columns

    def evaluate(self, theta: FloatArray) -> Reading:
        """Compute P (3, ..., n), J (3, 3, ..., n) and the rest (..., n)."""
        position, jacobian, conditioning, working = self._machine.evaluate(theta.T, self._built)
        return Reading(position.T, jacobian.T.swapaxes(0, 1), conditioning.T, working.T)

    def torque(
        self,
        theta: FloatArray,
        theta_dot: FloatArray,
        theta_ddot: FloatArray,
        push: FloatArray | None = None,
    ) -> FloatArray:
        """Compute torques (3, ..., n)."""
        force = None if push is None else push.T
        motion = theta.T, np.transpose(theta_dot), np.transpose(theta_ddot)
        columns: FloatArray = self._machine.torque(*motion, force, self._built).T
        return columns

    def motion(self, theta: FloatArray, theta_dot: FloatArray) -> Motion:
        """Compute the motion; masses are the upper triangle (6, ..., n)."""
        found = self._machine.motion(theta.T, theta_dot.T, self._built)
        mass = np.stack([found.mass[..., i, k].T for i, k in _TRIANGLE])
        jacobian = found.jacobian.T.swapaxes(0, 1)
        return Motion(found.position.T, jacobian, found.working.T, mass, found.bias.T)

    def assembled_at(self, point: FloatArray) -> BoolArray:
        """Return whether P is on the assembly mode's side (..., n)."""
        columns: BoolArray = self._machine.same_side(point.T).T
        return columns
