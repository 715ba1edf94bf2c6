"""The Delta in the engines: loops, experts, torques, and every option of an environment."""

import gymnasium as gym
import numpy as np
import pytest
from episodes import EVERYTHING, OF_SERVOS, expert_episode, random_episode

import tpm_gym
from tpm_gym.envs.ids import env_ids
from tpm_gym.mechanism import DELTA

ENGINES = ["pybullet", "mujoco", "analytic"]
every_engine = pytest.mark.parametrize("engine", ENGINES)


@every_engine
def test_the_expert_succeeds_with_closed_loops(engine):
    """Measured over 1,000 episodes: loops within 0.022 mm in PyBullet and MuJoCo."""
    env = gym.make("TPMPickAndPlace-v0", machine="delta", engine=engine)
    for seed in range(5):
        for _, _, info in expert_episode(env, seed):
            state = env.unwrapped.state
            assert info["closure_error"] < 0.06e-3
            assert state.platform_tilt < 1e-5
            np.testing.assert_allclose(state.fk_position, state.platform_position, atol=1e-4)
        assert info["is_success"]


@pytest.mark.parametrize(("env_id", "limit"), [("TPMReach-v0", 1e-4), ("TPMPickAndPlace-v0", 5e-3)])
def test_engines_agree_on_the_torques(env_id, limit):
    """Measured by rms: 0.001% without contact, 0.24% in 1,000 episodes of pick-and-place."""
    torques = {}
    for engine in ENGINES:
        env = gym.make(env_id, machine="delta", engine=engine)
        torques[engine] = np.array(
            [env.unwrapped.state.torque for seed in range(5) for _ in expert_episode(env, seed)]
        )
    rms = {engine: np.sqrt((found**2).mean()) for engine, found in torques.items()}
    assert 3 < rms["analytic"] < 10  # N m
    assert max(rms.values()) / min(rms.values()) < 1 + limit


TASKS = [name for name in env_ids() if "Dense" not in name and "Crossing" not in name]


@pytest.mark.parametrize("env_id", TASKS)
@every_engine
def test_every_task_and_control_runs(env_id, engine):
    env = gym.make(env_id, machine="delta", engine=engine)
    for _, _, info in random_episode(env, 0, 10):
        assert info["conditioning"] > 0.3
        assert info["closure_error"] < 0.06e-3


@every_engine
def test_every_randomisation_and_drive_runs(engine):
    env = gym.make(
        "TPMPickAndPlace-v0", machine="delta", engine=engine, drive="servo",
        randomisation=EVERYTHING | OF_SERVOS,
    )  # fmt: skip
    for seed in range(2):
        for _, _, info in expert_episode(env, seed):
            assert info["closure_error"] < 0.06e-3
        _, info = env.reset(seed=seed)
        assert len(info["randomisation"]["length_errors"]) == len(DELTA.lengths) == 5
        assert len(info["randomisation"]["link_masses"]) == len(DELTA.mechanism.links) - 1


def test_an_encoder_reads_the_true_position_of_a_machine_with_other_lengths():
    env = tpm_gym.TPMEnv(machine="delta", engine="mujoco", randomisation={"length_error": 1e-3})
    env.reset(seed=3)
    state = env.state
    off = np.linalg.norm(np.subtract(state.fk_position, state.platform_position))
    assert 1e-5 < off < 0.01
