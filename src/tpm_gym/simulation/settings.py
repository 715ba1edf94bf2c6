"""Numerical settings that all engines share, and their conversion from mappings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeVar

from tpm_gym.arrays import is_number, is_whole
from tpm_gym.errors import ConfigurationError

T = TypeVar("T")

_SHORTEST = 1e-6  # s; a control step with a shorter time step would take minutes


def settings_of(kind: type[T], name: str, value: Any) -> T:
    """Convert a ``kind``, a mapping of its fields, or None (the defaults) into a ``kind``.

    Raises:
        ConfigurationError: If ``value`` is none of these, has unknown keys, or is out of range.
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
    """

    time_step: float = 1 / 250


def count_steps(control_period: float, time_step: float, least: int = 1) -> int:
    """Return the number of time steps (s) in a control period (s).

    Raises:
        ConfigurationError: If it is no whole number, or below ``least``.
    """
    steps = control_period / time_step
    if round(steps) < least or abs(steps - round(steps)) >= 1e-6:
        whole = f"a whole number, {least} or more"
        valid = f"{control_period:g} s (control period) divided by {whole}"
        raise ConfigurationError("time_step", time_step, valid)
    return round(steps)


def require_numerics(
    settings: Numerics, ranges: Mapping[str, tuple[Callable[[float], bool], str]]
) -> None:
    """Check the time step, the number of iterations (if any), and further settings.

    Args:
        settings: Settings of an engine.
        ranges: Check and description of the valid range, for each further setting.

    Raises:
        ConfigurationError: If a value is out of range.
    """
    for name in ("time_step", *ranges):
        if not is_number(value := getattr(settings, name)):
            raise ConfigurationError(name, value, "a finite number")
    step, count = settings.time_step, getattr(settings, "iterations", 1)
    if step < _SHORTEST:
        raise ConfigurationError("time_step", step, f"at least {_SHORTEST} s")
    if not is_whole(count, 1):
        raise ConfigurationError("iterations", count, "a whole number, 1 or more")
    for name, (fits, valid) in ranges.items():
        if not fits(getattr(settings, name)):
            raise ConfigurationError(name, getattr(settings, name), valid)
