"""The formulas of decoupling are derivatives, and their zeros are exact."""

import re

import numpy as np
import oracle
import pytest
import torch
from examples import examples
from gantry import GANTRY
from paths import ROOT
from torch.autograd.functional import jacobian as derivatives

from tpm_gym.analysis.decoupling import LINKS, PLATFORM, link_velocity, motors, over, shares
from tpm_gym.arrays import FloatArray
from tpm_gym.errors import ConfigurationError, InputError, SingularityError, UnreachableError
from tpm_gym.kinematics import ASSEMBLY_MODES, AssemblyMode, forward_all, inverse, jacobian
from tpm_gym.kinematics.geometry import PAPER, WIDE, Geometry
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism import PAPER_TPM, WIDE_TPM


def regular(branch: AssemblyMode, seed: int, g: Geometry) -> FloatArray:
    """Return angles away from all singularities."""
    theta = oracle.angles_on(branch, np.random.default_rng(seed), 60, g, clear=0.1)
    legs = jacobian.factors(theta, branch, g).serial / [1.0, *[g.l3 * g.l4] * 3]
    return theta[(np.abs(legs) > 0.05).all(axis=-1)]


@examples(20, oracle.geometries(), oracle.seeds())
def test_the_formulas_are_derivatives_with_these_zeros(g, seed):
    for branch in ASSEMBLY_MODES:
        theta, slot = regular(branch, seed, g), branch.index

        def links(angles, slot=slot):
            found = forward_all(angles, g)
            turned = g.l7 * found.beta[:, slot, None]
            return torch.cat([found.link3[:, slot], turned], dim=-1).sum(0)

        found = link_velocity(theta, branch, g)
        slopes = derivatives(links, torch.tensor(theta)).permute(1, 0, 2).numpy()
        np.testing.assert_allclose(found, slopes, rtol=1e-8, atol=1e-9)
        assert not found[:, ~LINKS].any()
        back = np.linalg.inv(found)
        assert (np.abs(back[:, ~LINKS]) <= 1e-12 * np.abs(back).max(axis=(1, 2))[:, None]).all()
        assert not jacobian.velocity(theta, branch, g)[:, ~PLATFORM].any()


def test_nowhere_else_is_a_zero_by_structure():
    branch = ASSEMBLY_MODES[1]
    theta = regular(branch, 3, PAPER)
    assert len(theta) > 100
    for matrix, pattern in (
        (link_velocity(theta, branch), LINKS),
        (np.linalg.inv(link_velocity(theta, branch)), LINKS),
        (jacobian.velocity(theta, branch), PLATFORM),
        (np.linalg.inv(jacobian.velocity(theta, branch)), np.ones((3, 3), dtype=bool)),
    ):
        assert (np.median(np.abs(matrix), axis=0)[pattern] > 1e-2).all()


def test_motor_3_moves_p_along_the_circle_of_link_7():
    region = PAPER_TPM.region
    theta = inverse(np.random.default_rng(1).uniform(region.low, region.high, (50, 3)))
    beta = forward_all(theta).beta[:, 1]
    column = jacobian.velocity(theta)[..., 2]
    tangent = oracle.vector(-np.sin(beta), np.cos(beta), 0.0)
    assert np.abs(np.cross(column, tangent)).max() < 1e-12
    # Motors 1 and 2 do not turn for a motion along the tangent.
    rates = (np.linalg.inv(jacobian.velocity(theta)) @ tangent[..., None])[..., 0]
    assert np.abs(rates[:, :2]).max() < 1e-12
    assert np.abs(rates[:, 2]).min() > 0.05


def test_shares_are_parts_of_the_variance():
    rng = np.random.default_rng(2)
    j = jacobian.velocity(inverse([-0.04, 0.028, 0.80]))
    rates = rng.normal(size=(200_000, 3))
    variance = np.var(rates @ j.T, axis=0)
    for motor in range(3):
        alone = np.var(rates * np.eye(3)[motor] @ j.T, axis=0)
        np.testing.assert_allclose(alone / variance, shares(j)[:, motor], atol=0.01)
    np.testing.assert_allclose(shares(j).sum(axis=-1), 1.0, atol=1e-15)
    np.testing.assert_allclose(shares(j), shares(-3.0 * j), rtol=1e-14)


def test_motors_counts_motors():
    for matrix, expected in (
        (np.diag([1.0, -2.0, 3.0]), [1, 1, 1]),
        ([[0, 5, 0], [1, 1, 0], [1, -1, 1]], [1, 2, 3]),
    ):
        np.testing.assert_allclose(motors(matrix), expected, atol=1e-15)
    cartesian = GANTRY.evaluate(GANTRY.inverse(GANTRY.home))[1]
    np.testing.assert_array_equal(motors(cartesian), [1, 1, 1])


@pytest.mark.parametrize(("machine", "g"), [(PAPER_TPM, PAPER), (WIDE_TPM, WIDE)])
def test_the_index_over_a_region_is_the_mean_of_random_points(machine, g):
    found = over(machine.region, geometry=g)
    points = np.random.default_rng(3).uniform(machine.region.low, machine.region.high, (4000, 3))
    j = jacobian.velocity(inverse(points, geometry=g), geometry=g)
    np.testing.assert_allclose(found.shares, shares(j).mean(axis=0), atol=0.02)
    np.testing.assert_allclose(found.motors, motors(j).mean(axis=0), atol=0.03)
    assert found.shares[2, 2] == 0
    assert found.motors[2] <= 2


def test_the_documented_index_is_that_of_the_region():
    text = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    printed = re.search(r"x is moved by ([\d.]+) motors, y by ([\d.]+), z by ([\d.]+)", text)
    assert printed
    np.testing.assert_allclose(
        over(PAPER_TPM.region).motors, [*map(float, printed.groups())], atol=0.05
    )


def test_what_has_no_answer_raises():
    beyond, across = (
        Region((0, 0.02, 0.7), (0, 0.02, 2.0)),
        Region((0, -0.04, 0.8), (0, -0.03, 0.8)),
    )
    for region, error in ((beyond, UnreachableError), (across, ConfigurationError)):
        with pytest.raises(error):
            over(region)
    for shape in ((0, 9, 9), (9, 9), (9, 9, 2.5)):
        with pytest.raises(ConfigurationError, match="shape"):
            over(PAPER_TPM.region, shape=shape)
    with pytest.raises(SingularityError):
        over(Region((0, 0, 0.8), (0, 0, 0.8)))
    with pytest.raises(UnreachableError):
        link_velocity([0.0, 0.0, np.pi])
    with pytest.raises(InputError):
        shares([[1.0, 2.0]])
