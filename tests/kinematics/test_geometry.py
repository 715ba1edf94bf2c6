"""Lengths that make no mechanism are refused, and those that are refused indeed make none."""

from collections.abc import Callable
from dataclasses import asdict, replace
from itertools import product
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import oracle
import pytest
from examples import examples

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import GeometryError
from tpm_gym.kinematics import equations, forward_all, inverse_all
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.kinematics.namespaces import NUMPY

mp = pytest.importorskip("mpmath")

LENGTHS = ["l1", "l2", "l3", "l4", "l5", "l6", "l7"]


def with_length(name: str, value: Any) -> Geometry:
    return Geometry(**{**asdict(PAPER), name: value})


def test_the_paper_s_case_study() -> None:
    lengths = {"l1": 0.3, "l2": 0.07, "l3": 0.35, "l4": 0.8, "l5": 0.1, "l6": 0.01, "l7": 0.05}
    assert asdict(PAPER) == lengths


NO_LENGTHS = [-0.1, np.nan, np.inf, -np.inf, True, False, "0.3", None, [0.3], 10**400]


@pytest.mark.parametrize(
    ("name", "value"),
    [*product(LENGTHS, NO_LENGTHS), *product(LENGTHS[:5] + LENGTHS[6:], [0.0])],
)
def test_values_that_are_no_length_are_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(GeometryError) as caught:
        with_length(name, value)
    assert caught.value.name == name
    assert caught.value.value is value
    assert name in str(caught.value)


def test_l6_may_be_zero() -> None:
    assert with_length("l6", 0.0).l6 == 0.0


def test_integers_are_lengths() -> None:
    assert replace(PAPER, l4=1).l4 == 1


LONG_BASE = {"l1": 0.5, "l3": 0.25}


@pytest.mark.parametrize(
    ("name", "bad", "others", "good"),
    [
        ("l3", [], {}, 0.3),  # arms as long as the base, which the paper excludes
        # short links as long as the base, or none: see test_circles_that_coincide...
        ("l5", [0.3, 0.1 + 0.2, 0.3 * (1 + 1e-8), 0.3 * (1 - 9e-5)], {}, 0.3 * (1 + 1.1e-4)),
        ("l5", [1e-9], {}, 3.3e-5),
        ("l5", [0.3], {"l3": 0.3}, 0.29),
        ("l5", [0.3], {"l3": 0.3 * (1 - 1e-8)}, 0.29),
        ("l5", [], {"l3": 0.25}, 0.3),  # which is fine where the arms are shorter
        ("l4", [0.1, 0.2, 0.25], LONG_BASE, 0.26),  # rods that cannot reach link 3'
    ],
)
def test_combinations_that_make_no_mechanism_are_refused(
    name: str, bad: list[float], others: dict[str, float], good: float
) -> None:
    for value in bad:
        with pytest.raises(GeometryError) as caught:
            replace(PAPER, **others, **{name: value})
        assert caught.value.name == name
    assert getattr(replace(PAPER, **others, **{name: good}), name) == good


def off_beside_concentric_circles(l5: float) -> float:
    """How far floats put C1 from where 60 digits have it, at most, near a1 = b1 = 0, m."""
    g = cast("Geometry", SimpleNamespace(**{**asdict(PAPER), "l5": l5}))  # refused lengths, too
    y_b1 = min(2 * l5, 2 * abs(g.l1 - l5))
    level = np.clip((g.l1 - 2 * l5) / g.l3, -1, 1)
    middle = np.arccos([-level if l5 < g.l1 / 2 else level, level])
    rng, worst = np.random.default_rng(7), 0.0
    for _ in range(300):
        # The circles first meet where their centres are as far apart as their radii differ.
        apart = y_b1**2 / g.l4 * 10 ** rng.uniform(-0.5, 1.5)
        theta = np.append(middle + apart * rng.normal(size=2), 0.0)
        cos, sin = equations.arms(tuple(theta), g, NUMPY)  # type: ignore[arg-type]
        with np.errstate(all="ignore"):
            found, *_ = equations.assembly_at(cos, sin, 1, 1, g, NUMPY)
        exact = with_60_digits(theta, g)
        if exact is not None and np.isfinite(found.x_c):
            worst = max(worst, float(mp.hypot(exact[0] - found.x_c, exact[1] - found.z_c)))
    return worst


def with_60_digits(theta: FloatArray, g: Geometry) -> tuple[Any, Any] | None:
    """xC and zC with a positive planar factor, if the circles of Eq. (6) meet, from a1, b1, c1."""
    with mp.workdps(60):
        l1, l3, l4, l5 = (mp.mpf(length) for length in (g.l1, g.l3, g.l4, g.l5))
        one, two = (mp.mpf(angle) for angle in theta[:2])
        y, z = l1 + l3 * mp.cos(one), l3 * mp.sin(one)
        dx, dz = l3 * mp.cos(two) + 2 * l5 - l1, l3 * mp.sin(two) - z
        square = dx**2 + dz**2
        along = (1 - y**2 / square) / 2
        across = (l4**2 - y**2) / square - along**2
        if across < 0:
            return None
        return along * dx - mp.sqrt(across) * dz, z + along * dz + mp.sqrt(across) * dx


@pytest.mark.parametrize("of", [lambda e: PAPER.l1 * (1 + e), lambda e: PAPER.l1 * e])
def test_circles_that_coincide_but_for_rounding_are_refused(of: Callable[[float], float]) -> None:
    """What is accepted says where C1 is to a tenth of a micrometre, even next to such circles."""
    for refused in (1e-8, 1e-6):
        assert off_beside_concentric_circles(of(refused)) > 1e-4
        with pytest.raises(GeometryError):
            replace(PAPER, l5=of(refused))
    assert off_beside_concentric_circles(replace(PAPER, l5=of(1.1e-4)).l5) < 1e-7


@examples(20, oracle.geometries(), oracle.seeds())
def test_arms_as_long_as_the_base_work(g: Geometry, seed: int) -> None:
    """The paper's l3 != l1 keeps nothing away: both kinematics close all loops."""
    g = replace(g, l3=g.l1)
    points = oracle.reachable_points(np.random.default_rng(seed), 20, g)
    found = oracle.postures(inverse_all(points, g), points, g)
    rods = np.linalg.norm(oracle.rods(found.p), axis=-1)
    np.testing.assert_allclose(rods, g.l4, rtol=0, atol=1e-12)
    gaps = np.abs(forward_all(found.theta, g).position - found.position[:, None]).max(axis=-1)
    assert np.nanmin(gaps, axis=-1).max() < 1e-6


def test_too_short_rods_never_meet_the_plane_of_link_3() -> None:
    g = SimpleNamespace(**{**asdict(PAPER), "l1": 0.5, "l3": 0.25, "l4": 0.24})
    turn = np.linspace(0, 2 * np.pi, 3601)
    b1 = oracle.points(np.stack([turn] * 3, axis=-1), 0.0, 0.0, 0.0, g)["B1"]
    assert np.abs(b1[:, 1]).min() > g.l4


@examples(50, oracle.geometries(), oracle.seeds())
def test_accepted_lengths_can_be_assembled(g: Geometry, seed: int) -> None:
    angles = np.random.default_rng(seed).uniform(-np.pi, np.pi, (2000, 3))
    assert forward_all(angles, g).valid.any()
