"""Lengths that make no mechanism are refused, and those that are refused indeed make none."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, asdict, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import oracle
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tpm_gym.errors import GeometryError
from tpm_gym.kinematics import forward_all
from tpm_gym.kinematics.geometry import PAPER, Geometry

LENGTHS = ["l1", "l2", "l3", "l4", "l5", "l6", "l7"]


def with_length(name: str, value: Any) -> Geometry:
    return Geometry(**{**asdict(PAPER), name: value})


def test_the_paper_s_case_study() -> None:
    lengths = {"l1": 0.3, "l2": 0.07, "l3": 0.35, "l4": 0.8, "l5": 0.1, "l6": 0.01, "l7": 0.05}
    assert asdict(PAPER) == lengths


@pytest.mark.parametrize("name", LENGTHS)
@pytest.mark.parametrize(
    "value", [-0.1, float("nan"), float("inf"), -float("inf"), True, False, "0.3", None, [0.3]]
)
def test_values_that_are_no_length_are_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(GeometryError) as caught:
        with_length(name, value)
    assert caught.value.name == name
    assert caught.value.value is value
    assert name in str(caught.value)


@pytest.mark.parametrize("name", LENGTHS)
def test_only_l6_may_be_zero(name: str) -> None:
    if name == "l6":
        assert with_length(name, 0.0).l6 == 0.0
    else:
        with pytest.raises(GeometryError) as caught:
            with_length(name, 0.0)
        assert caught.value.name == name


@pytest.mark.parametrize("name", LENGTHS)
def test_lengths_are_frozen(name: str) -> None:
    geometry = replace(PAPER)
    with pytest.raises(FrozenInstanceError):
        setattr(geometry, name, 0.5)
    assert geometry == PAPER
    assert hash(geometry) == hash(PAPER)


def test_integers_are_lengths() -> None:
    assert replace(PAPER, l4=1).l4 == 1


@pytest.mark.parametrize("l3", [0.3, 0.1 + 0.2])
def test_arms_as_long_as_the_base_are_refused(l3: float) -> None:
    with pytest.raises(GeometryError) as caught:
        replace(PAPER, l3=l3)
    assert caught.value.name == "l3"


@pytest.mark.parametrize("l5", [0.3, 0.1 + 0.2])
def test_short_links_as_long_as_the_base_are_refused_where_the_arms_are_longer(l5: float) -> None:
    with pytest.raises(GeometryError) as caught:
        replace(PAPER, l5=l5)
    assert caught.value.name == "l5"


def test_short_links_as_long_as_the_base_are_fine_where_the_arms_are_shorter() -> None:
    assert replace(PAPER, l5=0.3, l3=0.25).l5 == 0.3


@pytest.mark.parametrize("l4", [0.1, 0.2, 0.25])
def test_rods_that_cannot_reach_link_3_are_refused(l4: float) -> None:
    with pytest.raises(GeometryError) as caught:
        replace(PAPER, l1=0.5, l3=0.25, l4=l4)
    assert caught.value.name == "l4"
    assert replace(PAPER, l1=0.5, l3=0.25, l4=0.26).l4 == 0.26


def loop_1_lengths(g: Any, theta: list[float], z_c: float, x_c: Any) -> Any:
    """|B1C1| and |B2C2| with C1 at (x_c, 0, z_c)."""
    p = oracle.points(theta, x_c, z_c, 0.0, g)
    return np.linalg.norm(p["C1"] - p["B1"], axis=-1), np.linalg.norm(p["C2"] - p["B2"], axis=-1)


def test_l5_equal_to_l1_lets_link_3_move_with_the_motors_held() -> None:
    g = SimpleNamespace(**{**asdict(PAPER), "l5": PAPER.l1})
    theta_1 = np.arccos(-g.l1 / g.l3)
    theta = [theta_1, np.arccos((g.l1 - 2 * g.l5) / g.l3), 0.0]
    # Every point of a whole circle closes both rods: the two circles of Eq. (6) are one.
    turn = np.linspace(0, 2 * np.pi, 361)
    x_c, z_c = g.l4 * np.cos(turn), g.l3 * np.sin(theta_1) + g.l4 * np.sin(turn)
    for lengths in loop_1_lengths(g, theta, z_c, x_c):
        np.testing.assert_allclose(lengths, g.l4, rtol=1e-12)


@settings(derandomize=True, max_examples=50, deadline=None)
@given(st.floats(0.02, 0.29), st.sampled_from([-1, 1]))
def test_other_l5_leave_at_most_two_places_to_link_3_there(l5: float, elbow: int) -> None:
    g = replace(PAPER, l5=l5)
    theta_1 = elbow * np.arccos(-g.l1 / g.l3)
    turn = np.linspace(0, 2 * np.pi, 361)[:-1]
    x_c, z_c = g.l4 * np.cos(turn), g.l3 * np.sin(theta_1) + g.l4 * np.sin(turn)
    for theta_2 in np.linspace(0, 2 * np.pi, 73):
        rod4, rod6 = loop_1_lengths(g, [theta_1, theta_2, 0.0], z_c, x_c)
        np.testing.assert_allclose(rod4, g.l4, rtol=1e-12)
        crossings = np.count_nonzero(np.diff(np.sign(rod6 - g.l4), append=np.sign(rod6[0] - g.l4)))
        assert crossings <= 2
        assert np.ptp(rod6) > 1e-4


def test_too_short_rods_never_meet_the_plane_of_link_3() -> None:
    g = SimpleNamespace(**{**asdict(PAPER), "l1": 0.5, "l3": 0.25, "l4": 0.24})
    turn = np.linspace(0, 2 * np.pi, 3601)
    b1 = oracle.points(np.stack([turn] * 3, axis=-1), 0.0, 0.0, 0.0, g)["B1"]
    assert np.abs(b1[:, 1]).min() > g.l4


@settings(derandomize=True, max_examples=50, deadline=None)
@given(oracle.geometries(), oracle.seeds())
def test_accepted_lengths_can_be_assembled(g: Geometry, seed: int) -> None:
    angles = np.random.default_rng(seed).uniform(-np.pi, np.pi, (2000, 3))
    assert forward_all(angles, g).valid.any()
