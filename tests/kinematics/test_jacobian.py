"""The Jacobians are the derivatives of the kinematics, and their factors are the singularities."""

import numpy as np
import oracle
import pytest
import torch
from examples import examples
from hypothesis import example
from torch.autograd.functional import jacobian as derivatives

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import SingularityError
from tpm_gym.kinematics import ASSEMBLY_MODES, ELBOWS_OUT, AssemblyMode, forward, inverse, jacobian
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.mechanism import PAPER_TPM


def assert_derivative(theta: FloatArray, branch: AssemblyMode, g: Geometry) -> None:
    """What torch finds by differentiating the forward kinematics; which gradcheck confirms."""
    j = jacobian.velocity(theta, branch, g)
    found = derivatives(lambda t: forward(t, branch, g).sum(0), torch.tensor(theta))
    size = np.maximum(1.0, np.abs(j).max(axis=(-2, -1)))
    errors = np.abs(j - found.permute(1, 0, 2).numpy()).max(axis=(-2, -1))
    assert (errors / size).max() < 1e-9


@examples(25, oracle.geometries(), oracle.seeds())
@example(PAPER, 1)
def test_velocity_jacobian_is_the_derivative_of_the_forward_kinematics(g, seed):
    for branch in ASSEMBLY_MODES:
        count = 1000 if g == PAPER else 100
        theta = oracle.angles_on(branch, np.random.default_rng(seed), count, g, clear=0.2)
        assert len(theta) > 500 or g != PAPER
        if len(theta):
            assert_derivative(theta, branch, g)


@pytest.mark.parametrize("branch", ASSEMBLY_MODES)
def test_velocity_solves_a_v_equal_b_theta_dot(branch):
    theta = oracle.angles_on(branch, np.random.default_rng(2), 400, PAPER, clear=1e-2)
    a, b = jacobian.parallel(theta, branch), jacobian.serial(theta, branch)
    j = jacobian.velocity(theta, branch)
    assert (b == b * np.eye(3)).all()
    np.testing.assert_allclose(a @ j, b, rtol=0, atol=1e-10)
    regular = np.abs(np.linalg.det(a)) > 1e-5
    assert regular.sum() > 100
    solved = np.linalg.solve(a[regular], b[regular])
    size = np.abs(solved).max(axis=(-2, -1), keepdims=True)
    assert (np.abs(j[regular] - solved) / size).max() < 1e-9


def test_conditioning_at_the_documented_point():
    assert jacobian.conditioning(inverse([0, 0.025, 0.75])) == pytest.approx(0.11, abs=0.005)


def test_plane_y_0_is_a_parallel_singularity():
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


def test_one_singular_entry_makes_the_batch_singular():
    theta = inverse([[0.0, 0.03, 0.78], *oracle.vector(np.linspace(-0.2, 0.1, 50), 0.0, 0.75)])
    with pytest.raises(SingularityError):
        jacobian.velocity(theta)


@pytest.mark.parametrize("sign", [-1, 1])
def test_velocity_is_finite_at_the_edge_of_the_workspace_in_y(sign):
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
