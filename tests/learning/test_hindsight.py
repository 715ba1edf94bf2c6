"""The penalty survives hindsight: relabelled rewards are what the environment would have paid."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import SAC
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize
from stable_baselines3.her import HerReplayBuffer

import tpm_gym  # noqa: F401  # registers the ids
from tpm_gym.learning import PenaltyHerReplayBuffer
from tpm_gym.learning.errors import ConfigError

HORIZON = 10


class PenaltyEnv(gym.Env[dict[str, NDArray[Any]], NDArray[Any]]):
    """A point whose penalty is large, random and visible in the observation.

    A real robot is rarely penalised; here every single transition is, by an amount no two share.
    """

    def __init__(self) -> None:
        box = spaces.Box(-np.inf, np.inf, (3,), np.float64)
        penalty = spaces.Box(0, np.inf, (1,), np.float64)
        self.observation_space = spaces.Dict(
            observation=penalty, achieved_goal=box, desired_goal=box
        )
        self.action_space = spaces.Box(-1, 1, (3,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.position = np.zeros(3)
        self.goal = self.np_random.uniform(-0.3, 0.3, 3)
        self.step_count, self.penalty = 0, 0.0
        return self._observation(), {}

    def step(self, action: NDArray[Any]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.position = self.position + 0.1 * action
        self.penalty = self.np_random.uniform(0.1, 2.0)
        self.step_count += 1
        info = {"singularity_penalty": self.penalty}
        reward = float(self.compute_reward(self.position, self.goal, info))
        return self._observation(), reward, False, self.step_count == HORIZON, info

    def _observation(self) -> dict[str, NDArray[Any]]:
        return {
            "observation": np.array([self.penalty]),
            "achieved_goal": self.position.copy(),
            "desired_goal": self.goal.copy(),
        }

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        penalty = [entry.get("singularity_penalty", 0.0) for entry in np.atleast_1d(info)]
        return task_reward(achieved, desired) - np.reshape(penalty, np.shape(achieved)[:-1])


def task_reward(achieved: Any, desired: Any) -> Any:
    """Sparse, plus a distance: both a jump and a slope must be carried over."""
    distance = np.linalg.norm(np.asarray(achieved) - np.asarray(desired), axis=-1)
    return -(distance > 0.15).astype(float) - distance


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


def expected_rewards(samples: DictReplayBufferSamples) -> NDArray[np.float64]:
    """Return what PenaltyEnv would pay, from the observation alone."""
    after = {name: value.numpy() for name, value in samples.next_observations.items()}
    task = task_reward(after["achieved_goal"], after["desired_goal"])
    return task - after["observation"][:, 0]


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("strategy", ["future", "final", "episode"])
def test_every_transition_is_paid_as_the_environment_would(n_envs: int, strategy: str) -> None:
    # 130 steps of 3 environments go around the buffer of 200 almost twice.
    model = filled(
        PenaltyHerReplayBuffer,
        DummyVecEnv([PenaltyEnv] * n_envs),
        steps=130,
        goal_selection_strategy=strategy,
    )
    samples = draw(model)
    np.testing.assert_allclose(
        samples.rewards.numpy()[:, 0], expected_rewards(samples), rtol=0, atol=1e-6
    )


@pytest.mark.parametrize("make", [PenaltyEnv, partial(gym.make, "TPMReach-v0")])
def test_same_samples_as_copying_every_info(make: Callable[[], Any]) -> None:
    ours = draw(filled(PenaltyHerReplayBuffer, DummyVecEnv([make]), steps=300))
    slow = draw(filled(HerReplayBuffer, DummyVecEnv([make]), steps=300, copy_info_dict=True))
    np.testing.assert_allclose(ours.rewards.numpy(), slow.rewards.numpy(), rtol=0, atol=1e-6)
    for name, value in ours.next_observations.items():
        np.testing.assert_array_equal(value.numpy(), slow.next_observations[name].numpy())


def test_observations_may_be_normalised() -> None:
    envs = VecNormalize(DummyVecEnv([PenaltyEnv]), norm_reward=False)
    model = filled(PenaltyHerReplayBuffer, envs)
    plain, normalised = draw(model), draw(model, env=envs)
    np.testing.assert_array_equal(plain.rewards.numpy(), normalised.rewards.numpy())
    np.testing.assert_allclose(plain.rewards.numpy()[:, 0], expected_rewards(plain), atol=1e-6)


@pytest.mark.parametrize(
    ("norm_reward", "copy_info_dict", "message"),
    [(True, False, "norm_reward=False"), (False, True, "counted twice")],
)
def test_what_would_change_the_penalty_is_refused(
    norm_reward: bool, copy_info_dict: bool, message: str
) -> None:
    envs = VecNormalize(DummyVecEnv([PenaltyEnv]), norm_reward=norm_reward)
    with pytest.raises(ConfigError, match=message):
        filled(PenaltyHerReplayBuffer, envs, copy_info_dict=copy_info_dict)
