"""The functions of compiled code are accurate, and the same when Python runs them."""

import math
from collections.abc import Callable
from typing import Any

import mpmath
import numpy as np
import pytest
from machines import anywhere, each_machine

from tpm_gym.kinematics import compiled, equations

NS = compiled
ULP = 2.0**-52


def worst(found: Callable[..., float], exact: Callable[..., Any], *inputs: Any) -> float:
    """Largest error in units of the last place of the result, or of 2^-52 where that is larger."""
    errors = []
    with mpmath.workdps(40):
        for values in zip(*inputs, strict=True):
            expected = exact(*map(mpmath.mpf, values))
            scale = max(math.ulp(float(expected)), ULP / 8)
            errors.append(abs(float((found(*values) - expected) / scale)))
    return max(errors)


@pytest.mark.parametrize("size", [1.0, 10.0, 1e5])
def test_sine_and_cosine_are_accurate(size):
    angles = np.random.default_rng(0).uniform(-size, size, 2000).tolist()
    quarters = [k * math.pi / 4 for k in range(-9, 10)]
    for function, exact in ((compiled.sin, mpmath.sin), (compiled.cos, mpmath.cos)):
        assert worst(function, exact, angles + quarters) < 2.0


def test_angles_are_accurate_in_all_quadrants():
    rng = np.random.default_rng(1)
    y, x = rng.normal(size=(2, 4000)) * 10.0 ** rng.uniform(-9, 3, (2, 4000))
    assert worst(compiled.arctan2, mpmath.atan2, y.tolist(), x.tolist()) < 2.0
    for one, other in [(0, 0), (0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1)]:
        assert compiled.arctan2(float(one), float(other)) == math.atan2(one, other)


def test_the_cosine_of_a_third_is_accurate_up_to_both_ends():
    ends = 10.0 ** np.linspace(-16, 0, 200)
    cosines = [*(1 - ends).tolist(), *(ends - 1).tolist(), *np.linspace(-1, 1, 500).tolist()]
    exact = worst(compiled.cos_third, lambda c: mpmath.cos(mpmath.acos(c) / 3), cosines)
    assert exact < 4.0
    assert compiled.cos_third(1.1) == compiled.cos_third(1.0) == pytest.approx(1.0, abs=ULP)
    assert compiled.cos_third(-1.1) == compiled.cos_third(-1.0) == pytest.approx(0.5, abs=ULP)


def test_what_is_no_angle_has_no_sine():
    for angle in (math.nan, math.inf, -math.inf, 1e7, -1e300):
        assert math.isnan(compiled.sin(angle))
        assert math.isnan(compiled.cos(angle))
    for pair in ((math.nan, 1.0), (1.0, math.nan), (math.nan, math.nan)):
        assert math.isnan(compiled.arctan2(*pair))


@each_machine
def test_compiled_code_has_the_bits_that_python_has(machine):
    # So neither the number of rows computed at a time nor fused operations change a result.
    g, (planar, side), points = machine.geometry, machine.assembly_mode.signs, anywhere(machine, 9)
    theta = [equations.posture_at(p, machine.working_mode.signs, g, NS)[0] for p in points]
    np.testing.assert_array_equal(machine.inverse(points), theta)
    for row, one in zip(theta, zip(*machine.evaluate(theta), strict=True), strict=True):
        cos, sin = equations.arms(row, g, NS)
        found, _, _ = equations.assembly_at(cos, sin, planar, side, g, NS)
        bars = equations.rods(cos, sin, found, g)
        rows = equations.velocity(bars, equations.factors(cos, sin, found, bars, g))
        expected = found[:3], rows, equations.conditioning(rows, NS)
        for array, values in zip(one, expected, strict=False):
            np.testing.assert_array_equal(array, values)
