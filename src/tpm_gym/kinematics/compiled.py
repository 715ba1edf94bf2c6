"""The functions of a namespace, for floats in compiled code; see :mod:`tpm_gym.compiling`.

The module itself is the namespace, as compiled functions take it. Importing it lets them call the
functions of :mod:`tpm_gym.kinematics.equations` too.
"""

import math

from tpm_gym.compiling import compilable
from tpm_gym.kinematics import equations

_TURN = 2 * math.pi


def cos(x: float) -> float:
    """Cosine."""
    return math.cos(x)


def sin(x: float) -> float:
    """Sine."""
    return math.sin(x)


def arctan2(y: float, x: float) -> float:
    """Angle of (x, y), rad."""
    return math.atan2(y, x)


def sqrt(x: float) -> float:
    """Square root; NaN for negative numbers."""
    return math.sqrt(x)


def root(x: float) -> float:
    """Square root; 0 for negative numbers."""
    return math.sqrt(x) if x > 0.0 else 0.0


def clip(x: float) -> float:
    """Nearest number in [-1, 1]."""
    return -1.0 if x < -1.0 else 1.0 if x > 1.0 else x


def arccos(x: float) -> float:
    """Arccosine of the clipped number, rad."""
    return math.acos(clip(x))


def maximum(x: float, least: float) -> float:
    """Larger number."""
    return x if x > least else least


def wrap(angle: float) -> float:
    """Angle in (-pi, pi], of one within a turn of that."""
    if -math.pi < angle <= math.pi:
        return angle
    return angle - _TURN if angle > 0 else angle + _TURN


def positive(angle: float) -> float:
    """Angle in [0, 2 pi), of one in [-2 pi, 2 pi)."""
    return angle + _TURN if angle < 0.0 else angle


compilable(cos, sin, arctan2, sqrt, root, clip, arccos, maximum, wrap, positive)
compilable(
    equations.arms,
    equations.assembly_at,
    equations.posture_at,
    equations.fold,
    equations.rods,
    equations.factors,
    equations.regular,
    equations.velocity,
    equations.conditioning,
    equations._largest_singular_value,
)
