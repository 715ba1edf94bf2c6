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

_HALVINGS: Final = 6  # leave a 64th of the way


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
    near, far, missing = 0.0, 1.0, None
    for _ in range(0 if attribute == "latency" else _HALVINGS):
        middle = (near + far) / 2
        value = _on_the_way(start, end, middle)
        if value not in successes:
            missing = value
            break
        near, far = (middle, far) if successes[value] > half else (near, middle)
    return Halving(end, _on_the_way(start, end, near), _on_the_way(start, end, far), missing)


def _on_the_way(start: float, end: float, share: float) -> float:
    """The value at a share of the way, to four digits: what commands can be given."""
    value = start * (end / start) ** share if start else end * share
    return float(f"{value:.4g}")
