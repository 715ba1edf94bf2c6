"""Pixel observations: pictures in the place of what a camera would measure."""

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from episodes import conforms
from stable_baselines3 import SAC, HerReplayBuffer

from tpm_gym import TPMVectorEnv
from tpm_gym.errors import InputError
from tpm_gym.tasks import Expert

ROBOT = 9  # position, velocity, command
OPTIONS: dict[str, Any] = {"observations": "pixels", "pixel_size": 36}


@pytest.mark.parametrize("env_id", ["TPMReach-v0", "TPMPushJointsDense-v0", "TPMStack-v0"])
def test_observations_have_a_picture_and_the_robot_but_not_the_blocks(engine, env_id):
    env = gym.make(env_id, engine=engine, **OPTIONS)
    plain = gym.make(env_id, engine=engine)
    for seed in (0, 1):
        seen, told = env.reset(seed=seed)[0], plain.reset(seed=seed)[0]
        for _ in range(2):
            assert env.observation_space.contains(seen)
            assert (seen["pixels"].shape, seen["pixels"].dtype) == ((36, 36, 3), np.uint8)
            assert seen["pixels"].std() > 10
            np.testing.assert_array_equal(seen["observation"], told["observation"][:ROBOT])
            for name in ("achieved_goal", "desired_goal"):
                np.testing.assert_array_equal(seen[name], told[name])
            action = env.action_space.sample()
            seen, told = env.step(action)[0], plain.step(action)[0]


def test_the_picture_is_that_of_render_and_shows_the_present(engine):
    options = {"camera": "cup", "width": 36, "height": 36, "render_mode": "rgb_array"}
    env = gym.make("TPMPickAndPlace-v0", engine=engine, **OPTIONS, **options)
    observation, _ = env.reset(seed=0)
    for _ in range(3):
        assert np.array_equal(observation["pixels"], env.render())
        observation, *_ = env.step(np.array([1.0, 0.0, -1.0, 1.0]))
    snapshot = env.unwrapped.save_state()
    later = env.step(np.ones(4))[0]["pixels"]
    restored = env.unwrapped.restore_state(snapshot)
    assert np.array_equal(restored["pixels"], env.render())
    assert not np.array_equal(later, restored["pixels"])


def test_pixels_keep_what_is_promised(engine):
    conforms(partial(gym.make, "TPMPickAndPlace-v0", engine=engine, **OPTIONS))


def test_the_expert_needs_the_block_and_says_so():
    env = gym.make("TPMPickAndPlace-v0", engine="analytic", **OPTIONS)
    observation, _ = env.reset(seed=0)
    with pytest.raises(InputError, match=r"observations='state'"):
        Expert(env).act(observation)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_pixels_of_vector_environments_follow_autoreset(engine, mode):
    options = {"engine": engine, "autoreset_mode": mode, **OPTIONS}
    frames = {"render_mode": "rgb_array", "width": 36, "height": 36}
    envs = TPMVectorEnv("reach", num_envs=2, max_episode_steps=3, stagger=True, **options, **frames)
    first, _ = envs.reset(seed=[0, 1])
    assert envs.observation_space.contains(first)
    for step in range(4):
        observation, _, _, ended, infos = envs.step(envs.action_space.sample())
        assert np.array_equal(observation["pixels"], envs.render())
        assert ended.tolist() == [step == 2, step == 1]
        for row in np.flatnonzero(ended) if mode == "SameStep" else ():
            last = infos["final_obs"][row]["pixels"]
            assert not np.array_equal(last, observation["pixels"][row])
    envs.close()


def test_hindsight_trains_on_pixels(engine):
    env = gym.make("TPMPickAndPlace-v0", engine=engine, **OPTIONS)
    model = SAC(
        "MultiInputPolicy",
        env,
        buffer_size=200,
        learning_starts=60,
        batch_size=16,
        policy_kwargs={"net_arch": [16]},
        replay_buffer_class=HerReplayBuffer,
        seed=0,
    )
    model.learn(70)
    assert model.num_timesteps == 70
