"""What has no solution is told by validity in batches, and explained by the part that fails."""

import numpy as np
import oracle
import pytest
import torch

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import InputError, UnreachableError
from tpm_gym.kinematics import (
    ASSEMBLY_MODES,
    ELBOWS_OUT,
    WORKING_MODES,
    AssemblyMode,
    equations,
    forward,
    forward_all,
    inverse,
    inverse_all,
    jacobian,
)
from tpm_gym.kinematics.geometry import PAPER
from tpm_gym.kinematics.namespaces import NUMPY

HOME = np.array([-0.05, 0.03, 0.78])
OF_ANGLES = (
    *(forward, jacobian.parallel, jacobian.serial, jacobian.velocity),
    *(jacobian.conditioning, jacobian.evaluate, jacobian.factors),
)
SINGLE_BRANCH = (inverse, *OF_ANGLES)
NOT_FINITE = [
    [value if axis == i else 0.3 for i in range(3)]
    for axis in range(3)
    for value in (np.nan, np.inf, -np.inf)
]
FAR = [[0, 0.02, 5], [9, 0, 0], [-9, 0.04, 0.7], [0, 0.0501, 0.75], [0, -3, 0.75], [1e6, 1e6, -1e6]]
FAR += [[far, 0.02, 0.8] for far in (1e160, 1e200, 1e300)] + [[0, 1e200, 0.8], [0, 0.02, 1e300]]
# Arm 1 lowered, arm 2 raised: the circles of the first loop miss each other.
APART = [0.0, np.pi, -2.0], [np.pi / 2, -np.pi / 2 + 0.2, 0.5]


@pytest.mark.parametrize("function", [forward_all, inverse_all])
@pytest.mark.parametrize("kind", [np.array, torch.tensor])
@pytest.mark.parametrize("values", NOT_FINITE)
def test_values_that_are_not_finite_give_invalid_branches(function, kind, values):
    with np.errstate(invalid="raise", divide="raise", over="raise"):
        solutions = function(kind([values, HOME.tolist(), values]))
    assert not solutions.valid[[0, 2]].any()
    assert np.isnan(np.asarray(solutions.beta)[[0, 2]]).all()
    assert solutions.valid[1].any() == function(HOME).valid.any()


@pytest.mark.parametrize("point", FAR)
def test_points_out_of_reach_have_no_branch_and_an_error(point):
    with np.errstate(invalid="raise", divide="raise", over="raise"):
        solutions = inverse_all(point)
        with pytest.raises(UnreachableError) as caught:
            inverse(point)
    assert caught.value.margin < 0
    assert not solutions.valid.any()
    assert np.isnan(solutions.theta).all()
    assert np.isnan(solutions.beta).all()


def test_what_is_found_of_a_branch_is_finite_where_it_is_valid_and_nowhere_else():
    solutions = forward_all(np.random.default_rng(0).uniform(-np.pi, np.pi, (5000, 3)))
    assert not solutions.valid.all()
    for values in (solutions.position, solutions.beta[..., None], solutions.link3):
        np.testing.assert_array_equal(np.isfinite(values).all(axis=-1), solutions.valid)


@pytest.mark.parametrize("function", SINGLE_BRANCH)
@pytest.mark.parametrize("values", NOT_FINITE)
def test_single_branch_calls_reject_values_that_are_not_finite(function, values):
    for given in (
        values,
        [HOME, values],
        torch.tensor([HOME.tolist(), values], dtype=torch.float64),
    ):
        with pytest.raises(InputError, match="finite") as caught:
            function(given)
        assert caught.value.name in {"theta", "position"}
        np.testing.assert_array_equal(caught.value.value, values)


@pytest.mark.parametrize("function", [*SINGLE_BRANCH, forward_all, inverse_all])
@pytest.mark.parametrize(
    "bad", [1.0, [], [0.0, 0.0], np.zeros((3, 2)), ["1", "2", "3"], [10**400] * 3]
)
def test_wrong_shapes_and_types_are_input_errors(function, bad):
    with pytest.raises(InputError, match="shape"):
        function(bad)


@pytest.mark.parametrize("y", [0.0501, -0.06, 1.0])
def test_points_beyond_link_7_blame_beta_and_say_by_how_much(y):
    point = [0.0, y, 0.75]
    with pytest.raises(UnreachableError) as caught:
        inverse([HOME, point])
    assert caught.value.leg.startswith("beta")
    assert caught.value.margin == pytest.approx(PAPER.l7 - abs(y))
    assert caught.value.margin < 0
    assert caught.value.point == tuple(point)


def rod_range(point: FloatArray, leg: int, cos_sign: int) -> tuple[float, float]:
    """Shortest and longest B_iC_i over a full turn of the arm, C_i where the point puts it."""
    g = PAPER
    beta = np.arctan2(point[1], cos_sign * np.sqrt(g.l7**2 - point[1] ** 2))
    turn = np.linspace(0, 2 * np.pi, 20_001)
    theta = np.stack([turn] * 3, axis=-1)
    x_c = np.full(turn.shape, point[0] - g.l2 - g.l7 * np.cos(beta))
    p = oracle.points(theta, x_c, point[2] - 2 * g.l6, beta, g)
    lengths = np.linalg.norm(oracle.rods(p)[:, leg - 1], axis=-1)
    return float(lengths.min()), float(lengths.max())


def test_the_leg_that_is_blamed_cannot_reach():
    rng = np.random.default_rng(1)
    blamed = set()
    for point in rng.uniform([-0.9, -0.049, -1.3], [0.9, 0.049, 1.3], (150, 3)):
        mode = WORKING_MODES[rng.integers(16)]
        if inverse_all(point).valid[mode.index]:
            continue
        with pytest.raises(UnreachableError) as caught:
            inverse(point, mode)
        assert caught.value.margin < 0
        leg = int(caught.value.leg.removeprefix("leg "))
        shortest, longest = rod_range(point, leg, mode.cos_beta)
        assert not shortest <= PAPER.l4 <= longest
        blamed.add(leg)
    assert blamed == {1, 2, 3}


def test_margin_of_a_planar_leg_is_the_missing_length():
    # C2 is 300 mm under A2, nearer than leg 2 can fold: |l3 - l4| = 450 mm.
    x_c, z_c = 2 * PAPER.l5 - PAPER.l1, 0.3
    point = [x_c + PAPER.l2 + PAPER.l7, 0.0, z_c + 2 * PAPER.l6]
    with pytest.raises(UnreachableError) as caught:
        inverse(point, ELBOWS_OUT)
    assert caught.value.leg == "leg 2"
    assert caught.value.margin == pytest.approx(-0.15)


@pytest.mark.parametrize("theta", APART)
def test_loops_that_cannot_be_assembled_are_named(theta):
    assert not forward_all(theta).valid.any()
    home = inverse(HOME)
    for mode in ASSEMBLY_MODES:
        batch = [home, theta] if forward_all(home).valid[mode.index] else [theta]
        for function in OF_ANGLES:
            with pytest.raises(UnreachableError, match=r"loop \d") as caught:
                function(batch, mode)
            assert caught.value.margin < 0
            assert caught.value.point == tuple(theta)


def margin_of_loop_2(theta: FloatArray, mode: AssemblyMode) -> float:
    """How far l4 is from the range of |B3C3| over a full turn of link 7."""
    with np.errstate(invalid="ignore"):
        cos, sin = equations.arms(theta, PAPER, NUMPY)
        found, _, _ = equations.assembly_at(cos, sin, mode.planar, mode.sin_beta, PAPER, NUMPY)
    turn = np.linspace(0, 2 * np.pi, 20_001)
    p = oracle.points(np.broadcast_to(theta, (20_001, 3)), found.x_c, found.z_c, turn, PAPER)
    rods = np.linalg.norm(oracle.rods(p), axis=-1)
    np.testing.assert_allclose(rods[:, :2], PAPER.l4)  # loop 1 is closed
    lengths = rods[:, 2]
    return float(min(lengths.max() - PAPER.l4, PAPER.l4 - lengths.min()))


def test_the_loop_that_is_blamed_is_the_one_that_fails_and_by_so_much():
    angles = np.random.default_rng(2).uniform(-np.pi, np.pi, (120, 3))
    blamed = set()
    for theta in angles:
        for mode in ASSEMBLY_MODES[::2]:
            if forward_all(theta).valid[mode.index]:
                continue
            with pytest.raises(UnreachableError) as caught:
                forward(theta, mode)
            assert caught.value.margin < 0
            loop = int(caught.value.leg.removeprefix("loop ")[0])
            # Loop 1 fails where the circles of B1C1 and B2C2 in the plane y = 0 do not meet.
            p = oracle.points(theta, 0.0, 0.0, 0.0, PAPER)
            radius = np.sqrt(PAPER.l4**2 - p["B1"][1] ** 2)
            apart = np.hypot(p["B2"][0] + 2 * PAPER.l5, p["B2"][2] - p["B1"][2])
            meet = abs(PAPER.l4 - radius) <= apart <= PAPER.l4 + radius
            assert loop == (2 if meet else 1)
            margin = min(PAPER.l4 + radius - apart, apart - PAPER.l4 + radius)
            margin = margin_of_loop_2(theta, mode) if meet else margin
            assert caught.value.margin == pytest.approx(margin, abs=1e-7)
            blamed.add(loop)
    assert blamed == {1, 2}
