"""Straight-line code computes what its text does in plain floats, to the last bit."""

import math
import struct
from itertools import product
from typing import Any

import numpy as np
import pytest

from tpm_gym.kinematics import ASSEMBLY_MODES, WORKING_MODES, equations
from tpm_gym.kinematics.equations import Assembly
from tpm_gym.kinematics.geometry import PAPER, WIDE, Geometry
from tpm_gym.kinematics.namespaces import PLAIN
from tpm_gym.kinematics.straight import straight_line

GEOMETRIES = (PAPER, WIDE, Geometry(l1=0.31, l2=0.06, l3=0.36, l4=0.79, l5=0.11, l6=0.02, l7=0.07))
POINTS = np.random.default_rng(0).uniform((-0.6, -0.4, 0.2), (0.6, 0.4, 1.1), (300, 3)).tolist()
ANGLES = np.random.default_rng(1).uniform(-math.pi, math.pi, (300, 3)).tolist()


def bits(value: Any) -> Any:
    if isinstance(value, tuple):
        return type(value), [bits(part) for part in value]
    return struct.pack("d", value) if isinstance(value, float) else value


def posture(point: Any, signs: Any, g: Any, ns: Any) -> Any:
    return equations.posture_at(point, signs, g, ns)


def motion(theta: Any, signs: Any, g: Any, ns: Any) -> Any:
    cos, sin = equations.arms(theta, g, ns)
    planar, side = signs
    found, real, _ = equations.assembly_at(cos, sin, planar, side, g, ns)
    bars = equations.rods(cos, sin, found, g)
    rows = equations.velocity(bars, equations.factors(cos, sin, found, bars, g))
    return found, real, rows, equations.conditioning(rows, ns)


@pytest.mark.parametrize(
    ("text", "names", "inputs", "branches", "least"),
    [
        (posture, ("x y z", "side one two three"), POINTS, WORKING_MODES, 3000),
        (motion, ("one two three", "planar side"), ANGLES, ASSEMBLY_MODES, 800),
    ],
)
def test_the_bits_are_those_of_plain_floats_on_all_branches(
    text: Any, names: Any, inputs: Any, branches: Any, least: int
) -> None:
    straight, compared = straight_line(text, *names), 0
    for given, branch, g in product(inputs, branches, GEOMETRIES):
        try:
            found = straight(given, branch.signs, g)
        except (ValueError, ZeroDivisionError):  # PLAIN has the word: mostly, no solution
            continue
        assert bits(found) == bits(text(given, branch.signs, g, PLAIN))
        compared += 1
    assert compared > least


def test_what_rounding_pushed_out_of_a_domain_is_an_error_that_plain_corrects() -> None:
    def root(numbers: Any, g: Any, ns: Any) -> Any:
        return ns.root(numbers[0]), ns.arccos(numbers[1])

    straight = straight_line(root, "one two")
    assert straight((0.25, 1.0), PAPER) == root((0.25, 1.0), PAPER, PLAIN) == (0.5, 0.0)
    for beyond in ((-1e-18, 1.0), (0.25, 1.0 + 1e-15)):
        with pytest.raises(ValueError, match="math domain error"):
            straight(beyond, PAPER)
        assert root(beyond, PAPER, PLAIN) == pytest.approx((0.5 if beyond[0] > 0 else 0.0, 0.0))


def test_results_keep_their_shape_and_what_is_used_twice_is_computed_once() -> None:
    def text(numbers: Any, others: Any, g: Any, ns: Any) -> Any:
        (x, y), (z,) = numbers, others
        shared = ns.cube(x + g.l3) - -y * 0.1
        return Assembly(shared, -0.0, 1e-308, x, abs(y), z, 2 / z), (
            (shared,),
            x < y,
            g.l7,
            x * 0.0,
            x * -0.0,
        )

    found = straight_line(text, "x y", "z")((0.3, -0.4), (7.0,), WIDE)
    assert bits(found) == bits(text((0.3, -0.4), (7.0,), WIDE, PLAIN))
    assert isinstance(found[0], Assembly)
    assert found[0].x is found[1][0][0]
    assert math.copysign(1.0, found[0].y) == -1.0


def test_a_text_that_asks_whether_something_holds_is_refused() -> None:
    def branching(numbers: Any, g: Any, ns: Any) -> Any:
        return numbers if numbers[0] > g.l1 else ns.cos(numbers[0])

    with pytest.raises(TypeError, match="not known yet"):
        straight_line(branching, "x")
    for asks in (max, lambda numbers: 1.0 if numbers[0] == 0.0 else 2.0, lambda ns: 0.0 in ns):
        with pytest.raises(TypeError, match="not known yet"):
            straight_line(lambda numbers, g, ns, asks=asks: (asks(numbers),), "x y")


@pytest.mark.parametrize("x", [0.0, 1.0, math.nan])
def test_what_is_compared_is_compared_when_it_is_known(x: float) -> None:
    def text(numbers: Any, g: Any, ns: Any) -> Any:
        (x,) = numbers
        return x == 0.0, x != 0.0, ns.where(x == x, 1.0, 2.0), x <= 0.0, x >= g.l1

    assert straight_line(text, "x")((x,), PAPER) == text((x,), PAPER, PLAIN)
