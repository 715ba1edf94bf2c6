"""Names of the branches: signs only, one slot each, the environments' own the useful ones."""

from dataclasses import fields
from typing import Any

import numpy as np
import oracle
import pytest

from tpm_gym import kinematics
from tpm_gym.analysis import singularity
from tpm_gym.errors import InputError, UnreachableError
from tpm_gym.kinematics import forward, inverse, jacobian, workspace
from tpm_gym.kinematics.geometry import PAPER
from tpm_gym.kinematics.modes import (
    ASSEMBLY_MODES,
    DEFAULT_ASSEMBLY,
    ELBOWS_OUT,
    WORKING_MODES,
    AssemblyMode,
    WorkingMode,
)

CENTRE = np.array([-0.06, 0.03, 0.78])


@pytest.mark.parametrize(("modes", "count"), [(ASSEMBLY_MODES, 4), (WORKING_MODES, 16)])
def test_every_combination_of_signs_has_the_slot_of_its_index(modes, count):
    assert len(set(modes)) == len(modes) == count
    assert [mode.index for mode in modes] == list(range(count))
    for mode in modes:
        assert all(getattr(mode, field.name) in (-1, 1) for field in fields(mode))


@pytest.mark.parametrize("bad", [0, 2, -2, 0.5, float("nan"), "+", None])
def test_anything_but_signs_is_refused(bad):
    for kind, good in ((AssemblyMode, [1, 1]), (WorkingMode, [1, -1, 1, -1])):
        for position in range(len(good)):
            signs: list[Any] = [*good]
            signs[position] = bad
            with pytest.raises(InputError) as caught:
                kind(*signs)
            assert caught.value.name == kind.__name__


@pytest.mark.parametrize("branch", [DEFAULT_ASSEMBLY, (1, 1, -1, 1), "elbows out", None])
@pytest.mark.parametrize(
    "function",
    [inverse, jacobian.factors_at, jacobian.conditioning_at, workspace.reachable]
    + [workspace.assembly_of, singularity.classify_at],
)
def test_anything_but_a_working_mode_is_refused(function, branch):
    with pytest.raises(InputError, match="WorkingMode"):
        function(CENTRE, branch)


@pytest.mark.parametrize("branch", [ELBOWS_OUT, (-1, 1), None])
def test_anything_but_an_assembly_mode_is_refused(branch):
    theta = inverse(CENTRE)
    for function in (forward, jacobian.velocity, jacobian.factors, singularity.classify):
        with pytest.raises(InputError, match="AssemblyMode"):
            function(theta, branch)
    for function in (jacobian.conditioning_at, singularity.nearest_singularity):
        with pytest.raises(InputError, match="AssemblyMode"):
            function(CENTRE, ELBOWS_OUT, branch)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", [int, float, bool, np.int64, np.float64, np.float32])
def test_signs_that_were_computed_serve_as_plain_ones(kind):
    mode = AssemblyMode(kind(1), kind(1))
    assert mode == AssemblyMode(1, 1)
    assert all(type(sign) is int for sign in (*mode.signs, *WorkingMode(*[kind(1)] * 4).signs))
    with pytest.raises(UnreachableError):  # and not NumPy's warning that something is divided by 0
        kinematics.jacobian.evaluate([np.pi / 2, np.pi, np.pi / 2], mode)


def elbow_distances(mode: WorkingMode) -> np.ndarray:
    """Distance of each elbow B_i from the z axis, less that of its pivot A_i."""
    theta = kinematics.inverse(CENTRE, mode)
    p = oracle.points(theta, 0.0, 0.0, 0.0, PAPER)
    distance = {name: np.linalg.norm(point[:2]) for name, point in p.items()}
    return np.array([distance[f"B{i}"] - distance[f"A{i}"] for i in (1, 2, 3)])


def test_elbows_out_bends_every_arm_away_from_the_centre_and_the_others_do_not():
    assert (elbow_distances(ELBOWS_OUT) > 0).all()
    assert ELBOWS_OUT.cos_beta == 1
    valid = kinematics.inverse_all(CENTRE).valid
    others = [mode for mode in WORKING_MODES if mode.cos_beta == 1 and valid[mode.index]]
    assert len(others) == 8
    for mode in others:
        assert (elbow_distances(mode) > 0).all() == (mode == ELBOWS_OUT)


def test_the_default_assembly_holds_the_platform_beyond_the_elbows_at_positive_y():
    theta = kinematics.inverse(CENTRE)
    np.testing.assert_allclose(kinematics.forward(theta, DEFAULT_ASSEMBLY), CENTRE, atol=1e-12)
    heights = PAPER.l3 * np.sin(theta)
    assert (CENTRE[2] > heights).all()
