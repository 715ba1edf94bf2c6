"""Numerical settings of the engine, the vacuum's limits, and the path between two commands."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral, Real

import numpy as np
from numpy.typing import NDArray

from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.bodies import Vector

__all__ = ["CONTROL_PERIOD", "Physics", "Quaternion", "rotate", "spline_weights", "transform"]

FloatArray = NDArray[np.float64]
Quaternion = tuple[float, float, float, float]

CONTROL_PERIOD = 1 / 25
"""Time between two commands, s."""
GRAVITY = 9.81  # m/s^2
SOLVERS = ("direct", "iterative")
REGULARISATION = 1e-9
"""Added to the constraints' compliance (CFM): loops that close twice over stay solvable."""
MOTOR_GAIN = 1.0
"""Share of the position error that a motor takes out in one time step, effort permitting."""
PULL_OFF_FORCE = 12.0
"""Largest force that the cup holds along each axis, N: 60 kPa of vacuum on the area of the lip."""
SEAL_GAP = 0.002
"""Largest distance between lip and object at which the vacuum seals, m."""
SEAL_TILT = np.deg2rad(10.0)
"""Largest angle between the cup's axis and the object's that the lip follows, rad."""
CLOSURE_LIMIT = 0.005
"""A loop that is open by more than this is lost, m."""
ASSEMBLY_LIMIT = 0.010
"""Platform against forward kinematics: farther apart, the mechanism is assembled otherwise, m."""


@dataclass(frozen=True)
class Physics:
    """Numerical settings of the engine.

    Attributes:
        time_step: s.
        solver: ``"direct"`` solves the constraints of a step exactly (Dantzig's pivoting);
            ``"iterative"`` is Bullet's default, sequential impulses.
        iterations: Of the iterative solver, a step; with 25 the mechanism is lost now and then.
        erp: Share of a constraint's error that is taken out in one step, in (0, 1].
        control_period: s between two commands; a whole number of time steps.

    Raises:
        ConfigurationError: If a value is out of range.
    """

    time_step: float = 1 / 250
    solver: str = "direct"
    iterations: int = 50
    erp: float = 1.0
    control_period: float = CONTROL_PERIOD

    def __post_init__(self) -> None:
        """Reject settings that cannot work."""
        for name in ("time_step", "control_period", "erp"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
                raise ConfigurationError(name, value, "a finite number")
        if self.solver not in SOLVERS:
            raise ConfigurationError("solver", self.solver, " or ".join(map(repr, SOLVERS)))
        if isinstance(self.iterations, bool) or not isinstance(self.iterations, Integral):
            raise ConfigurationError("iterations", self.iterations, "a whole number, 1 or more")
        if not 0 < self.time_step <= self.control_period:
            valid = f"0 < time_step <= control_period = {self.control_period}"
            raise ConfigurationError("time_step", self.time_step, valid)
        ratio = self.control_period / self.time_step
        if abs(ratio - round(ratio)) > 1e-6:
            valid = f"a whole fraction of control_period = {self.control_period}"
            raise ConfigurationError("time_step", self.time_step, valid)
        if self.iterations < 1:
            raise ConfigurationError("iterations", self.iterations, "1 or more")
        if not 0 < self.erp <= 1:
            raise ConfigurationError("erp", self.erp, "0 < erp <= 1")

    @property
    def substeps(self) -> int:
        """Time steps in a control period."""
        return round(self.control_period / self.time_step)


def spline_weights(substeps: int) -> FloatArray:
    """(substeps, 3) weights of the last three commands along the quadratic B-spline."""
    s = np.arange(1, substeps + 1) / substeps
    return np.stack([(1 - s) ** 2, 1 + 2 * s - 2 * s**2, s**2], axis=1) / 2


def rotate(quaternion: Quaternion, vector: Vector) -> Vector:
    """A vector turned by a unit quaternion (x, y, z, w); plain numbers, for speed."""
    x, y, z, w = quaternion
    a, b, c = vector
    # v + w t + q x t, with t = 2 q x v
    s, t, u = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return (
        a + w * s + y * u - z * t,
        b + w * t + z * s - x * u,
        c + w * u + x * t - y * s,
    )


def transform(origin: Vector, quaternion: Quaternion, point: Vector) -> Vector:
    """A point of a frame in the frame's parent, m."""
    a, b, c = rotate(quaternion, point)
    return origin[0] + a, origin[1] + b, origin[2] + c
