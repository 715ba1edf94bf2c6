"""Every error that tpm_gym raises on purpose.

One root, so that ``except TPMError`` catches all of them; each leaf also derives from the built-in
exception that a caller would expect, and carries the offending values as attributes, so that a
program can react without parsing the message.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

__all__ = [
    "ActionError",
    "AssemblyModeError",
    "ClosureError",
    "ConfigurationError",
    "EpisodeError",
    "GeometryError",
    "InputError",
    "ResetOptionError",
    "SingularityError",
    "TPMError",
    "UnreachableError",
]


class TPMError(Exception):
    """Root of all errors raised by tpm_gym. They survive pickling, as between worker processes."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Rebuild from the message and the attributes, not by calling ``__init__`` again."""
        return _rebuild, (type(self), self.args, vars(self))


def _rebuild(kind: type[TPMError], args: tuple[Any, ...], values: dict[str, Any]) -> TPMError:
    error = kind.__new__(kind, *args)
    error.args = args
    vars(error).update(values)
    return error


class GeometryError(TPMError, ValueError):
    """A link length, or a combination of them, makes no usable mechanism.

    Attributes:
        name: The offending length, or the combination, e.g. ``"l4"``.
        value: Its value in metres.
        requirement: What would be valid.
    """

    def __init__(self, name: str, value: float, requirement: str) -> None:
        """Store the values and compose the message."""
        self.name, self.value, self.requirement = name, value, requirement
        super().__init__(f"geometry: {name} = {value!r} m, but {requirement}")


class InputError(TPMError, ValueError):
    """An argument has the wrong shape or holds values that are not finite.

    Attributes:
        name: The argument.
        value: What was given.
        requirement: What would be valid.
    """

    def __init__(self, name: str, value: Any, requirement: str) -> None:
        """Store the values and compose the message."""
        self.name, self.value, self.requirement = name, value, requirement
        super().__init__(f"{name} must be {requirement}, got {value!r}")


class ActionError(InputError):
    """An action has the wrong shape or is not finite; the simulation was not touched."""


class ConfigurationError(TPMError, ValueError):
    """A constructor option is unknown or out of range.

    Attributes:
        name: The option.
        value: What was given.
        valid: What would be valid.
    """

    def __init__(self, name: str, value: Any, valid: str) -> None:
        """Store the values and compose the message."""
        self.name, self.value, self.valid = name, value, valid
        super().__init__(f"{name} = {value!r} is not possible; valid: {valid}")


class ResetOptionError(ConfigurationError):
    """``reset(options=...)`` holds an unknown key or a value of the wrong form."""


class EpisodeError(TPMError, RuntimeError):
    """``step`` or ``render`` was called before ``reset``, or after ``close`` or a failed step."""


class UnreachableError(TPMError, ValueError):
    """No solution of the kinematics exists for the input on the branch that was asked for.

    Attributes:
        point: The offending point (m) or joint angles (rad).
        leg: What fails: ``"beta"``, ``"leg 1"`` ... or ``"box"`` for the task's region.
        margin: By how much it fails, m; negative.
    """

    def __init__(self, point: Sequence[float], leg: str, margin: float, hint: str) -> None:
        """Store the values and compose the message."""
        self.point, self.leg, self.margin = tuple(float(v) for v in point), leg, float(margin)
        shown = ", ".join(f"{v:.4g}" for v in self.point)
        super().__init__(
            f"({shown}) cannot be reached: {leg} fails by {-self.margin:.4g} m; {hint}"
        )


class SingularityError(TPMError, ValueError):
    """A quantity that does not exist at a singularity was asked for there.

    Attributes:
        factor: The factor of the Jacobian determinant that vanishes.
        value: Its value there.
    """

    def __init__(self, factor: str, value: float) -> None:
        """Store the values and compose the message."""
        self.factor, self.value = factor, float(value)
        super().__init__(
            f"singular configuration: {factor} = {self.value:.3g}; stay where the conditioning is "
            "above zero (tpm_gym.jacobian.conditioning)"
        )


class ClosureError(TPMError, RuntimeError):
    """A kinematic loop of the simulated mechanism has opened; the episode is void.

    Attributes:
        gap: The largest loop gap in metres.
        limit: The gap that is tolerated, in metres.
    """

    def __init__(self, gap: float, limit: float) -> None:
        """Store the values and compose the message."""
        self.gap, self.limit = float(gap), float(limit)
        super().__init__(
            f"a loop of the simulated mechanism is open by {1e3 * self.gap:.3g} mm, more than "
            f"{1e3 * self.limit:.3g} mm; call reset() to go on"
        )


class AssemblyModeError(TPMError, RuntimeError):
    """The simulated mechanism left the assembly mode that the forward kinematics assume.

    Attributes:
        distance: Platform against forward kinematics, in metres.
        limit: The distance that is tolerated, in metres.
    """

    def __init__(self, distance: float, limit: float) -> None:
        """Store the values and compose the message."""
        self.distance, self.limit = float(distance), float(limit)
        super().__init__(
            f"platform and forward kinematics are {1e3 * self.distance:.3g} mm apart, more than "
            f"{1e3 * self.limit:.3g} mm: the mechanism passed a parallel singularity into another "
            "assembly mode; call reset() to go on"
        )
