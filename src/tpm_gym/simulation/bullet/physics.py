"""Numerical settings of PyBullet."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral, Real

from tpm_gym.errors import ConfigurationError
from tpm_gym.simulation.state import CONTROL_PERIOD

__all__ = ["Physics"]

SOLVERS = ("direct", "iterative")
REGULARISATION = 1e-9
"""Added to the constraints' compliance (CFM): loops that close twice over stay solvable."""
MOTOR_GAIN = 1.0
"""Share of the position error that a motor takes out in one time step, effort permitting."""


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
