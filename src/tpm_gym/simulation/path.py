"""The path of point P in a control period, and the joint positions along it."""

from __future__ import annotations

import numpy as np

from tpm_gym.arrays import FloatArray
from tpm_gym.mechanism.machine import Machine

__all__ = ["Path", "spline_weights"]


def spline_weights(steps: int) -> FloatArray:
    """Return the weights (steps, 3) of the last three commands along the quadratic B-spline."""
    s = np.arange(1, steps + 1) / steps
    return np.stack([(1 - s) ** 2, 1 + 2 * s - 2 * s**2, s**2], axis=1) / 2


class Path:
    """Path of point P of n robots in a control period: a quadratic B-spline through the commands.

    The spline lags the commands by half a period, stays in their convex hull, and keeps the
    accelerations finite. It is a curve of point P, not of the joints: near a singularity, a
    straight line between two postures would wander by centimetres.

    Args:
        machine: The nominal machine, whose inverse kinematics the control believes in.
        commands: (n, 3, 3) m, machine's frame: the last three commands, oldest first.
        weights: (K, 3), of :func:`spline_weights`.
        bias: (n, 3) rad, what the encoders report minus the truth; None for none.
    """

    def __init__(
        self,
        machine: Machine,
        commands: FloatArray,
        weights: FloatArray,
        bias: FloatArray | None = None,
    ) -> None:
        """Compute nothing yet."""
        self.machine, self._commands, self._weights, self._bias = machine, commands, weights, bias

    @property
    def start(self) -> FloatArray:
        """(n, 3) m, point P at the beginning of the period."""
        start: FloatArray = (self._commands[:, 0] + self._commands[:, 1]) / 2
        return start

    def points(self, last: int = 0) -> FloatArray:
        """Return point P (n, k, 3) m at the ends of the last k time steps; 0 for all of them."""
        from tpm_gym.simulation.compiled import spline_points  # imports Numba

        return spline_points(self._commands, self._weights[-last:])

    def joints(self, last: int = 0) -> FloatArray:
        """Return true joint positions (n, k, 3) rad at the ends of the last k time steps.

        Raises:
            JointLimitError: If a motor would be beyond a stop.
            UnreachableError: If a point is out of reach.
        """
        return self.true(self.machine.reach(self.points(last)))

    def true(self, theta: FloatArray) -> FloatArray:
        """Convert joint positions (n, ..., 3) by the encoders into true ones."""
        if self._bias is None:
            return theta
        return theta - self._bias.reshape(-1, *(1,) * (theta.ndim - 2), 3)
