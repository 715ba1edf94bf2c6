"""Lengths that make no mechanism are refused, and those that are refused indeed make none."""

from dataclasses import asdict, replace
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import oracle
import pytest
from examples import examples

from tpm_gym.errors import GeometryError
from tpm_gym.kinematics import forward_all, inverse_all
from tpm_gym.kinematics.geometry import PAPER, Geometry

LENGTHS = ["l1", "l2", "l3", "l4", "l5", "l6", "l7"]


def with_length(name: str, value: Any) -> Geometry:
    return Geometry(**{**asdict(PAPER), name: value})


def test_the_paper_s_case_study():
    lengths = {"l1": 0.3, "l2": 0.07, "l3": 0.35, "l4": 0.8, "l5": 0.1, "l6": 0.01, "l7": 0.05}
    assert asdict(PAPER) == lengths


NO_LENGTHS = [-0.1, np.nan, np.inf, -np.inf, True, False, "0.3", None, [0.3], 10**400]


@pytest.mark.parametrize(
    ("name", "value"), [*product(LENGTHS, NO_LENGTHS), *product(LENGTHS[:5] + LENGTHS[6:], [0.0])]
)
def test_values_that_are_no_length_are_refused_by_name(name, value):
    with pytest.raises(GeometryError) as caught:
        with_length(name, value)
    assert caught.value.name == name
    assert caught.value.value is value
    assert name in str(caught.value)


def test_l6_may_be_zero():
    assert with_length("l6", 0.0).l6 == 0.0


def test_integers_are_lengths():
    assert replace(PAPER, l4=1).l4 == 1


LONG_BASE = {"l1": 0.5, "l3": 0.25}


@pytest.mark.parametrize(
    ("name", "bad", "others", "good"),
    [
        ("l3", [], {}, 0.3),  # arms as long as the base, which the paper excludes
        # short links as long as the base, or none: the circles of Eq. (6) can coincide
        ("l5", [0.3, 0.1 + 0.2, 0.3 * (1 + 1e-8), 0.3 * (1 - 9e-5)], {}, 0.3 * (1 + 1.1e-4)),
        ("l5", [1e-9], {}, 3.3e-5),
        ("l5", [0.3], {"l3": 0.3}, 0.29),
        ("l5", [0.3], {"l3": 0.3 * (1 - 1e-8)}, 0.29),
        ("l5", [], {"l3": 0.25}, 0.3),  # which is fine where the arms are shorter
        ("l4", [0.1, 0.2, 0.25], LONG_BASE, 0.26),  # rods that cannot reach link 3'
    ],
)
def test_combinations_that_make_no_mechanism_are_refused(name, bad, others, good):
    for value in bad:
        with pytest.raises(GeometryError) as caught:
            replace(PAPER, **others, **{name: value})
        assert caught.value.name == name
    assert getattr(replace(PAPER, **others, **{name: good}), name) == good


@examples(20, oracle.geometries(), oracle.seeds())
def test_arms_as_long_as_the_base_work(g, seed):
    """The paper's l3 != l1 keeps nothing away: both kinematics close all loops."""
    g = replace(g, l3=g.l1)
    points = oracle.reachable_points(np.random.default_rng(seed), 20, g)
    found = oracle.postures(inverse_all(points, g), points, g)
    rods = np.linalg.norm(oracle.rods(found.p), axis=-1)
    np.testing.assert_allclose(rods, g.l4, rtol=0, atol=1e-12)
    gaps = np.abs(forward_all(found.theta, g).position - found.position[:, None]).max(axis=-1)
    assert np.nanmin(gaps, axis=-1).max() < 1e-6


def test_too_short_rods_never_meet_the_plane_of_link_3():
    g = SimpleNamespace(**{**asdict(PAPER), "l1": 0.5, "l3": 0.25, "l4": 0.24})
    turn = np.linspace(0, 2 * np.pi, 3601)
    b1 = oracle.points(np.stack([turn] * 3, axis=-1), 0.0, 0.0, 0.0, g)["B1"]
    assert np.abs(b1[:, 1]).min() > g.l4


@examples(50, oracle.geometries(), oracle.seeds())
def test_accepted_lengths_can_be_assembled(g, seed):
    angles = np.random.default_rng(seed).uniform(-np.pi, np.pi, (2000, 3))
    assert forward_all(angles, g).valid.any()
