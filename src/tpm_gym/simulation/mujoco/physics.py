"""Numerical settings of MuJoCo."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral, Real

from tpm_gym.errors import ConfigurationError
from tpm_gym.simulation.state import CONTROL_PERIOD

__all__ = ["Physics"]


@dataclass(frozen=True)
class Physics:
    """Numerical settings of the engine.

    Attributes:
        time_step: s; a whole fraction of the control period.
        iterations: Most of the solver (Newton's method), a step.
        tolerance: Of the solver: it ends where a step gains less, in units of MuJoCo's.

    Raises:
        ConfigurationError: If a value is out of range.
    """

    time_step: float = 1 / 250
    iterations: int = 50
    tolerance: float = 1e-10

    def __post_init__(self) -> None:
        """Reject settings that cannot work."""
        for name in ("time_step", "tolerance"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
                raise ConfigurationError(name, value, "a finite number")
        whole = isinstance(self.iterations, Integral) and not isinstance(self.iterations, bool)
        steps = CONTROL_PERIOD / self.time_step if self.time_step > 0 else 0.0
        for name, fits, valid in (
            ("time_step", round(steps) >= 1 and abs(steps - round(steps)) < 1e-6,
             f"a whole fraction of the control period, {CONTROL_PERIOD} s"),
            ("iterations", whole and self.iterations >= 1, "a whole number, 1 or more"),
            ("tolerance", 0 <= self.tolerance < 1, "0 <= tolerance < 1"),
        ):  # fmt: skip
            if not fits:
                raise ConfigurationError(name, getattr(self, name), valid)

    @property
    def substeps(self) -> int:
        """Time steps in a control period."""
        return round(CONTROL_PERIOD / self.time_step)
