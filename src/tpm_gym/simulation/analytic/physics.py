"""Numerical settings of the analytic engine."""

from __future__ import annotations

from dataclasses import dataclass

from tpm_gym.errors import ConfigurationError
from tpm_gym.simulation.settings import Numerics

TORQUES = ("none", "last", "every")


@dataclass(frozen=True)
class Physics(Numerics):
    """Numerical settings of the analytic engine.

    Attributes:
        time_step: Time step, s; the control period must have a whole number of time steps, 3 or
            more.
        torques: Time steps in which the torques of ideal motors are computed and compared with the
            motors' largest torques. ``"none"``: torques are not limited, and are NaN in the State.
            ``"last"``: the last time step of a control period. If a motor's torque in this time
            step is above half of the motor's largest torque, the other time steps of the period are
            checked too. ``"every"``: all time steps. For servo drives, and for robots that need
            forward dynamics, torques are always computed and limited in all time steps.

    Raises:
        ConfigurationError: If a value is out of range.
    """

    torques: str = "last"

    def __post_init__(self) -> None:
        """Check the settings."""
        super().__post_init__()
        if self.torques not in TORQUES:
            raise ConfigurationError("torques", self.torques, ", ".join(map(repr, TORQUES)))
