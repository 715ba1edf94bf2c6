"""Settings that users give as a value or, as configuration files have it, as a mapping."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, TypeVar

from tpm_gym.errors import ConfigurationError

__all__ = ["settings_of"]

T = TypeVar("T")


def settings_of(kind: type[T], name: str, value: Any) -> T:
    """A dataclass of settings: ``value`` itself, made from a mapping, or for None the defaults.

    Raises:
        ConfigurationError: If it is anything else, has other keys, or a value is out of range.
    """
    if isinstance(value, kind):
        return value
    names = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    if value is None or (isinstance(value, Mapping) and set(value) <= set(names)):
        return kind(**(value or {}))
    valid = f"None, a {kind.__name__}, or a mapping with keys among {', '.join(names)}"
    raise ConfigurationError(name, value, valid)
