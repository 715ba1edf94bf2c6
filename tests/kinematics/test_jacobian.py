"""The Jacobians are the derivatives of the kinematics, and their factors are the singularities."""

from __future__ import annotations

import numpy as np
import oracle
import pytest
import torch
from examples import examples
from hypothesis import example
from torch.autograd.functional import jacobian as derivatives

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import InputError, SingularityError, UnreachableError
from tpm_gym.kinematics import (
    ASSEMBLY_MODES,
    ELBOWS_OUT,
    AssemblyMode,
    forward,
    forward_all,
    inverse,
    inverse_all,
    jacobian,
)
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.mechanism import PAPER_TPM


def joint_angles(
    seed: int, branch: AssemblyMode, g: Geometry, count: int, clear: float
) -> FloatArray:
    """Random angles (n, 3) on a branch, with every parallel factor ``clear`` of zero (scaled)."""
    rng = np.random.default_rng(seed)
    solutions = inverse_all(oracle.reachable_points(rng, count, g), g)
    theta = solutions.theta[solutions.valid]
    theta = theta[forward_all(theta, g).valid[:, branch.index]]
    scaled = jacobian.factors(theta, branch, g).parallel / [1.0, g.l4, g.l4**2]
    return theta[(np.abs(scaled) > clear).all(axis=-1)]


def assert_derivative(theta: FloatArray, branch: AssemblyMode, g: Geometry) -> None:
    """What torch finds by differentiating the forward kinematics; which gradcheck confirms."""
    j = jacobian.velocity(theta, branch, g)
    found = derivatives(lambda t: forward(t, branch, g).sum(0), torch.tensor(theta))
    size = np.maximum(1.0, np.abs(j).max(axis=(-2, -1)))
    errors = np.abs(j - found.permute(1, 0, 2).numpy()).max(axis=(-2, -1))
    assert (errors / size).max() < 1e-9


@examples(25, oracle.geometries(), oracle.seeds())
@example(PAPER, 1)
def test_velocity_jacobian_is_the_derivative_of_the_forward_kinematics(
    g: Geometry, seed: int
) -> None:
    for branch in ASSEMBLY_MODES:
        theta = joint_angles(seed, branch, g, 1000 if g == PAPER else 100, clear=0.2)
        assert len(theta) > 500 or g != PAPER
        if len(theta):
            assert_derivative(theta, branch, g)


@examples(25, oracle.geometries(), oracle.seeds())
def test_determinants_are_the_products_of_the_factors(g: Geometry, seed: int) -> None:
    for branch in ASSEMBLY_MODES:
        theta = joint_angles(seed, branch, g, 40, clear=0.0)
        if not len(theta):
            continue
        solutions = forward_all(theta, g)
        (x_c, z_c), beta = solutions.link3[:, branch.index].T, solutions.beta[:, branch.index]
        parallel, serial = oracle.factors(theta, x_c, z_c, beta, g)
        found = jacobian.factors(theta, branch, g)
        np.testing.assert_allclose(found.parallel, parallel, rtol=0, atol=1e-12)
        np.testing.assert_allclose(found.serial, serial, rtol=0, atol=1e-12)
        det_a = np.linalg.det(jacobian.parallel(theta, branch, g))
        det_b = np.linalg.det(jacobian.serial(theta, branch, g))
        product_a, product_b = parallel.prod(axis=-1), serial.prod(axis=-1)
        np.testing.assert_allclose(det_a, -np.cos(beta) * product_a, rtol=0, atol=1e-12)
        np.testing.assert_allclose(det_b, np.cos(beta) * product_b, rtol=0, atol=1e-12)


@pytest.mark.parametrize("branch", ASSEMBLY_MODES)
def test_velocity_solves_a_v_equal_b_theta_dot(branch: AssemblyMode) -> None:
    theta = joint_angles(2, branch, PAPER, 400, clear=1e-2)
    a, b = jacobian.parallel(theta, branch), jacobian.serial(theta, branch)
    j = jacobian.velocity(theta, branch)
    assert (b == b * np.eye(3)).all()
    np.testing.assert_allclose(a @ j, b, rtol=0, atol=1e-10)
    regular = np.abs(np.linalg.det(a)) > 1e-5
    assert regular.sum() > 100
    solved = np.linalg.solve(a[regular], b[regular])
    size = np.abs(solved).max(axis=(-2, -1), keepdims=True)
    assert (np.abs(j[regular] - solved) / size).max() < 1e-9


def test_conditioning_vanishes_in_proportion_to_y() -> None:
    y = 1e-3 / 2.0 ** np.arange(8)
    points = oracle.vector(0.0, y, 0.75)
    ratio = jacobian.conditioning(inverse(points)) / y
    assert ratio[-1] > 1
    np.testing.assert_allclose(ratio, ratio[-1], rtol=2e-3)


def test_conditioning_at_the_documented_point() -> None:
    assert jacobian.conditioning(inverse([0, 0.025, 0.75])) == pytest.approx(0.11, abs=0.005)


def test_plane_y_0_is_a_parallel_singularity() -> None:
    rng = np.random.default_rng(4)
    low, high = np.array(PAPER_TPM.region.low), np.array(PAPER_TPM.region.high)
    low[1] = high[1] = 0.0
    for point in rng.uniform(low, high, (100, 3)):
        theta = inverse(point)
        # cos(beta) is known to rounding, y to its square root.
        np.testing.assert_allclose(forward(theta), point, atol=1e-6)
        assert jacobian.conditioning(theta) < 1e-6
        for function in (jacobian.velocity, jacobian.evaluate):
            with pytest.raises(SingularityError) as caught:
                function(theta)
            assert caught.value.factor == "sin(beta)"
            assert abs(caught.value.value) < 1e-6


def test_one_singular_entry_makes_the_batch_singular() -> None:
    theta = inverse([[0.0, 0.03, 0.78], *oracle.vector(np.linspace(-0.2, 0.1, 50), 0.0, 0.75)])
    with pytest.raises(SingularityError):
        jacobian.velocity(theta)


@pytest.mark.parametrize("sign", [-1, 1])
def test_velocity_is_finite_at_the_edge_of_the_workspace_in_y(sign: int) -> None:
    rng = np.random.default_rng(5)
    branch = AssemblyMode(planar=-1, sin_beta=sign)
    points = rng.uniform([-0.2, 0, 0.68], [0.1, 0, 0.88], (50, 3))
    points[:, 1] = sign * PAPER.l7
    theta = inverse(points, ELBOWS_OUT)
    j = jacobian.velocity(theta, branch)
    assert np.isfinite(j).all()
    assert np.abs(j[:, 1]).max() < 1e-6  # the platform cannot go on in y
    assert np.abs(np.linalg.det(jacobian.parallel(theta, branch))).max() < 1e-9
    assert np.abs(np.linalg.det(jacobian.serial(theta, branch))).max() < 1e-9
    assert jacobian.conditioning(theta, branch).max() < 1e-6
    inside = points * [1, 1 - 1e-8, 1]
    beside = jacobian.velocity(inverse(inside, ELBOWS_OUT), branch)
    np.testing.assert_allclose(j, beside, atol=2e-3)
    assert_derivative(theta, branch, PAPER)


def test_evaluate_equals_the_separate_functions() -> None:
    for branch in ASSEMBLY_MODES:
        theta = joint_angles(6, branch, PAPER, 200, clear=1e-2)
        found = jacobian.evaluate(theta, branch)
        np.testing.assert_array_equal(found.position, forward(theta, branch))
        np.testing.assert_array_equal(found.velocity, jacobian.velocity(theta, branch))
        np.testing.assert_array_equal(found.conditioning, jacobian.conditioning(theta, branch))


@pytest.mark.parametrize("shape", [(), (5,), (2, 3), (0,)])
def test_leading_shapes_broadcast(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(7)
    theta = inverse(rng.uniform(PAPER_TPM.region.low, PAPER_TPM.region.high, (*shape, 3)))
    for function in (jacobian.parallel, jacobian.serial, jacobian.velocity):
        found = function(theta)
        assert found.shape == (*shape, 3, 3)
        for index in np.ndindex(shape):
            np.testing.assert_allclose(found[index], function(theta[index]), rtol=0, atol=1e-12)
    assert jacobian.conditioning(theta).shape == shape
    assert jacobian.factors(theta).parallel.shape == (*shape, 3)
    assert jacobian.factors(theta).serial.shape == (*shape, 4)


@pytest.mark.parametrize(
    "name", ["parallel", "serial", "velocity", "conditioning", "evaluate", "factors"]
)
def test_configurations_that_do_not_exist_are_refused(name: str) -> None:
    function = getattr(jacobian, name)
    home = inverse([0, 0.03, 0.78])
    with pytest.raises(UnreachableError):
        function([home, [0.0, np.pi, -2.0]])
    with pytest.raises(InputError):
        function([home, [np.nan, 0.0, 0.0]])
    with pytest.raises(InputError):
        function([0.0, 0.0])
