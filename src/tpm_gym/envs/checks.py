"""Checks of what users hand to an environment; each returns the value in the form we use."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tpm_gym.errors import ActionError, ConfigurationError, InputError, ResetOptionError
from tpm_gym.simulation.physics import CONTROL_PERIOD, Physics

__all__ = ["action", "physics", "picture_size", "reset_options", "snapshot", "weight"]


def action(value: Any, size: int) -> NDArray[np.float64]:
    """A finite action (size,), clipped to [-1, 1].

    Raises:
        ActionError: If it has another shape or is not finite.
    """
    try:
        values = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ActionError("action", value, f"an array of numbers of shape ({size},)") from error
    if values.shape != (size,):
        raise ActionError("action", values.shape, f"of shape ({size},), by shape")
    if not np.isfinite(values).all():
        raise ActionError("action", values.tolist(), "finite")
    clipped: NDArray[np.float64] = np.minimum(np.maximum(values, -1.0), 1.0)
    return clipped


def weight(value: Any) -> float:
    """A finite weight of the penalty, zero or more.

    Raises:
        ConfigurationError: If it is anything else.
    """
    if not isinstance(value, (int, float, np.number)) or not 0 <= float(value) < np.inf:
        raise ConfigurationError("penalty_weight", value, "a finite number >= 0")
    return float(value)


def physics(value: Any) -> None:
    """Settings of the engine that fit the 25 Hz of the environments, or None for the default.

    Raises:
        ConfigurationError: If it is anything else.
    """
    if value is None:
        return
    if not isinstance(value, Physics):
        raise ConfigurationError("physics", value, "a tpm_gym.simulation.physics.Physics, or None")
    if value.control_period != CONTROL_PERIOD:
        valid = f"a control_period of {CONTROL_PERIOD} s, which the tasks are made for"
        raise ConfigurationError("physics", value, valid)


def picture_size(width: Any, height: Any) -> tuple[int, int]:
    """Width and height of a picture in pixels.

    Raises:
        ConfigurationError: If one is not a whole number from 16 to 4096.
    """
    for name, value in (("width", width), ("height", height)):
        if not (isinstance(value, (int, np.integer)) and 16 <= value <= 4096):
            raise ConfigurationError(name, value, "a whole number of pixels from 16 to 4096")
    return int(width), int(height)


def snapshot(value: Any, kind: type[Any], own: tuple[Any, ...]) -> None:
    """A snapshot that an environment of this task, randomisation and physics took.

    Raises:
        InputError: If it is anything else.
    """
    if not isinstance(value, kind):
        raise InputError("snapshot", value, "what save_state() returned")
    if value.kind != own:
        raise InputError("snapshot", value.kind, f"of the same task and options, {own}")


def reset_options(options: Any) -> dict[str, Any]:
    """The options of a reset, keys checked; the task checks their values.

    Raises:
        ResetOptionError: If it is no dictionary or has unknown keys.
    """
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise ResetOptionError("options", options, "a dictionary with the keys 'object', 'goal'")
    for key, value in options.items():
        if key not in ("object", "goal"):
            raise ResetOptionError(str(key), value, "the keys 'object' and 'goal'")
    return dict(options)
