"""Numerical settings of MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass

from tpm_gym.simulation.settings import Numerics, require_numerics

__all__ = ["Physics"]


@dataclass(frozen=True)
class Physics(Numerics):
    """Numerical settings of the engine.

    Attributes:
        time_step: s; a whole fraction of the control period.
        iterations: Largest number of iterations of the solver (Newton's method) in a time step.
        tolerance: Improvement below which the solver stops, in MuJoCo's unit.

    Raises:
        ConfigurationError: If a value is out of range.
    """

    iterations: int = 50
    tolerance: float = 1e-10

    def __post_init__(self) -> None:
        """Reject impossible settings."""
        require_numerics(self, {"tolerance": (lambda value: 0 <= value < 1, "0 <= tolerance < 1")})
