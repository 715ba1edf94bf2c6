"""Numerical settings of PyBullet."""

from __future__ import annotations

from dataclasses import dataclass

from tpm_gym.arrays import is_number, is_whole
from tpm_gym.errors import ConfigurationError
from tpm_gym.simulation.settings import Numerics

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
        iterations: Number of iterations of the iterative solver in each time step. With 25
            iterations, loops sometimes open.
        erp: Fraction of a constraint's error that is removed in one time step, in (0, 1].

    Raises:
        ConfigurationError: If a value is out of range.
    """

    solver: str = "direct"
    iterations: int = 50
    erp: float = 1.0

    def __post_init__(self) -> None:
        """Check the settings."""
        super().__post_init__()
        if not is_whole(self.iterations, 1):
            raise ConfigurationError("iterations", self.iterations, "a whole number, 1 or more")
        if not is_number(self.erp) or not 0 < self.erp <= 1:
            raise ConfigurationError("erp", self.erp, "0 < erp <= 1")
        if self.solver not in SOLVERS:
            raise ConfigurationError("solver", self.solver, " or ".join(map(repr, SOLVERS)))
