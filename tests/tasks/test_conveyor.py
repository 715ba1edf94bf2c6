"""Conveyor: the expert meets blocks that it sees late, on belts of any speed."""

import gymnasium as gym
import numpy as np
import pytest
from episodes import expert_episode
from machines import each_machine

from tpm_gym import TPMEnv
from tpm_gym.errors import ConfigurationError, ResetOptionError, UnreachableError
from tpm_gym.mechanism import PAPER_TPM, WIDE_TPM
from tpm_gym.tasks import Conveyor
from tpm_gym.tasks.conveyor import SPEEDS

each_engine = pytest.mark.parametrize("engine", ["pybullet", "mujoco", "analytic"])
STEPS = Conveyor.max_episode_steps


@each_engine
@each_machine
@pytest.mark.parametrize("episodes", [2, pytest.param(100, marks=pytest.mark.slow)])
def test_the_expert_brings_the_block_to_its_place_in_the_tray(engine, machine, episodes):
    env = gym.make("TPMConveyor-v0", engine=engine, machine=machine)
    for seed in range(episodes):
        *_, (_, _, info) = expert_episode(env, seed, STEPS)
        state = env.unwrapped.state
        assert info["is_success"]
        assert state.held == -1
        assert state.object_position[0, 0] > env.unwrapped.task.belt.end


@pytest.mark.parametrize("speed", [SPEEDS[0], SPEEDS[1], 0.0])
def test_the_expert_picks_at_any_speed_of_the_belt(speed):
    env = gym.make("TPMConveyor-v0", engine="analytic")
    options = {"belt_speed": speed, "object": (-0.19, -0.03, 0.015)}
    *_, (_, _, info) = expert_episode(env, 0, STEPS, options)
    assert env.unwrapped.state.belt_speed == speed
    assert info["is_success"]
    # A block on a belt that stands is drawn at the edge of the reach.
    *_, (_, _, info) = expert_episode(env, 0, STEPS, {"belt_speed": speed})
    assert info["is_success"]


def test_tempting_ways_are_only_just_safe():
    env = gym.make("TPMConveyor-v0", engine="analytic", goals="tempting")
    for seed in range(6):
        *steps, (_, _, info) = expert_episode(env, seed, STEPS)
        assert info["is_success"]
        least = min(info["conditioning"] for _, _, info in steps)
        assert 0.95 < least / PAPER_TPM.safe_conditioning < 1.4
    with pytest.raises(ConfigurationError, match="no such way"):  # all its table is safe
        Conveyor(WIDE_TPM, goals="tempting").start([np.random.default_rng(0)])


class Watched(Conveyor):
    """Reports when the block has moved by 5 mm."""

    events, origin = ("moved",), 0.0

    def moved(self, state):
        return state.object_position[:, 0, 0] > self.origin + 0.005

    lost = moved


def test_the_camera_alone_shows_the_block_late_and_as_many_steps_as_stated():
    env = TPMEnv(Watched, reward="dense", engine="analytic")
    rng, delay = np.random.default_rng(0), Conveyor.camera_delay
    for seed in range(2):  # the second episode shows nothing of the first
        observation, _ = env.reset(seed=seed)
        true, shown = [env.state.object_position[0].copy()], []
        env.task.origin = true[0][0]
        for step in range(12):
            seen = env.task.decode(observation["observation"])["object_position"]
            np.testing.assert_allclose(seen, observation["achieved_goal"], atol=1e-6)
            shown.append(seen)
            if step == 6:  # a snapshot keeps what the camera has yet to show
                snapshot = env.save_state()
                env.step(env.action_space.sample())
                observation = env.restore_state(snapshot)
            observation, *_, info = env.step(rng.uniform(-1, 1, 4))
            true.append(env.state.object_position[0].copy())
            state = env._core.state
            assert info["moved"] is info["object_lost"] is env.task.moved(state).item()
            assert info["reward_terms"]["approach"] == env.task.shaping(state)["approach"]
            env.state.object_position[:] = 5.0  # changes nothing that the camera shows
        expected = [true[max(0, k - delay)] for k in range(len(shown))]
        np.testing.assert_allclose(shown, expected, atol=1e-6)
        assert true[-1][0] - true[0][0] > 0.01


def test_impossible_options_of_the_belt_are_refused():
    task = Conveyor(PAPER_TPM)
    rngs = [np.random.default_rng(0)]
    for speed in (1.5, np.nan, [0.1, 0.1], "fast", [[0.1], [0.1, 0.2]]):
        with pytest.raises(ResetOptionError, match="belt_speed"):
            task.start(rngs, {"belt_speed": speed})
    with pytest.raises(UnreachableError):  # the place is in the tray
        task.start(rngs, {"object": (0.05, -0.03, 0.015)})
    with pytest.raises(UnreachableError):  # the goal is on the belt
        task.start(rngs, {"goal": (-0.1, -0.03, 0.015)})
