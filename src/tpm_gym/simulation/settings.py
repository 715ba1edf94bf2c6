"""Numerical settings that all engines share, and their conversion from mappings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeVar

from tpm_gym.arrays import is_number
from tpm_gym.errors import ConfigurationError

T = TypeVar("T")

_SHORTEST = 1e-6  # s; a control step with a shorter time step would take minutes


def settings_of(kind: type[T], name: str, value: Any) -> T:
    """Return settings as an instance of the dataclass ``kind``.

    Args:
        kind: Dataclass of settings.
        name: Name of the option in error messages.
        value: An instance of ``kind``, a mapping of its fields, or None for the defaults.

    Raises:
        ConfigurationError: If ``value`` is none of these, or has an unknown field or a field that
            is out of range.
    """
    if isinstance(value, kind):
        return value
    names = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    if value is None or (isinstance(value, Mapping) and set(value) <= set(names)):
        return kind(**(value or {}))
    full = f"{kind.__module__}.{kind.__name__}"
    valid = f"None, a {full}, or a mapping with keys among {', '.join(names)}"
    raise ConfigurationError(name, value, valid)


@dataclass(frozen=True)
class Numerics:
    """Numerical settings of all engines.

    Attributes:
        time_step: Time step, s; the control period must be an integer multiple of it.

    Raises:
        ConfigurationError: If the time step is too short, or is not a number.
    """

    time_step: float = 1 / 250

    def __post_init__(self) -> None:
        """Check the time step."""
        if not is_number(self.time_step):
            raise ConfigurationError("time_step", self.time_step, "a finite number")
        if self.time_step < _SHORTEST:
            raise ConfigurationError("time_step", self.time_step, f"at least {_SHORTEST} s")


def count_steps(control_period: float, time_step: float, least: int = 1) -> int:
    """Return the number of time steps in a control period; both are given in s.

    Raises:
        ConfigurationError: If the number is not whole, or is below ``least``.
    """
    steps = control_period / time_step
    if round(steps) < least or abs(steps - round(steps)) >= 1e-6:
        whole = f"a whole number, {least} or more"
        valid = f"{control_period:g} s (control period) divided by {whole}"
        raise ConfigurationError("time_step", time_step, valid)
    return round(steps)
