"""Forward and inverse kinematics invert each other, on every branch, under the promised labels."""

from types import SimpleNamespace

import numpy as np
import oracle
import pytest
import torch
from examples import examples
from hypothesis import example

from tpm_gym.errors import InputError, UnreachableError
from tpm_gym.kinematics import (
    ASSEMBLY_MODES,
    WORKING_MODES,
    AssemblyMode,
    forward,
    forward_all,
    inverse,
    inverse_all,
    jacobian,
)
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.kinematics.workspace import assembly_of
from tpm_gym.mechanism import PAPER_TPM

POINT_TOLERANCE = 1e-9
NEAREST = 1e-6  # product of the parallel factors, each in units of its size


def assert_round_trip(s: SimpleNamespace, g: Geometry) -> None:
    """The assembly mode that the oracle's factors name leads back to the point."""
    parallel, _ = oracle.factors(s.theta, s.x_c, s.z_c, s.beta, g)
    slot = oracle.assembly_slots(parallel)
    solutions = forward_all(s.theta, g)
    row = np.arange(len(slot))
    assert solutions.valid[row, slot].all()
    link3 = np.stack([s.x_c, s.z_c], axis=-1)
    errors = np.hypot(
        np.linalg.norm(solutions.position[row, slot] - s.position, axis=-1),
        np.linalg.norm(solutions.link3[row, slot] - link3, axis=-1),
    )
    # Rounding grows as the inverse of the parallel factors: the nearer to a singularity, the less
    # the angles say about the point. Elsewhere it must not grow at all.
    sizes = np.abs(parallel / np.array([1.0, g.l4, g.l4**2])).prod(axis=-1)
    assert (errors * np.minimum(1.0, sizes)).max() < 1e-13
    if g == PAPER:
        # A few lie within rounding of a singularity: the angles tell no more in float64.
        far = sizes > NEAREST
        assert far.mean() > 0.9999
        assert errors[far].max() < POINT_TOLERANCE


def assert_theta_found_again(s: SimpleNamespace, g: Geometry) -> None:
    """The working mode that the oracle's factors name holds the angles."""
    _, serial = oracle.factors(s.theta, s.x_c, s.z_c, s.beta, g)
    slots = {(m.cos_beta, m.leg1, m.leg2, m.leg3): i for i, m in enumerate(WORKING_MODES)}
    slot = np.array([slots[tuple(signs)] for signs in np.sign(serial).astype(int).tolist()])
    solutions = inverse_all(s.position, g)
    row = np.arange(len(slot))
    assert solutions.valid[row, slot].all()
    # An angle is as exact as its leg is far from its singularity; the tip's travel always is.
    turn = np.abs(np.exp(1j * solutions.theta[row, slot]) - np.exp(1j * s.theta))
    assert (turn * np.abs(serial[:, 1:]) / g.l3).max() < POINT_TOLERANCE
    assert np.median(turn) < 1e-14


@examples(40, oracle.geometries(), oracle.seeds())
@example(PAPER, 1)
def test_any_geometry_inverts_on_every_branch_and_keeps_its_labels(g, seed):
    points, angles = (10_000, 10_000) if g == PAPER else (100, 1000)
    rng = np.random.default_rng(seed)
    found = oracle.reachable_postures(rng, points, g)
    assert g != PAPER or set(found.slot) == set(range(16))
    assert_round_trip(found, g)
    theta = rng.uniform([-np.pi, 0, -np.pi], [np.pi, 2 * np.pi, np.pi], (angles, 3))
    assert_theta_found_again(oracle.postures(forward_all(theta, g), theta, g), g)


def test_slots_move_continuously_along_a_path_of_theta():
    t = np.linspace(0.0, 2 * np.pi, 2001)
    swing = 0.04 * np.stack([np.sin(t), np.sin(2 * t), np.cos(3 * t)], axis=-1)
    solutions = forward_all(np.array([-2.108, 1.853, -2.051]) + swing)
    assert solutions.valid.all()
    # Slots that swapped would jump by decimetres, or by 2 |y| > 80 mm.
    assert np.linalg.norm(np.diff(solutions.position, axis=0), axis=-1).max() < 1e-3
    assert np.abs(solutions.position[..., 1]).min() > 0.04


def test_angles_are_returned_in_the_ranges_that_are_promised():
    found = oracle.reachable_postures(np.random.default_rng(7), 5_000, PAPER)
    theta1, theta2, theta3 = found.theta.T
    assert (theta2 >= 0).all()
    assert (theta2 < 2 * np.pi).all()
    for angle in (theta1, theta3, found.beta):
        assert (angle > -np.pi).all()
        assert (angle <= np.pi).all()


def test_the_assembly_mode_of_a_point_gives_the_point_back_and_the_default_its_mirror_image():
    point = np.array([0.0, -0.03, 0.8])
    theta = inverse(point)
    mode = ASSEMBLY_MODES[assembly_of(point)]
    assert mode == AssemblyMode(-1, -1)
    np.testing.assert_allclose(forward(theta, mode), point, atol=1e-12)
    np.testing.assert_allclose(forward(theta), point * (1, -1, 1), atol=1e-12)


@pytest.mark.parametrize("tensor", [False, True])
def test_an_error_names_the_index_of_the_point_and_the_mode(tensor):
    path = np.tile([0.0, 0.03, 0.8], (5, 1))
    angles = inverse(path)
    path[3, 2], angles[3] = 3.0, 0.0
    for solve, wrong, mode in ((inverse, path, "WorkingMode"), (forward, angles, "AssemblyMode")):
        given = torch.tensor(wrong) if tensor else wrong
        with pytest.raises(UnreachableError, match=r"at index 3 cannot be reached") as caught:
            solve(given)
        assert caught.value.index == (3,)
        assert f"{mode}(" in caught.value.hint
        assert "branch" not in caught.value.hint
        with pytest.raises(UnreachableError, match=r"at index 1, 0 cannot") as caught:
            solve(given[2:4, None])
        with pytest.raises(UnreachableError, match=r"\) cannot be reached"):
            solve(given[3])


@pytest.mark.parametrize("shape", [(), (5,), (2, 3), (0,)])
def test_results_have_the_leading_shape_of_their_inputs(shape):
    region = PAPER_TPM.region
    targets = np.random.default_rng(8).uniform(region.low, region.high, (*shape, 3))
    theta = inverse(targets)
    found, solutions = inverse_all(targets), forward_all(theta)
    for values, trailing in (
        *((theta, (3,)), (found.theta, (16, 3)), (found.beta, (16,)), (found.valid, (16,))),
        *((solutions.position, (4, 3)), (solutions.link3, (4, 2)), (solutions.beta, (4,))),
        (solutions.valid, (4,)),
        *((jacobian.factors(theta).parallel, (3,)), (jacobian.factors(theta).serial, (4,))),
        *((jacobian.conditioning(theta), ()), (forward(theta), (3,))),
        *((function(theta), (3, 3)) for function in (jacobian.parallel, jacobian.velocity)),
    ):
        assert values.shape == (*shape, *trailing)


@pytest.mark.parametrize("solve", [forward_all, inverse_all, forward, inverse])
def test_what_are_no_lengths_is_refused(solve):
    with pytest.raises(InputError, match=r"geometry must be a tpm_gym\.Geometry"):
        solve(np.zeros((2, 3)), geometry=3)


@examples(30, oracle.geometries(), oracle.seeds())
@example(PAPER, 1)
def test_free_beta_is_flagged(g, seed):
    """At a2 = b2 = 0 of Eq. (10), where level3 vanishes, the angles no longer tell where P is."""
    rng = np.random.default_rng(seed)
    turn, beta = rng.uniform(-np.pi, np.pi, (2, 300))
    rise = rng.choice([-1, 1], 300) * np.sqrt(g.l4**2 - g.l7**2)
    x_c, z_c = g.l1 - 2 * g.l2 + g.l3 * np.cos(turn), g.l3 * np.sin(turn) - g.l6 + rise
    points = oracle.points(np.stack([turn] * 3, axis=-1), x_c, z_c, beta, g)["P"]
    s = oracle.postures(inverse_all(points, g), points, g)
    parallel, serial = oracle.factors(s.theta, s.x_c, s.z_c, s.beta, g)
    size = g.l3 * g.l4
    clear = (np.abs(serial[:, 1:]) > 0.1 * size).all(axis=-1) & (abs(parallel[:, 2]) > 0.1 * size)
    on = clear & (np.abs(parallel[:, 1]) < 1e-12)
    theta, slot = s.theta[on], oracle.assembly_slots(parallel[on])
    assert len(theta) > 100 or g != PAPER
    as_tensor = forward_all(torch.tensor(theta), g)
    row, solutions = np.arange(len(theta)), forward_all(theta, g)
    told = solutions.free[row, slot] & as_tensor.free.numpy()[row, slot]
    assert np.count_nonzero(~told) <= 2  # of hundreds: angles hold little beside their pivots
    row, slot, z = row[told], slot[told], s.position[on, 2][told]
    assert not (solutions.free & solutions.valid).any()
    assert np.isnan(solutions.beta[row, slot]).all()
    assert np.isnan(solutions.position[row, slot, :2]).all()
    np.testing.assert_allclose(solutions.position[row, slot, 2], z, atol=1e-12)
    for given, index in zip(theta[row[:20]], slot, strict=False):
        for angles in (given, [given]):
            with pytest.raises(UnreachableError, match="beta is free"):
                forward(angles, ASSEMBLY_MODES[index], g)
    assert not forward_all(theta + [0, 0, 1e-6], g).free[row, slot].any()
