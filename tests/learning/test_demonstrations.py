"""Demonstrations are whole episodes of the expert, as a replay buffer would have recorded them."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env

from tpm_gym.learning import Demonstrations, PenaltyHerReplayBuffer

HORIZON = 50


def filled(envs: int = 1, **options: Any) -> tuple[SAC, Demonstrations]:
    """A model whose training has begun, and has been told to end at once."""
    venv = make_vec_env("TPMPickAndPlace-v0", n_envs=envs, seed=0)
    model = SAC(
        "MultiInputPolicy",
        venv,
        seed=3,
        buffer_size=5000,
        learning_starts=10_000,
        policy_kwargs={"net_arch": [8]},
        replay_buffer_class=PenaltyHerReplayBuffer,
    )
    callback = Demonstrations(**options)
    model.learn(1, callback=callback)
    return model, callback


def test_the_buffer_holds_what_the_environment_would_do_again():
    model, _ = filled(episodes=2, noise=0.3)
    buffer = model.replay_buffer
    env = gym.make("TPMPickAndPlace-v0")
    rng = np.random.default_rng(3)
    # The second episode's seed comes after the first one's, and the noise of its steps.
    seed = int(rng.integers(1_000_000))
    observation, _ = env.reset(seed=seed)
    for row in range(HORIZON):
        for name, values in observation.items():
            assert np.array_equal(buffer.observations[name][row, 0], values)
        observation, reward, *_ = env.step(buffer.actions[row, 0])
        assert buffer.rewards[row, 0] == np.float32(reward)
        for name, values in observation.items():
            assert np.array_equal(buffer.next_observations[name][row, 0], values)
    env.close()


def test_episodes_end_by_time_and_not_by_failure():
    model, _ = filled(episodes=2, noise=0.0)
    buffer = model.replay_buffer
    assert buffer.dones[: 2 * HORIZON, 0].reshape(2, HORIZON)[:, -1].all()
    assert buffer.dones[: 2 * HORIZON].sum() == 2
    # An end by time is no end of the return, so the samples say "not done".
    assert not buffer.sample(64).dones.any()


def test_every_second_episode_is_disturbed_and_the_vacuum_never():
    calm, _ = filled(episodes=2, noise=0.0)
    noisy, _ = filled(episodes=2, noise=0.3)
    before, after = (np.array(m.replay_buffer.actions[: 2 * HORIZON, 0]) for m in (calm, noisy))
    assert np.array_equal(before[:HORIZON], after[:HORIZON])
    assert not np.array_equal(before[HORIZON:], after[HORIZON:])
    assert set(after[:, 3]) == {-1.0, 1.0}


def test_they_are_not_played_again_when_a_run_goes_on():
    model, callback = filled(episodes=2, noise=0.0)
    model.learn(1, callback=callback, reset_num_timesteps=False)
    assert model.replay_buffer is not None
    assert model.replay_buffer.size() == 2 * HORIZON + 1


def test_without_a_replay_buffer_they_are_refused():
    model = PPO("MultiInputPolicy", make_vec_env("TPMReach-v0"), n_steps=8, batch_size=8)
    with pytest.raises(TypeError, match="replay buffer"):
        model.learn(1, callback=Demonstrations(episodes=1))
