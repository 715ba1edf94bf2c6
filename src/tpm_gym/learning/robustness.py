"""How far a machine may differ until success has halved, found by bisection.

Each attribute of :class:`~tpm_gym.simulation.randomisation.Randomisation` is taken alone, from its
nominal value towards each end of what it may be; factors are fixed, and bisected on a logarithmic
scale.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from tpm_gym.simulation.randomisation import LIMITS, Randomisation

OF_SERVOS: Final = ("servo_stiffness", "joint_friction")
"""Attributes that only servo drives have."""
OF_PUCK: Final = ("puck_mass", "friction")
"""Attributes that change nothing where there is no puck."""
UNITS: Final = {
    "encoder_noise": "rad",
    "encoder_bias": "rad",
    "length_error": "m",
    "joint_friction": "N m",
    "latency": "control steps",
}
"""Of the attributes that are no factors."""

_PARTS: Final = 64  # of the way from nominal to an end


def nominal(attribute: str) -> float:
    """The value of an attribute at which nothing differs."""
    value = getattr(Randomisation(), attribute)
    return float(value[0] if isinstance(value, tuple) else value)


def ends(attribute: str) -> list[float]:
    """The ends, other than nominal, of what an attribute may be."""
    return [end for end in LIMITS[attribute] if end != nominal(attribute)]


@dataclass(frozen=True)
class Halving:
    """How far a bisection towards one end has come.

    Attributes:
        before: The farthest value with more than half the nominal success, of those that count.
        after: The next one, with half of it or less; None where ``end`` has more, or is not known.
        missing: The value to test next; None at the end of the bisection.
    """

    end: float
    before: float
    after: float | None
    missing: float | None


def halving(attribute: str, end: float, successes: Mapping[float, float]) -> Halving:
    """Bisect as far as the successes known, by value, allow."""
    start = nominal(attribute)
    for value in (start, end):
        if value not in successes:
            return Halving(end, start, None, value)
    half = successes[start] / 2
    if successes[end] > half:
        return Halving(end, end, None, None)
    values = _way(attribute, start, end)
    near, far, missing = 0, len(values) - 1, None
    while far - near > 1 and missing is None:
        middle = (near + far) // 2
        if values[middle] not in successes:
            missing = values[middle]
        elif successes[values[middle]] > half:
            near = middle
        else:
            far = middle
    return Halving(end, values[near], values[far], missing)


def _way(attribute: str, start: float, end: float) -> list[float]:
    """The values from nominal to an end, to four digits: what commands can be given."""
    if attribute == "latency":
        return [float(steps) for steps in range(int(end) + 1)]
    shares = [part / _PARTS for part in range(_PARTS + 1)]
    way = [start * (end / start) ** share if start else end * share for share in shares]
    return [float(f"{value:.4g}") for value in way]
