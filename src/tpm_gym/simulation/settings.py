"""Settings that users give as a value or, as configuration files have it, as a mapping."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeVar

from tpm_gym.arrays import is_number, is_whole
from tpm_gym.errors import ConfigurationError
from tpm_gym.simulation.state import CONTROL_PERIOD

__all__ = ["Numerics", "require_numerics", "settings_of"]

T = TypeVar("T")

_SHORTEST = 1e-6  # s; with shorter time steps a control step takes minutes


def settings_of(kind: type[T], name: str, value: Any) -> T:
    """Return settings of a kind: ``value`` itself, a mapping as settings, or for None the defaults.

    Raises:
        ConfigurationError: If the value is another, has other keys, or is out of range.
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
    """Settings that every engine has.

    Attributes:
        time_step: s; a whole fraction of the control period.
    """

    time_step: float = 1 / 250

    @property
    def substeps(self) -> int:
        """Time steps in a control period."""
        return round(CONTROL_PERIOD / self.time_step)


def require_numerics(
    settings: Numerics, ranges: Mapping[str, tuple[Callable[[float], bool], str]]
) -> None:
    """Raise if a time step, a number of iterations or another number is not possible.

    Args:
        settings: Settings of an engine; ``iterations`` are optional.
        ranges: For each other number a check, and the range in words.

    Raises:
        ConfigurationError: If a value is out of range.
    """
    for name in ("time_step", *ranges):
        if not is_number(value := getattr(settings, name)):
            raise ConfigurationError(name, value, "a finite number")
    step, count = settings.time_step, getattr(settings, "iterations", 1)
    steps = CONTROL_PERIOD / step if step > 0 else 0.0
    if step < _SHORTEST or round(steps) < 1 or abs(steps - round(steps)) >= 1e-6:
        valid = (
            f"a whole fraction of the control period, {CONTROL_PERIOD} s; at least {_SHORTEST} s"
        )
        raise ConfigurationError("time_step", step, valid)
    if not is_whole(count, 1):
        raise ConfigurationError("iterations", count, "a whole number, 1 or more")
    for name, (fits, valid) in ranges.items():
        if not fits(getattr(settings, name)):
            raise ConfigurationError(name, getattr(settings, name), valid)
