"""Numerical settings of PyBullet."""

from __future__ import annotations

from dataclasses import dataclass

from tpm_gym.errors import ConfigurationError
from tpm_gym.simulation.settings import Numerics, require_numerics

__all__ = ["Physics"]

SOLVERS = ("direct", "iterative")
REGULARISATION = 1e-9
"""Added to the constraints' compliance (CFM): loops that close twice over stay solvable."""
MOTOR_GAIN = 1.0
"""Share of the position error that a motor takes out in one time step, effort permitting."""


@dataclass(frozen=True)
class Physics(Numerics):
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

    solver: str = "direct"
    iterations: int = 50
    erp: float = 1.0

    def __post_init__(self) -> None:
        """Reject settings that cannot work."""
        require_numerics(self, {"erp": (lambda value: 0 < value <= 1, "0 < erp <= 1")})
        if self.solver not in SOLVERS:
            raise ConfigurationError("solver", self.solver, " or ".join(map(repr, SOLVERS)))
