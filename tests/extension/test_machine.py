"""A machine that was written outside the package and is no TPM: a gantry."""

import gymnasium as gym
import numpy as np
import pytest
from episodes import random_episode
from gantry import GANTRY

import tpm_gym
from tpm_gym.errors import ConfigurationError


@pytest.mark.parametrize("env_id", ["TPMReachJoints-v0", "TPMPickAndPlace-v0"])
def test_it_goes_where_its_kinematics_say_whatever_is_asked(env_id):
    env = gym.make(env_id, machine="gantry")
    effort = GANTRY.mechanism.link("bridge").joint.effort
    for _ in random_episode(env, 0):
        state = env.unwrapped.state
        assert np.allclose(state.fk_position, state.platform_position, atol=1e-6)
        assert state.platform_tilt < 1e-6
        assert np.abs(state.torque).max() < effort
        point = GANTRY.mount.to_paper(state.fk_position)
        np.testing.assert_allclose(GANTRY.region.project(point), point, atol=1e-6)


def test_dynamics_and_modes_of_rows_follow_from_its_bodies():
    bridge, trolley, ram, cup = (link.mass for link in GANTRY.mechanism.links[1:])
    moved = np.array([bridge + trolley + ram + cup, trolley + ram + cup, ram + cup])
    theta, change, force = np.random.default_rng(0).uniform(-0.2, 0.2, (3, 2, 2, 3)) + GANTRY.home
    torque = GANTRY.torque(theta, change, change, force)
    expected = moved * (change - (0, 0, 9.81)) - force
    np.testing.assert_allclose(torque, expected, rtol=1e-5, atol=1e-5)
    built = np.array([GANTRY.built(), GANTRY.built(link_masses=(2.0,) * 4)])
    motion = GANTRY.motion(theta, change, built)
    for row, factor in enumerate((1.0, 2.0)):
        mass = np.broadcast_to(factor * np.diag(moved), (2, 3, 3))
        np.testing.assert_allclose(motion.mass[row], mass, rtol=1e-5, atol=1e-4)
        weight = np.broadcast_to(factor * moved * (0, 0, -9.81), (2, 3))
        np.testing.assert_allclose(motion.bias[row], weight, atol=1e-4)
    np.testing.assert_array_equal(GANTRY.forward(theta), theta)
    assert not GANTRY.mode_left(theta, theta).any()
    assert GANTRY.same_side(theta).all()
    assert (GANTRY.conditioning_at(theta) == 1.0).all()


@pytest.mark.parametrize("task", ["reach", "pick_and_place"])
def test_where_nothing_tempts_tempting_goals_are_refused(task):
    with pytest.raises(ConfigurationError, match="no straight line in the joints"):
        tpm_gym.TPMEnv(task, machine="gantry", goals="tempting")


def test_its_encoders_can_be_off_and_its_lengths_cannot():
    options = {"length_error": 1e-3, "encoder_bias": 1e-3}
    randomised = tpm_gym.TPMEnv(machine="gantry", randomisation=options)
    for seed in range(2):  # its J is read-only
        _, info = randomised.reset(seed=seed)
        assert info["randomisation"]["length_errors"] == ()
        assert any(info["randomisation"]["encoder_bias"])
