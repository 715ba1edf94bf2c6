"""Numerical settings of the analytic engine."""

from __future__ import annotations

from dataclasses import dataclass

from tpm_gym.errors import ConfigurationError
from tpm_gym.simulation.settings import Numerics, require_numerics
from tpm_gym.simulation.state import CONTROL_PERIOD

__all__ = ["Physics"]

TORQUES = ("none", "last", "every")


@dataclass(frozen=True)
class Physics(Numerics):
    """Numerical settings of the engine.

    Attributes:
        time_step: s; a whole fraction of the control period, a third of it at most.
        torques: Time steps of a control period for which the motors' torques are computed and
            compared with the motors' effort: ``"none"`` (the State's torques are NaN, and ideal
            motors have no limit), ``"last"`` or ``"every"``. Every time step is computed where the
            last torque is more than half of a motor's effort. Servo drives always compute theirs.

    Raises:
        ConfigurationError: If a value is out of range.
    """

    torques: str = "last"

    def __post_init__(self) -> None:
        """Reject impossible settings."""
        require_numerics(self, {})
        if self.substeps < 3:
            raise ConfigurationError("time_step", self.time_step, f"at most {CONTROL_PERIOD} s / 3")
        if self.torques not in TORQUES:
            raise ConfigurationError("torques", self.torques, ", ".join(map(repr, TORQUES)))
