"""The penalty survives hindsight: relabelled rewards are what the environment would have paid."""

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize
from stable_baselines3.her import HerReplayBuffer

import tpm_gym  # noqa: F401  # registers the ids
from tpm_gym.learning import PenaltyHerReplayBuffer
from tpm_gym.learning.errors import ConfigError

HORIZON = 10


class Penalised(gym.Wrapper[Any, Any, Any, Any]):
    """A robot is rarely penalised; here every single transition is, by an amount no two share."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        penalty = self.np_random.uniform(0.1, 2.0)
        info["reward_terms"]["singularity"] -= penalty
        return observation, float(reward) - penalty, terminated, truncated, info


def penalised(env_id: str = "TPMReach-v0") -> Penalised:
    return Penalised(gym.make(env_id, max_episode_steps=HORIZON))


def filled(
    buffer: type[HerReplayBuffer], envs: VecEnv, steps: int = 60, **buffer_kwargs: Any
) -> SAC:
    """Return a SAC that has acted at random, and learned, with a small buffer of the given type."""
    model = SAC(
        "MultiInputPolicy",
        envs,
        replay_buffer_class=buffer,
        replay_buffer_kwargs=buffer_kwargs,
        buffer_size=200,
        learning_starts=HORIZON * envs.num_envs * 5,
        policy_kwargs={"net_arch": [8]},
        seed=0,
        device="cpu",
    )
    model.learn(steps * envs.num_envs)
    return model


def draw(model: SAC, seed: int = 0, env: VecNormalize | None = None) -> DictReplayBufferSamples:
    """Return 500 transitions, four fifths of them relabelled; a seed repeats them."""
    np.random.seed(seed)  # noqa: NPY002  # the generator Stable-Baselines3 draws from
    return model.replay_buffer.sample(500, env=env)


@pytest.mark.parametrize(
    ("n_envs", "strategy", "env_id"),
    [(1, "future", "TPMReach-v0"), (3, "final", "TPMReach-v0"), (3, "episode", "TPMReachDense-v0")],
)
def test_same_samples_and_rewards_as_the_environment_pays_by_copied_infos(n_envs, strategy, env_id):
    def sampled(buffer, **options):
        # 130 steps of 3 environments go around the buffer of 200 almost twice.
        envs = DummyVecEnv([partial(penalised, env_id)] * n_envs)
        return draw(filled(buffer, envs, 130, goal_selection_strategy=strategy, **options))

    ours, slow = sampled(PenaltyHerReplayBuffer), sampled(HerReplayBuffer, copy_info_dict=True)
    np.testing.assert_allclose(ours.rewards.numpy(), slow.rewards.numpy(), rtol=0, atol=1e-6)
    # What rewards that differ in their last bit have trained may act otherwise by as much.
    for name, value in ours.next_observations.items():
        expected = slow.next_observations[name].numpy()
        np.testing.assert_allclose(value.numpy(), expected, rtol=0, atol=1e-6)


def test_observations_may_be_normalised():
    envs = VecNormalize(DummyVecEnv([penalised]), norm_reward=False)
    model = filled(PenaltyHerReplayBuffer, envs)
    plain, normalised = draw(model), draw(model, env=envs)
    np.testing.assert_array_equal(plain.rewards.numpy(), normalised.rewards.numpy())


@pytest.mark.parametrize(
    ("norm_reward", "copy_info_dict", "message"),
    [(True, False, "norm_reward=False"), (False, True, "counted twice")],
)
def test_what_would_change_the_penalty_is_refused(norm_reward, copy_info_dict, message):
    envs = VecNormalize(DummyVecEnv([penalised]), norm_reward=norm_reward)
    with pytest.raises(ConfigError, match=message):
        filled(PenaltyHerReplayBuffer, envs, copy_info_dict=copy_info_dict)
