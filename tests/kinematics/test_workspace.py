"""The task's region can be reached everywhere, and is singular nowhere."""

import numpy as np
import oracle
import pytest
from examples import examples
from hypothesis import strategies as st

from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics import (
    ASSEMBLY_MODES,
    DEFAULT_ASSEMBLY,
    ELBOWS_OUT,
    WORKING_MODES,
    AssemblyMode,
    inverse,
    inverse_all,
    jacobian,
    workspace,
)
from tpm_gym.kinematics.geometry import PAPER
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism import PAPER_TPM

TASK_REGION = PAPER_TPM.region
BOX = Region(low=(-1.0, 0.0, 2.0), high=(1.0, 0.5, 2.0))
coordinates = st.floats(-3, 3)
triples = st.tuples(coordinates, coordinates, coordinates)


def test_task_region_is_wholly_reachable_with_the_elbows_out_in_the_default_assembly():
    points = oracle.grid(TASK_REGION.low, TASK_REGION.high, (37, 18, 27))
    assert workspace.reachable(points).all()
    assert (workspace.assembly_of(points) == DEFAULT_ASSEMBLY.index).all()
    # and is not so only at the nodes: the angles hardly change from node to node
    theta = inverse(points)
    assert max(np.abs(np.diff(theta, axis=axis)).max() for axis in range(3)) < 0.05


def test_task_region_lies_between_the_singularities_in_y():
    assert 0 < TASK_REGION.low[1] < TASK_REGION.high[1] < PAPER.l7
    assert (
        workspace.conditioning_at(oracle.grid(TASK_REGION.low, TASK_REGION.high, (19, 9, 14))).min()
        > 0.03
    )


def test_reachable_is_the_validity_of_the_slot():
    points = np.random.default_rng(0).uniform([-1, -0.06, -1.3], [1, 0.06, 1.3], (500, 3))
    points[7] = np.nan
    for mode in WORKING_MODES:
        expected = inverse_all(points).valid[:, mode.index]
        np.testing.assert_array_equal(workspace.reachable(points, mode), expected)
        np.testing.assert_array_equal(workspace.assembly_of(points, mode) >= 0, expected)


def test_assembly_of_names_the_signs_of_the_parallel_factors():
    points = oracle.reachable_points(np.random.default_rng(1), 2000, PAPER)
    seen = set()
    for mode in WORKING_MODES:
        here = points[workspace.reachable(points, mode)]
        parallel, *_ = oracle.factors_at(here, mode, PAPER)
        slots = workspace.assembly_of(here, mode)
        np.testing.assert_array_equal(slots, oracle.assembly_slots(parallel))
        seen |= set(slots.tolist())
    assert seen == set(range(len(ASSEMBLY_MODES)))


def test_conditioning_at_points_is_that_of_their_posture():
    points = oracle.grid(TASK_REGION.low, TASK_REGION.high, (7, 5, 6))
    expected = jacobian.conditioning(inverse(points))
    np.testing.assert_allclose(workspace.conditioning_at(points), expected, rtol=1e-12)
    single = workspace.conditioning_at(points[1, 2, 3])
    assert single.shape == ()
    assert single == pytest.approx(expected[1, 2, 3])


def test_conditioning_is_zero_where_a_branch_does_not_exist():
    points = np.array([[0, 0.03, 5], [0, 0.06, 0.75], [np.nan, 0, 0], [0, -0.03, 0.75]])
    np.testing.assert_array_equal(workspace.conditioning_at(points), 0)
    assert workspace.conditioning_at(points[0]) == 0
    # y < 0 is the other half of the assembly modes, where it is as good as at y > 0.
    other = AssemblyMode(DEFAULT_ASSEMBLY.planar, -1)
    mirrored = workspace.conditioning_at([0, -0.03, 0.75], ELBOWS_OUT, other)
    assert mirrored == pytest.approx(workspace.conditioning_at([0, 0.03, 0.75]))
    assert mirrored > 0.1


@examples(200, triples, triples)
def test_projection_is_inside_idempotent_and_nearest(point, other):
    assert BOX.contains([[point, other]]).tolist() == [[BOX.contains(point), BOX.contains(other)]]
    assert BOX.project([[point, other]]).shape == (1, 2, 3)
    for region in (TASK_REGION, BOX):
        projected = region.project(point)
        assert region.contains(projected)
        np.testing.assert_array_equal(region.project(projected), projected)
        distance = np.linalg.norm(projected - point)
        competitor = np.clip(other, region.low, region.high)
        assert distance <= np.linalg.norm(competitor - point) + 1e-12
        assert region.contains(point) == (distance == 0)


@pytest.mark.parametrize("low", [(0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1), (float("nan"), 0, 0)])
def test_empty_regions_are_refused(low):
    with pytest.raises(ConfigurationError) as caught:
        Region(low=low, high=(0.0, 0.0, 0.0))
    assert caught.value.name == "low"
