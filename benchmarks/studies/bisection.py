"""Bisection for the difference of a machine at which the success of a policy halves.

Each attribute of :class:`~tpm_gym.simulation.randomisation.Randomisation` is varied alone, from its
nominal value towards each of its limits. Factors are bisected on a logarithmic scale.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from tpm_gym.simulation.randomisation import LIMITS, Randomisation

SERVO_ATTRIBUTES: Final = ("servo_stiffness", "joint_friction")
"""Attributes that only servo drives have."""
OBJECT_ATTRIBUTES: Final = ("block_mass", "friction")
"""Attributes without effect in scenes without objects."""
UNITS: Final = {
    "encoder_noise": "rad",
    "encoder_bias": "rad",
    "length_error": "m",
    "joint_friction": "N m",
    "latency": "control steps",
}
"""Units of the attributes; all others are factors."""

_PARTS: Final = 64  # steps between the nominal value and a limit


def nominal(attribute: str) -> float:
    """Return the value of an attribute on the nominal machine."""
    value = getattr(Randomisation(), attribute)
    return float(value[0] if isinstance(value, tuple) else value)


def ends(attribute: str) -> list[float]:
    """Return the limits of an attribute that differ from its nominal value."""
    return [end for end in LIMITS[attribute] if end != nominal(attribute)]


@dataclass(frozen=True)
class Halving:
    """State of a bisection towards one limit.

    Attributes:
        before: Farthest value with more than half the nominal success.
        after: Next value, with half the nominal success or less; None if there is none up to the
            limit, or the success at the limit is unknown.
        missing: Value to test next; None at the end of the bisection.
    """

    before: float
    after: float | None
    missing: float | None


def halving(attribute: str, end: float, successes: Mapping[float, float]) -> Halving:
    """Bisect as far as the known success rates allow.

    Args:
        attribute: Attribute of the randomisation.
        end: One of its :func:`ends`.
        successes: Success rate of each value that was tested.
    """
    start = nominal(attribute)
    for value in (start, end):
        if value not in successes:
            return Halving(start, None, value)
    half = successes[start] / 2
    if successes[end] > half:
        return Halving(end, None, None)
    values = _values(attribute, start, end)
    near, far = 0, len(values) - 1
    while far - near > 1:
        middle = (near + far) // 2
        if values[middle] not in successes:
            return Halving(values[near], values[far], values[middle])
        near, far = (middle, far) if successes[values[middle]] > half else (near, middle)
    return Halving(values[near], values[far], None)


def _values(attribute: str, start: float, end: float) -> list[float]:
    """Return the values from nominal to a limit, rounded to the four digits of a command."""
    if attribute == "latency":
        return [float(steps) for steps in range(int(end) + 1)]
    shares = [part / _PARTS for part in range(_PARTS + 1)]
    values = [start * (end / start) ** share if start else end * share for share in shares]
    return [float(f"{value:.4g}") for value in values]
