"""Whatever the action, the next command is one that the simulation can follow."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics import DEFAULT_ASSEMBLY, forward_all, inverse
from tpm_gym.kinematics.workspace import TASK_REGION
from tpm_gym.tasks import control
from tpm_gym.tasks.control import JOINT_LIMIT, STEP_LIMIT, CartesianControl, Control, JointControl

FloatArray = NDArray[np.float64]
Triple = tuple[float, float, float]
LOW, HIGH = np.array(TASK_REGION.low), np.array(TASK_REGION.high)
CONTROLS = [CartesianControl(), JointControl()]

shares = st.one_of(st.floats(0, 1), st.sampled_from([0.0, 1.0]))
currents = st.tuples(shares, shares, shares).map(
    lambda share: np.clip(LOW + np.array(share) * (HIGH - LOW), LOW, HIGH)
)
parts = st.one_of(st.floats(-1, 1), st.sampled_from([-1.0, 1.0]))
actions = st.tuples(parts, parts, parts)


@pytest.mark.parametrize("kind", CONTROLS)
@settings(derandomize=True, max_examples=400, deadline=None)
@given(action=actions, current=currents)
def test_commands_stay_in_the_region_and_within_the_step_limit(
    kind: Control, action: Triple, current: FloatArray
) -> None:
    before = current.copy()
    command = kind.command(action, current)
    assert command.shape == (3,)
    assert TASK_REGION.contains(command)
    assert (np.abs(command - current) <= STEP_LIMIT * (1 + 1e-9)).all()
    np.testing.assert_array_equal(current, before)


@pytest.mark.parametrize("kind", CONTROLS)
@settings(derandomize=True, max_examples=50, deadline=None)
@given(current=currents)
def test_no_action_is_no_motion(kind: Control, current: FloatArray) -> None:
    np.testing.assert_allclose(kind.command(np.zeros(3), current), current, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", CONTROLS)
@settings(derandomize=True, max_examples=200, deadline=None)
@given(current=currents, way=actions)
def test_an_action_reaches_every_wanted_point_nearby(
    kind: Control, current: FloatArray, way: Triple
) -> None:
    wanted = TASK_REGION.project(current + 0.1 * np.array(way) * STEP_LIMIT)
    assert np.abs(inverse(wanted) - inverse(current)).max() < JOINT_LIMIT
    action = kind.action(wanted, current)
    assert np.abs(action).max() <= 1
    np.testing.assert_allclose(kind.command(action, current), wanted, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", CONTROLS)
@settings(derandomize=True, max_examples=200, deadline=None)
@given(current=currents, wanted=currents)
def test_actions_towards_far_points_are_in_the_unit_box(
    kind: Control, current: FloatArray, wanted: FloatArray
) -> None:
    action = kind.action(wanted, current)
    assert action.shape == (3,)
    assert np.abs(action).max() <= 1


@settings(derandomize=True, max_examples=200, deadline=None)
@given(action=actions, current=currents)
def test_cartesian_actions_are_fractions_of_the_step_limit(
    action: Triple, current: FloatArray
) -> None:
    command = CartesianControl().command(action, current)
    free = current + np.array(action) * STEP_LIMIT
    np.testing.assert_allclose(command, np.clip(free, LOW, HIGH), rtol=0, atol=1e-15)


@settings(derandomize=True, max_examples=200, deadline=None)
@given(wanted=currents, current=currents)
def test_joint_actions_towards_far_points_keep_their_direction(
    wanted: FloatArray, current: FloatArray
) -> None:
    action = JointControl().action(wanted, current)
    turn = inverse(wanted) - inverse(current)
    np.testing.assert_allclose(action * np.abs(turn).max(), turn * np.abs(action).max(), atol=1e-12)


def test_small_joint_actions_turn_the_joints_by_just_that() -> None:
    rng = np.random.default_rng(0)
    for current in rng.uniform(LOW + STEP_LIMIT, HIGH - STEP_LIMIT, (100, 3)):
        action = rng.uniform(-0.01, 0.01, 3)
        command = JointControl().command(action, current)
        turn = inverse(command) - inverse(current)
        np.testing.assert_allclose(turn, action * JOINT_LIMIT, rtol=0, atol=1e-9)


def test_joint_actions_at_full_scale_are_slowed_down_without_changing_direction() -> None:
    rng = np.random.default_rng(1)
    slowed = 0
    for current in rng.uniform(LOW, HIGH, (4000, 3)):
        action = rng.uniform(-1, 1, 3)
        action /= np.abs(action).max()
        full = forward_all(inverse(current) + action * JOINT_LIMIT)
        slot = DEFAULT_ASSEMBLY.index
        same_mode = full.valid[slot] and np.cos(full.beta[slot]) > 0
        far = not (np.abs(full.position[slot] - current) <= 1.01 * STEP_LIMIT).all()
        command = JointControl().command(action, current)
        if (same_mode and not far) or TASK_REGION.margin(command) < 1e-6:
            continue
        turn = inverse(command) - inverse(current)
        cosine = turn @ action / np.linalg.norm(turn) / np.linalg.norm(action)
        assert cosine > np.cos(np.deg2rad(0.1))
        assert (np.abs(command - current) / STEP_LIMIT).max() > 0.3
        slowed += 1
    assert slowed > 300


def test_cartesian_projection_keeps_the_other_axes_at_a_face() -> None:
    current = np.array([0.0, HIGH[1], 0.8])
    command = CartesianControl().command([0.5, 1.0, -0.5], current)
    np.testing.assert_allclose(command, [0.015, HIGH[1], 0.785])


def test_controls_are_made_by_name() -> None:
    assert isinstance(control.make("cartesian"), CartesianControl)
    assert isinstance(control.make("joints"), JointControl)
    with pytest.raises(ConfigurationError, match="'cartesian', 'joints'") as caught:
        control.make("torque")
    assert (caught.value.name, caught.value.value) == ("control", "torque")


def test_the_limits_cannot_be_changed_by_accident() -> None:
    with pytest.raises(ValueError, match="read-only"):
        STEP_LIMIT[0] = 1.0
