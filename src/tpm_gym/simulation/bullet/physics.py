"""Numerical settings of PyBullet."""

from __future__ import annotations

from dataclasses import dataclass

from tpm_gym.errors import ConfigurationError
from tpm_gym.simulation.settings import Numerics, require_numerics

SOLVERS = ("direct", "iterative")
REGULARISATION = 1e-9
"""Compliance of the constraints (CFM). It keeps redundant closures solvable."""
MOTOR_GAIN = 1.0
"""Fraction of the position error that a motor removes in one time step."""


@dataclass(frozen=True)
class Physics(Numerics):
    """Numerical settings of PyBullet.

    Attributes:
        time_step: Time step, s; the control period must be an integer multiple of it.
        solver: ``"direct"`` solves the constraints of a time step exactly (Dantzig's pivoting);
            ``"iterative"`` is Bullet's default, sequential impulses.
        iterations: Iterations of the iterative solver per time step; with 25, loops open sometimes.
        erp: Fraction of a constraint's error that is removed in one time step, in (0, 1].

    Raises:
        ConfigurationError: If a value is out of range.
    """

    solver: str = "direct"
    iterations: int = 50
    erp: float = 1.0

    def __post_init__(self) -> None:
        """Check the settings."""
        require_numerics(self, {"erp": (lambda value: 0 < value <= 1, "0 < erp <= 1")})
        if self.solver not in SOLVERS:
            raise ConfigurationError("solver", self.solver, " or ".join(map(repr, SOLVERS)))
