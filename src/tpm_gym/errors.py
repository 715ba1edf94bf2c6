"""Errors that tpm_gym raises on purpose.

``except TPMError`` catches all of them. Each error also derives from the built-in exception that a
caller would expect, and has the offending values as attributes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

_LONGEST = 200  # characters of a value in a message


def brief(value: Any) -> Any:
    """Return a value for a message; a long value is cut after its beginning."""
    try:
        text = repr(value)
    except Exception as error:  # integers beyond 4300 digits, and any other repr() that fails
        return f"{type(value).__name__} ({error})"
    return value if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


class TPMError(Exception):
    """Base class of all errors raised by tpm_gym.

    The errors can be pickled, for example to pass them between processes. Errors with values are
    dataclasses; :attr:`template` formats the values as a message.
    """

    template: ClassVar[str] = ""

    def __str__(self) -> str:
        """Return the message."""
        if not self.template:
            return super().__str__()
        try:
            return self.template.format(**vars(self))
        except Exception:  # a value without a repr()
            return self.template.format(**{name: brief(v) for name, v in vars(self).items()})


@dataclass(eq=False)
class GeometryError(TPMError, ValueError):
    """A link length, such as ``"l4"``, or a combination of lengths makes no usable mechanism."""

    template: ClassVar[str] = "geometry: {name} = {value!r} m, but {requirement}"
    name: str
    value: float  # m
    requirement: str


@dataclass(eq=False)
class InputError(TPMError, ValueError):
    """An argument has the wrong shape, or holds values that are no finite real numbers."""

    template: ClassVar[str] = "{name} must be {requirement}, got {value!r}"
    name: str
    value: Any
    requirement: str


class ActionError(InputError):
    """An action has the wrong shape or is not finite; the simulation was not touched."""


@dataclass(eq=False)
class ConfigurationError(TPMError, ValueError):
    """An option is unknown or out of range."""

    template: ClassVar[str] = "{name} = {value!r} is not possible; valid: {valid}"
    name: str
    value: Any
    valid: str


class ResetOptionError(ConfigurationError):
    """``reset(options=...)`` holds an unknown key or a value of the wrong form."""


class EpisodeError(TPMError, RuntimeError):
    """``step`` or ``render`` was called before ``reset``, or after ``close`` or a failed step."""


@dataclass(eq=False)
class UnreachableError(TPMError, ValueError):
    """The kinematics have no solution for the input in the requested mode."""

    point: Sequence[float]  # m, or joint angles, rad
    leg: str  # what fails: "beta", "leg 1" ..., or "box" for the task's region
    margin: float  # by how much, m; negative
    hint: str
    index: tuple[int, ...] = ()  # of the point in the array; empty for a single point

    def __post_init__(self) -> None:
        """Convert the numbers to plain floats."""
        self.point = tuple(float(value) for value in self.point)
        self.margin = float(self.margin)

    def __str__(self) -> str:
        """Return the message."""
        shown = ", ".join(f"{value:.4g}" for value in self.point)
        far = f"{-self.margin:.4g} m"
        reason = f"it is {far} outside" if self.leg == "box" else f"{self.leg} fails by {far}"
        row = f" at index {', '.join(map(str, self.index))}" if self.index else ""
        return f"({shown}){row} cannot be reached: {reason}; {self.hint}"


@dataclass(eq=False)
class JointLimitError(TPMError, ValueError):
    """A posture lies beyond a stop of a motor."""

    template: ClassVar[str] = (
        "joint {joint} cannot be at {position:.6g} {unit}: its stops are at {lower:.6g} and "
        "{upper:.6g} {unit}; choose a posture between them"
    )
    joint: str
    position: float
    lower: float
    upper: float
    unit: str  # "rad", or "m" for a slide


@dataclass(eq=False)
class SingularityError(TPMError, ValueError):
    """The requested quantity does not exist, because the configuration is singular."""

    template: ClassVar[str] = (
        "singular configuration: {factor} = {value:.3g}; stay where the conditioning is above zero "
        "(tpm_gym.kinematics.jacobian.conditioning)"
    )
    factor: str  # of the Jacobian's determinant
    value: float


@dataclass(eq=False)
class ClosureError(TPMError, RuntimeError):
    """A kinematic loop of the simulated mechanism has opened; the episode is void."""

    template: ClassVar[str] = (
        "a loop of the simulated mechanism is open by {gap:.3g} m, more than {limit:.3g} m; call "
        "reset() to go on"
    )
    gap: float  # m
    limit: float  # m


@dataclass(eq=False)
class ModeChangeError(TPMError, RuntimeError):
    """A step was requested although the mechanism had passed a singularity in this episode.

    Mode ``"assembly"``: beyond a parallel singularity, the forward kinematics no longer give the
    platform's position. Mode ``"working"``: beyond a serial singularity, the inverse kinematics no
    longer give the joint positions.
    """

    template: ClassVar[str] = (
        "the mechanism passed a singularity into another {mode} mode; call reset() to go on"
    )
    mode: str


@dataclass(eq=False)
class ConformanceError(TPMError, AssertionError):
    """An environment fails a conformance check of :mod:`tpm_gym.envs.testing`."""

    template: ClassVar[str] = "environments promise that {promise}; here, {found}"
    promise: str
    found: str


@dataclass(eq=False)
class PolicyFileError(TPMError, ValueError):
    """The files of a policy are missing, damaged or invalid; nothing was loaded."""

    template: ClassVar[str] = "policy file {path}: {reason}; {remedy}"
    path: str
    reason: str
    remedy: str


@dataclass(eq=False)
class PolicyMismatchError(TPMError, ValueError):
    """The policy does not fit the environment; it was trained in ``env_id``."""

    template: ClassVar[str] = (
        "the policy was trained with {kind} {trained}, the environment has {given}; use it in "
        "{env_id}"
    )
    kind: str  # "observation space", "action space" or "control"
    trained: Any
    given: Any
    env_id: str


@dataclass(eq=False)
class MissingPackageError(TPMError, ImportError):
    """An optional package is needed, but is not installed.

    ``extra`` names the extra of tpm-gym that installs the package.
    """

    template: ClassVar[str] = (
        "this needs {package}, which cannot be imported; pip install 'tpm-gym[{extra}]'{hint}"
    )
    package: str
    extra: str
    hint: str = ""
