"""Numerical settings, the path between commands, rotations and rigid motions."""

from __future__ import annotations

from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.bodies import Vector
from tpm_gym.mechanism.links import CUP_PRELOAD, CUP_RADIUS
from tpm_gym.simulation import physics
from tpm_gym.simulation.physics import Physics, Quaternion, rotate, spline_weights, transform

NAN = float("nan")


def test_defaults_are_250_hz_physics_under_25_hz_control() -> None:
    assert Physics().substeps == 10
    assert Physics().solver == "direct"
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
    + [("solver", value) for value in ("dantzig", "Direct", "", None, 1)]
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
    assert [Physics(solver=name).solver for name in physics.SOLVERS] == ["direct", "iterative"]


def test_pull_off_force_is_60_kpa_on_the_lip() -> None:
    assert pytest.approx(60e3 * np.pi * CUP_RADIUS**2, rel=0.02) == physics.PULL_OFF_FORCE
    assert physics.PULL_OFF_FORCE < CUP_PRELOAD  # or a heavy puck would pull the cup out


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


vectors = st.tuples(*[st.floats(-2, 2)] * 3)
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)


def unit(q: Quaternion) -> Quaternion:
    x, y, z, w = (np.array(q) / np.linalg.norm(q)).tolist()
    return x, y, z, w


def matrix(quaternion: Quaternion) -> np.ndarray:
    """Rotation by the angle 2 atan2(|q|, w) about q (Rodrigues)."""
    *vector, w = quaternion
    length = np.linalg.norm(vector)
    if length == 0.0:
        return np.eye(3)
    cross = np.cross(np.eye(3), np.array(vector) / length)  # row i is e_i x axis = -axis x e_i
    angle = 2 * np.arctan2(length, w)
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


@settings(derandomize=True, max_examples=100)
@given(quaternions, vectors, vectors)
def test_rotate_and_transform_are_rigid_motions_by_the_quaternion(
    q: Quaternion, v: Vector, origin: Vector
) -> None:
    turned = rotate(unit(q), v)
    np.testing.assert_allclose(turned, matrix(unit(q)) @ v, atol=1e-12)
    assert all(type(value) is float for value in turned)
    np.testing.assert_allclose(transform(origin, unit(q), v), np.add(origin, turned), atol=1e-15)
    x, y, z, w = unit(q)
    np.testing.assert_allclose(rotate((-x, -y, -z, w), turned), v, atol=1e-12)


def test_rotate_by_known_quaternions() -> None:
    half = np.sqrt(0.5)
    known = {
        (0.0, 0.0, 0.0, 1.0): (1.0, 2.0, 3.0),
        (1.0, 0.0, 0.0, 0.0): (1.0, -2.0, -3.0),
        (0.0, 0.0, half, half): (-2.0, 1.0, 3.0),
    }
    for quaternion, expected in known.items():
        np.testing.assert_allclose(rotate(quaternion, (1.0, 2.0, 3.0)), expected, atol=1e-15)
