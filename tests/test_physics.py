"""Numerical settings, the path between commands, and rotations."""

from __future__ import annotations

from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tpm_gym import physics
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism import CUP_RADIUS
from tpm_gym.physics import Physics, rotations, spline_weights

NAN = float("nan")


def test_defaults_are_500_hz_physics_under_25_hz_control() -> None:
    assert Physics().substeps == 20
    assert Physics().time_step * Physics().substeps == pytest.approx(Physics().control_period)
    with pytest.raises(FrozenInstanceError):
        Physics().erp = 0.5  # type: ignore[misc]


@pytest.mark.parametrize(
    ("time_step", "period", "substeps"), [(0.04, 0.04, 1), (0.001, 0.03, 30), (1 / 240, 1 / 12, 20)]
)
def test_substeps_fill_the_control_period(time_step: float, period: float, substeps: int) -> None:
    assert Physics(time_step=time_step, control_period=period).substeps == substeps


@pytest.mark.parametrize(
    ("name", "value"),
    [("time_step", value) for value in (0.0, -0.002, 0.05, 0.003, NAN, float("inf"))]
    + [("time_step", "x"), ("control_period", float("inf")), ("control_period", None)]
    + [("iterations", value) for value in (0, -1, 1.5, NAN, True, "50")]
    + [("erp", value) for value in (0.0, -0.1, 1.01, NAN, True, [0.8])],
)
def test_settings_that_cannot_work_are_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(ConfigurationError) as caught:
        Physics(**{name: value})
    assert caught.value.name == name
    assert caught.value.value is value


@pytest.mark.parametrize("period", [0.0, -0.04, NAN, 0.041])
def test_control_periods_that_time_steps_do_not_fill_are_refused(period: float) -> None:
    with pytest.raises(ConfigurationError):
        Physics(control_period=period)


def test_the_ends_of_the_ranges_are_allowed() -> None:
    assert Physics(iterations=1, erp=1.0).erp == 1.0


def test_pull_off_force_is_60_kpa_on_the_lip() -> None:
    assert pytest.approx(60e3 * np.pi * CUP_RADIUS**2, rel=0.02) == physics.PULL_OFF_FORCE


def path(commands: np.ndarray, substeps: int) -> np.ndarray:
    """Targets along all commands, period after period."""
    weights = spline_weights(substeps)
    return np.concatenate([weights @ commands[i : i + 3] for i in range(len(commands) - 2)])


@pytest.mark.parametrize("substeps", [1, 2, 20, 50])
def test_spline_weights_are_convex(substeps: int) -> None:
    weights = spline_weights(substeps)
    assert weights.shape == (substeps, 3)
    assert (weights >= 0).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=1e-15)
    np.testing.assert_allclose(weights[-1], [0, 0.5, 0.5])


def test_spline_follows_a_line_evenly() -> None:
    commands = np.arange(8.0)
    found = path(commands, 20)
    np.testing.assert_allclose(np.diff(found), 1 / 20, rtol=1e-12)
    assert found[-1] == pytest.approx(6.5)  # half a period late
    np.testing.assert_allclose(path(np.full(5, 3.0), 20), 3.0)


def test_spline_has_no_jump_in_velocity_and_bounded_acceleration() -> None:
    commands = np.random.default_rng(0).normal(size=12)
    for substeps in (20, 200):
        velocity = np.diff(path(commands, substeps)) * substeps
        acceleration = np.diff(velocity) * substeps
        largest = np.abs(np.diff(commands, 2)).max()
        assert np.abs(acceleration).max() <= largest * (1 + 1e-6)
        # Across a border between periods the acceleration is between those of the periods, so
        # the velocity is continuous.
        assert np.abs(np.diff(velocity)).max() <= largest / substeps * (1 + 1e-6)


quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)


def unit(q: tuple[float, ...]) -> np.ndarray:
    return np.array(q) / np.linalg.norm(q)


def turned(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vector v turned by quaternion q = (x, y, z, w)."""
    return v + 2 * np.cross(q[:3], np.cross(q[:3], v) + q[3] * v)


@settings(derandomize=True, max_examples=100)
@given(quaternions, st.tuples(*[st.floats(-2, 2)] * 3))
def test_rotations_turn_vectors_as_quaternions_do(
    q: tuple[float, ...], v: tuple[float, ...]
) -> None:
    matrix = rotations(unit(q)[None])[0]
    np.testing.assert_allclose(matrix @ v, turned(unit(q), np.array(v)), atol=1e-12)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1)


def test_rotations_of_known_quaternions() -> None:
    half = np.sqrt(0.5)
    found = rotations(np.array([[0, 0, 0, 1], [1, 0, 0, 0], [0, 0, half, half]]))
    expected = [np.eye(3), np.diag([1, -1, -1]), [[0, -1, 0], [1, 0, 0], [0, 0, 1]]]
    np.testing.assert_allclose(found, expected, atol=1e-15)
