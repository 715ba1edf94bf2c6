"""Demonstrations are whole episodes of the expert, recorded as by a replay buffer, or imitated."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from tpm_gym.learning import (
    AnalyticVecEnv,
    Demonstrations,
    GoalGapExtractor,
    PenaltyHerReplayBuffer,
    demonstrations,
)
from tpm_gym.learning.cloning import clone
from tpm_gym.learning.demonstrations import _returns, _Step
from tpm_gym.learning.environments import make_envs
from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.policies import TrainedPolicy
from tpm_gym.learning.rollout import TEST_SEED, run_episodes, summarise

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


def test_every_second_episode_is_disturbed_and_the_vacuum_never():
    calm, _ = filled(episodes=2, noise=0.0)
    noisy, _ = filled(episodes=2, noise=0.3)
    before, after = (np.array(m.replay_buffer.actions[: 2 * HORIZON, 0]) for m in (calm, noisy))
    assert np.array_equal(before[:HORIZON], after[:HORIZON])
    assert not np.array_equal(before[HORIZON:], after[HORIZON:])
    assert set(after[:, 3]) == {-1.0, 1.0}
    assert np.abs(after).max() == 1.0  # noise leads to no action outside of the space


def test_an_episode_that_ends_early_is_followed_by_another_and_all_are_whole():
    count, drive = 64, {"stiffness": 1500.0, "damping": 10.0}  # too weak for full speed
    envs = gym.make_vec(
        "TPMPickAndPlace-v0",
        num_envs=count,
        engine="analytic",
        autoreset_mode="SameStep",
        drive=drive,
    )
    venv, kind = AnalyticVecEnv(envs), PenaltyHerReplayBuffer
    model = SAC("MultiInputPolicy", venv, seed=1, buffer_size=6400, replay_buffer_class=kind)
    model._setup_learn(1, callback := Demonstrations(episodes=count, noise=3.0))
    callback.init_callback(model)
    callback.on_training_start({}, {})
    buffer: Any = model.replay_buffer
    assert buffer.pos == HORIZON
    ends = np.argwhere(buffer.dones[:HORIZON])
    assert len(ends) > count  # some ended early
    assert set(ends[ends[:, 0] == HORIZON - 1][:, 1]) == set(range(count))
    assert (buffer.ep_length[:HORIZON] > 0).all()  # every step is of an episode with an end
    assert buffer.timeouts[:HORIZON].sum() == len(ends)
    assert 0.1 < callback.successes < 0.9


def test_episodes_are_as_long_as_those_of_the_training_and_imitated_without_their_noise(
    monkeypatch,
):
    wanted: list[Any] = []
    monkeypatch.setattr(demonstrations, "clone", lambda *parts: wanted.append(parts[2]))
    venv = make_vec_env("TPMReach-v0", n_envs=2, env_kwargs={"max_episode_steps": 20})
    for noise in (0.0, 0.5):
        model = PPO("MultiInputPolicy", venv, n_steps=10, batch_size=10, seed=0)
        model._setup_learn(1, callback := Demonstrations(episodes=2, noise=noise))
        callback.on_training_start({}, {})
        assert model.num_timesteps == 2 * 20
    np.testing.assert_array_equal(*(actions[:2] for actions in wanted))


def test_without_a_replay_buffer_the_networks_imitate_them():
    envs = make_envs("TPMReach-v0", 64, engine="analytic", autoreset_mode="SameStep")
    kwargs = {"net_arch": [64, 64], "features_extractor_class": GoalGapExtractor}
    venv = AnalyticVecEnv(envs)
    model = PPO("MultiInputPolicy", venv, 1e-3, 8, gamma=0.9, seed=3, policy_kwargs=kwargs)
    callback = Demonstrations(episodes=256, noise=0.2, epochs=20)
    model._setup_learn(1, callback)
    callback.on_training_start({}, {})
    assert model.num_timesteps == 256 * HORIZON
    test = make_envs("TPMReach-v0", 64, engine="analytic")
    episodes = run_episodes(test, TrainedPolicy(model), 64, TEST_SEED)
    assert summarise(episodes)["success_at_end"].mean > 0.9
    test.close()
    venv.close()


def test_the_value_function_is_fitted_to_the_returns():
    model = PPO("MultiInputPolicy", make_vec_env("TPMReach-v0"), seed=0, device="cpu")
    rng, spaces = np.random.default_rng(0), model.observation_space
    seen = {name: rng.normal(size=(10_000, *box.shape)) for name, box in spaces.items()}
    returns = 3.0 * seen["observation"][:, 0] - 20.0
    clone(model, seen, np.zeros((10_000, 3)), returns, epochs=1)
    values = model.policy.predict_values(model.policy.obs_to_tensor(seen)[0])[:, 0].detach()
    assert np.mean((values.numpy() - returns) ** 2) < 0.1 * np.var(returns)


def test_networks_that_see_normalised_observations_are_refused():
    venv = VecNormalize(make_vec_env("TPMReach-v0"))
    model = PPO("MultiInputPolicy", venv, n_steps=10, batch_size=10)
    with pytest.raises(ConfigError, match="norm_obs=False"):
        model.learn(10, callback=Demonstrations(episodes=1))
    venv.close()


def test_returns_go_on_after_the_last_step():
    def step(reward: float, ended: bool) -> Any:
        nothing = np.zeros((1, 0))
        return _Step({}, nothing, nothing, {}, np.array([reward]), np.array([ended]), {})

    steps = [step(-1, False), step(-1, True), step(0, False), step(-2, True)]
    found = np.concatenate(_returns(steps, 0.5)).tolist()
    assert found == [-1 - 0.5 * 2, -2, 0 - 0.5 * 4, -4]
    assert np.concatenate(_returns(steps, 1.0)).tolist() == [-2, -1, -2, -2]
