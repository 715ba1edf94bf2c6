"""Elementary functions (sine, square root and others) of floats, for compiled code.

Compiled equations get this module as their namespace ``ns``. The functions have no branches and
call no library. So the compiler can compute several rows at a time (SIMD), and results do not
depend on a C library. Results are accurate to two units in the last place; results of ``cos_third``
are accurate to four units. The polynomials are minimax fits (Remez's exchange algorithm with 60
digits). A test compares the functions with mpmath.

Importing this module lets compiled functions call :mod:`tpm_gym.kinematics.equations`, too.
"""

import math
from typing import Final

from tpm_gym.compiling import compilable
from tpm_gym.kinematics import equations

_TO_WHOLE: Final = 1.5 * 2.0**52  # adding and subtracting it rounds to a whole number
_TURNS: Final = 2.0**20  # largest number of quarter turns in an angle; beyond it, results are NaN
_TAN_EIGHTH: Final = math.sqrt(2.0) - 1.0
# pi / 2 in parts of 33 bits, so that products with up to 2^20 are exact
_HALF_PI: Final = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21)

# (sin(r) - r) / r^3, (cos(r) - 1 + r^2 / 2) / r^4 and (atan(r) - r) / r^3, in powers of r^2
_SIN: Final = (
    -0.16666666666666627, 0.00833333333332129, -0.00019841269828874797, 2.7557313357684672e-06,
    -2.5050704307296316e-08, 1.5893599718582853e-10,
)  # fmt: skip
_COS: Final = (
    0.04166666666666659, -0.0013888888888872607, 2.4801587288496933e-05, -2.7557314058009806e-07,
    2.0875682078599003e-09, -1.1357459156744013e-11,
)  # fmt: skip
_ATAN: Final = (
    -0.33333333333333326, 0.1999999999999767, -0.14285714285388063, 0.11111111088180593,
    -0.09090908144611733, 0.07692282760217727, -0.06666226776386642, 0.05877021950750067,
    -0.05218405177356696, 0.04503551891838935, -0.03347449766968333, 0.015195178072229086,
)  # fmt: skip
# 2 cos(2 acos(s) / 3), in powers of s
_THIRD: Final = (
    1.0000000000000002, 1.1547005383790816, -0.2222222222031335, 0.106916715665888,
    -0.06584360135145649, 0.045736306766431915, -0.03413837010840357, 0.02672149501934423,
    -0.021584501371655584, 0.01768868223151718, -0.014319050625852188, 0.010981445217420756,
    -0.007552780300062559, 0.0043774596374272995, -0.0019967760257365704, 0.000659295239003116,
    -0.00013839374002220565, 1.3757570208635184e-05,
)  # fmt: skip


def _six(c: tuple[float, ...], k: int, x: float) -> float:
    """Evaluate c[k] + c[k + 1] x + ... + c[k + 5] x^5; there is no loop, for speed."""
    return c[k] + x * (c[k + 1] + x * (c[k + 2] + x * (c[k + 3] + x * (c[k + 4] + x * c[k + 5]))))


def _sin_cos(x: float) -> tuple[float, float, float]:
    """Return sin(r), cos(r) and k, where x = r + k pi / 2 + full turns.

    |r| is at most pi / 4, and k is 0, 1, 2 or 3.
    """
    whole = (x * (2.0 / math.pi) + _TO_WHOLE) - _TO_WHOLE
    whole = whole if abs(whole) <= _TURNS else math.nan
    r = ((x - whole * _HALF_PI[0]) - whole * _HALF_PI[1]) - whole * _HALF_PI[2]
    quarters = whole - 4.0 * ((whole * 0.25 - 0.375 + _TO_WHOLE) - _TO_WHOLE)
    z = r * r
    sine = r + r * z * _six(_SIN, 0, z)
    return sine, 1.0 - 0.5 * z + z * z * _six(_COS, 0, z), quarters


def cos(x: float) -> float:
    """Compute the cosine; NaN if abs(x) is above 1.64 million radians."""
    sine, cosine, quarters = _sin_cos(x)
    value = sine if (quarters == 1.0) | (quarters == 3.0) else cosine
    return -value if (quarters == 1.0) | (quarters == 2.0) else value


def sin(x: float) -> float:
    """Compute the sine; NaN if abs(x) is above 1.64 million radians."""
    sine, cosine, quarters = _sin_cos(x)
    value = cosine if (quarters == 1.0) | (quarters == 3.0) else sine
    return -value if quarters >= 2.0 else value


def arctan2(y: float, x: float) -> float:
    """Compute the angle of (x, y) in (-pi, pi], rad; 0 at the origin."""
    rise, run = abs(y), abs(x)
    steep = rise > run
    low, high = (run, rise) if steep else (rise, run)
    bent = low > _TAN_EIGHTH * high  # then ratio is the tangent of the angle minus pi / 4
    numerator, denominator = (low - high, low + high) if bent else (low, high)
    ratio = numerator / (denominator if denominator != 0.0 else 1.0)
    z = ratio * ratio
    angle = ratio + ratio * z * (_six(_ATAN, 0, z) + (z * z * z) ** 2 * _six(_ATAN, 6, z))
    angle = math.pi / 4 + angle if bent else angle
    angle = math.pi / 2 - angle if steep else angle
    angle = math.pi - angle if x < 0.0 else angle
    return -angle if y < 0.0 else angle


def sqrt(x: float) -> float:
    """Compute the square root; NaN for negative numbers."""
    return math.sqrt(x)


def root(x: float) -> float:
    """Compute the square root; 0 for negative numbers."""
    return math.sqrt(x if x > 0.0 else 0.0)


def clip(x: float) -> float:
    """Return the nearest number in [-1, 1]."""
    least = -1.0 if x < -1.0 else x
    return 1.0 if least > 1.0 else least


def cos_third(x: float) -> float:
    """Compute cos(arccos(x) / 3), with x clipped to [-1, 1]."""
    s = math.sqrt(0.5 * (1.0 + clip(x)))
    s6 = (s * s * s) ** 2
    return 0.5 * (_six(_THIRD, 0, s) + s6 * (_six(_THIRD, 6, s) + s6 * _six(_THIRD, 12, s)))


def maximum(x: float, least: float) -> float:
    """Return the larger number."""
    return x if x > least else least


def positive(angle: float) -> float:
    """Convert an angle in [-pi, pi] to [0, 2 pi)."""
    return angle + 2 * math.pi if angle < 0.0 else angle


compilable(_six, _sin_cos, cos, sin, arctan2, sqrt, root, clip, cos_third, maximum, positive)
compilable(
    equations.arms,
    equations.assembly_at,
    equations.posture_at,
    equations.arm,
    equations.rods,
    equations.factors,
    equations.regular,
    equations.link_velocity,
    equations.velocity,
    equations.conditioning,
    equations._largest_singular_value,
)
