"""Numerical settings of MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass

from tpm_gym.simulation.settings import Numerics, require_numerics


@dataclass(frozen=True)
class Physics(Numerics):
    """Numerical settings of MuJoCo.

    Attributes:
        time_step: Time step, s; the control period must be an integer multiple of it.
        iterations: Largest number of iterations of the solver (Newton's method) per time step.
        tolerance: The solver stops when an iteration improves the cost by less (MuJoCo's unit).

    Raises:
        ConfigurationError: If a value is out of range.
    """

    iterations: int = 50
    tolerance: float = 1e-10

    def __post_init__(self) -> None:
        """Check the settings."""
        require_numerics(self, {"tolerance": (lambda value: 0 <= value < 1, "0 <= tolerance < 1")})
