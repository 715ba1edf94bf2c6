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
    "ClosureError",
    "ConfigurationError",
    "EpisodeError",
    "GeometryError",
    "InputError",
    "MissingPackageError",
    "ModeChangeError",
    "PolicyFileError",
    "PolicyMismatchError",
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
            "above zero (tpm_gym.kinematics.jacobian.conditioning)"
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


class ModeChangeError(TPMError, RuntimeError):
    """The simulated mechanism has passed a singularity in this episode, and was asked to go on.

    Attributes:
        mode: ``"assembly"``: it passed a parallel singularity, and the forward kinematics no longer
            say where the platform is; ``"working"``: it passed a serial one, and the inverse
            kinematics no longer say how to get where.
    """

    def __init__(self, mode: str) -> None:
        """Store the value and compose the message."""
        self.mode = mode
        kind = "parallel" if mode == "assembly" else "serial"
        super().__init__(
            f"the mechanism passed a {kind} singularity into another {mode} mode; "
            "call reset() to go on"
        )


class PolicyFileError(TPMError, ValueError):
    """The files of a policy are missing, damaged, or not what they have to be; nothing was loaded.

    Attributes:
        path: The offending file.
        reason: What is wrong with it.
        remedy: What to do about it.
    """

    def __init__(self, path: str, reason: str, remedy: str) -> None:
        """Store the values and compose the message."""
        self.path, self.reason, self.remedy = path, reason, remedy
        super().__init__(f"policy file {path}: {reason}; {remedy}")


class PolicyMismatchError(TPMError, ValueError):
    """A policy does not fit an environment.

    Attributes:
        kind: What differs: ``"observation space"``, ``"action space"`` or ``"control"``.
        trained: What the policy was trained with.
        given: What the environment has.
        env_id: The environment the policy was trained on, which would be valid.
    """

    def __init__(self, kind: str, trained: Any, given: Any, env_id: str) -> None:
        """Store the values and compose the message."""
        self.kind, self.trained, self.given, self.env_id = kind, trained, given, env_id
        super().__init__(
            f"the policy was trained with {kind} {trained}, the environment has {given}; "
            f"use it in {env_id}"
        )


class MissingPackageError(TPMError, ImportError):
    """An optional package is needed for this and is not installed.

    Attributes:
        package: The package.
        extra: The extra of tpm-gym that installs it.
    """

    def __init__(self, package: str, extra: str) -> None:
        """Store the values and compose the message."""
        self.package, self.extra = package, extra
        super().__init__(
            f"this needs {package}, which cannot be imported; pip install 'tpm-gym[{extra}]'"
        )
