"""Numerical settings of MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass

from tpm_gym.arrays import is_number, is_whole
from tpm_gym.errors import ConfigurationError
from tpm_gym.simulation.settings import Numerics


@dataclass(frozen=True)
class Physics(Numerics):
    """Numerical settings of MuJoCo.

    Attributes:
        time_step: Time step, s; the control period must be an integer multiple of it.
        iterations: Largest number of iterations of the solver (Newton's method) per time step.
        tolerance: MuJoCo's option ``tolerance``. The solver stops when an iteration lowers the
            solver's scaled cost function by less than this value.

    Raises:
        ConfigurationError: If a value is out of range.
    """

    iterations: int = 50
    tolerance: float = 1e-10

    def __post_init__(self) -> None:
        """Check the settings."""
        super().__post_init__()
        if not is_whole(self.iterations, 1):
            raise ConfigurationError("iterations", self.iterations, "a whole number, 1 or more")
        if not is_number(self.tolerance) or not 0 <= self.tolerance < 1:
            raise ConfigurationError("tolerance", self.tolerance, "0 <= tolerance < 1")
