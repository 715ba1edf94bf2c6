"""Numerical settings of the closed form."""

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
        time_step: s; a whole fraction of the control period, of which there are three or more.
        torques: Of which time steps of a control period the motors' torques are computed, and
            compared with what the motors have: ``"none"`` (then the State's are NaN, and ideal
            motors never tire), ``"last"`` or ``"every"``. Wherever one is more than half of what
            its motor has, every one is. Servo drives know theirs anyway.

    Raises:
        ConfigurationError: If a value is out of range.
    """

    torques: str = "last"

    def __post_init__(self) -> None:
        """Reject settings that cannot work."""
        require_numerics(self, {})
        if self.substeps < 3:
            raise ConfigurationError("time_step", self.time_step, f"at most {CONTROL_PERIOD} s / 3")
        if self.torques not in TORQUES:
            raise ConfigurationError("torques", self.torques, ", ".join(map(repr, TORQUES)))
