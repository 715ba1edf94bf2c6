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
        time_step: s; a whole fraction of the control period.
        solver: ``"direct"`` solves the constraints of a step exactly (Dantzig's pivoting);
            ``"iterative"`` is Bullet's default, sequential impulses.
        iterations: Of the iterative solver, a step; with 25 the mechanism is lost now and then.
        erp: Share of a constraint's error that is taken out in one step, in (0, 1].

    Raises:
        ConfigurationError: If a value is out of range.
    """

    time_step: float = 1 / 250
    solver: str = "direct"
    iterations: int = 50
    erp: float = 1.0

    def __post_init__(self) -> None:
        """Reject settings that cannot work."""
        for name in ("time_step", "erp"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
                raise ConfigurationError(name, value, "a finite number")
        whole = isinstance(self.iterations, Integral) and not isinstance(self.iterations, bool)
        steps = CONTROL_PERIOD / self.time_step if self.time_step > 0 else 0.0
        for name, fits, valid in (
            ("time_step", round(steps) >= 1 and abs(steps - round(steps)) < 1e-6,
             f"a whole fraction of the control period, {CONTROL_PERIOD} s"),
            ("solver", self.solver in SOLVERS, " or ".join(map(repr, SOLVERS))),
            ("iterations", whole and self.iterations >= 1, "a whole number, 1 or more"),
            ("erp", 0 < self.erp <= 1, "0 < erp <= 1"),
        ):  # fmt: skip
            if not fits:
                raise ConfigurationError(name, getattr(self, name), valid)

    @property
    def substeps(self) -> int:
        """Time steps in a control period."""
        return round(CONTROL_PERIOD / self.time_step)
