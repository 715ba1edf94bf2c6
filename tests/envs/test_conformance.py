"""What every registered id promises."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from episodes import random_episode
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import tpm_gym
from tpm_gym.errors import ActionError, ConfigurationError, EpisodeError, TPMError

INFO_KEYS = {
    "is_success",
    "closure_error",
    "conditioning",
    "singularity_penalty",
    "assembly_mode_changed",
    "working_mode_changed",
    "reward_terms",
}


@pytest.fixture(params=tpm_gym.ENV_IDS)
def env(request):
    env = gym.make(request.param)
    yield env
    env.close()


def test_the_checkers_of_gymnasium_and_sb3_find_nothing(env):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gymnasium_check_env(env.unwrapped)
        sb3_check_env(env.unwrapped)


def test_observations_are_in_the_space_finite_and_of_order_one(env):
    largest = 0.0
    for observation, reward, info in random_episode(env, 1):
        assert env.observation_space.contains(observation)
        assert np.isfinite(reward)
        assert set(info) == INFO_KEYS
        assert isinstance(info["is_success"], bool)
        assert info["assembly_mode_changed"] is info["working_mode_changed"] is False
        assert 0.0 <= info["conditioning"] <= 1.0
        assert 0.0 <= info["singularity_penalty"] <= 1.0
        largest = max(largest, np.abs(observation["observation"]).max())
    assert 0.5 < largest < 5.0


def test_reward_terms_sum_to_the_reward(env):
    for index, (_, reward, info) in enumerate(random_episode(env, 2)):
        if index:
            assert sum(info["reward_terms"].values()) == pytest.approx(reward, abs=1e-12)


def test_episodes_are_truncated_after_fifty_steps_and_never_terminated(env):
    env.reset(seed=0)
    flags = [env.step(env.action_space.sample())[2:4] for _ in range(50)]
    assert flags == [(False, False)] * 49 + [(False, True)]


def test_resets_are_randomised_but_repeat_with_the_seed(env):
    first, second, again = (env.reset(seed=seed)[0]["desired_goal"] for seed in (3, 4, 3))
    assert not np.array_equal(first, second)
    assert np.array_equal(first, again)
    assert not np.array_equal(env.reset()[0]["desired_goal"], again)


def test_observations_share_no_memory(env):
    steps = list(random_episode(env, 7, steps=3))
    for index, (observation, _, _) in enumerate(steps):
        for other, _, _ in steps[index + 1 :]:
            for name in observation:
                assert not np.shares_memory(observation[name], other[name])
    before = env.unwrapped.state.fk_position.copy()
    steps[-1][0]["achieved_goal"][:] = 9.0
    steps[-1][0]["desired_goal"][:] = 9.0
    assert np.array_equal(env.unwrapped.state.fk_position, before)
    assert not (env.unwrapped.goal == 9.0).any()


def test_compute_reward_is_vectorised_and_keeps_what_info_holds(env):
    steps = list(random_episode(env, 8))[1:]
    achieved = np.array([observation["achieved_goal"] for observation, _, _ in steps])
    desired = np.array([observation["desired_goal"] for observation, _, _ in steps])
    infos = [info for _, _, info in steps]
    rewards = np.array([reward for _, reward, _ in steps])
    compute = env.unwrapped.compute_reward
    assert np.array_equal(compute(achieved, desired, infos), rewards)
    goal_terms = [info["reward_terms"]["goal"] for info in infos]
    assert np.array_equal(compute(achieved, desired, [{}] * len(steps)), goal_terms)
    # Relabelled with what was achieved, every goal term is at its best.
    assert np.array_equal(compute(achieved, achieved, [{}] * len(steps)), np.zeros(len(steps)))


def bad_actions(size):
    ok = np.zeros(size)
    yield np.full(size, np.nan)
    yield np.where(np.arange(size) == 1, np.inf, ok)
    yield np.zeros(size + 1)
    yield np.zeros((1, size))
    yield 0.0
    yield "up"
    yield None
    yield [[0.0], [0.0, 1.0]]


def test_bad_actions_raise_and_leave_the_simulation_as_it_was(env):
    def run(with_bad_actions):
        env.reset(seed=9)
        for _ in range(3):
            env.step(np.full(env.action_space.shape, 0.5))
        if with_bad_actions:
            for action in bad_actions(env.action_space.shape[0]):
                with pytest.raises(ActionError):
                    env.unwrapped.step(action)
        return env.unwrapped.step(np.full(env.action_space.shape, -0.5))[0]["observation"]

    assert np.array_equal(run(True), run(False))


def test_actions_beyond_the_space_are_clipped(env):
    def run(size):
        env.reset(seed=10)
        return env.unwrapped.step(np.full(env.action_space.shape, size))[0]["observation"]

    assert np.array_equal(run(1.0), run(1e9))


@pytest.mark.parametrize(
    "options",
    [
        {"goal": (0.0, 0.0, 5.0)},
        {"goal": (np.nan, 0.0, 0.1)},
        {"goal": (0.0, 0.0)},
        {"goal": "there"},
        {"object": (1.0, 0.0, 0.015)},
        {"object": (0.0, -0.028, -0.3)},
        {"colour": "red"},
        ["goal"],
    ],
)
def test_bad_reset_options_raise_and_the_environment_stays_usable(env, options):
    env.reset(seed=11)
    with pytest.raises(TPMError):
        env.unwrapped.reset(options=options)
    env.unwrapped.step(np.zeros(env.action_space.shape))
    observation, _ = env.reset(seed=12)
    assert env.observation_space.contains(observation)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"penalty_weight": -1.0},
        {"penalty_weight": np.nan},
        {"penalty_weight": "much"},
        {"randomisation": 0.1},
        {"randomisation": {"encoder_jitter": 0.1}},
        {"renderer": "raytracer"},
        {"width": 0},
        {"height": 2.5},
        {"control": "torque"},
        {"reward": "none"},
        {"task": "juggle"},
    ],
)
def test_bad_constructor_options_raise(kwargs):
    with pytest.raises(ConfigurationError) as caught:
        gym.make("TPMReach-v0", **kwargs)
    assert caught.value.name == next(iter(kwargs))
    assert repr(caught.value.value) == repr(kwargs[caught.value.name])


def test_unknown_constructor_options_raise_a_type_error():
    with pytest.raises(TypeError, match="colour"):
        gym.make("TPMReach-v0", colour="red")


def test_stepping_outside_an_episode_raises(env):
    bare = env.unwrapped
    action = np.zeros(env.action_space.shape)
    with pytest.raises(EpisodeError, match="reset"):
        bare.step(action)
    with pytest.raises(EpisodeError):
        _ = bare.state
    bare.reset(seed=0)
    bare.close()
    bare.close()
    for call in (lambda: bare.step(action), bare.reset, bare.render):
        with pytest.raises(EpisodeError, match="closed"):
            call()
