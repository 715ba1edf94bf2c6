"""Hindsight replay that keeps a goal-independent penalty in relabelled rewards."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her import HerReplayBuffer

from tpm_gym.learning.errors import ConfigError


class PenaltyHerReplayBuffer(HerReplayBuffer):
    """Hindsight experience replay for a reward of the form ``R(achieved, goal) - penalty``.

    Stable-Baselines3 relabels four of five samples with ``compute_reward(achieved, new_goal, {})``.
    The info is empty, so the relabelled samples would lose the penalty. The penalty does not depend
    on the goal. With the stored reward r, the next achieved goal ag', the old goal g and the new
    goal g', the reward for g' is therefore

        r' = r - R(ag', g) + R(ag', g')
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Build the buffer with the arguments of ``stable_baselines3.HerReplayBuffer``.

        Raises:
            ConfigError: ``copy_info_dict`` is on: the penalty would be counted twice.
        """
        super().__init__(*args, **kwargs)
        if self.copy_info_dict:
            raise ConfigError(
                "copy_info_dict=True: the penalty would be counted twice; leave it off"
            )

    def _get_virtual_samples(
        self,
        batch_indices: NDArray[np.int64],
        env_indices: NDArray[np.int64],
        env: VecNormalize | None = None,
    ) -> DictReplayBufferSamples:
        """Relabel as the parent does, then add the goal-independent part of the reward."""
        if env is not None and env.norm_reward:
            # The parent has normalised R(ag', g'); a sum with raw rewards has no meaning.
            problem = "relabelled rewards cannot be corrected after normalisation"
            raise ConfigError(f"VecNormalize: {problem}; give it norm_reward=False")
        samples = super()._get_virtual_samples(batch_indices, env_indices, env)
        kept = self._goal_independent_reward(batch_indices, env_indices)  # (n,)
        rewards = samples.rewards + self.to_torch(kept.reshape(-1, 1))  # (n, 1)
        return samples._replace(rewards=rewards)

    def _goal_independent_reward(
        self, batch_indices: NDArray[np.int64], env_indices: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """Return r - R(ag', g) of stored transitions, (n,): the penalty with a negative sign."""
        assert self.env is not None  # as in the parent
        achieved = self.next_observations["achieved_goal"][batch_indices, env_indices]  # (n, 3) m
        desired = self.next_observations["desired_goal"][batch_indices, env_indices]  # (n, 3) m
        infos: list[dict[str, Any]] = [{} for _ in range(len(batch_indices))]
        # All environments are identical, so one computes the rewards, as in the parent.
        task = self.env.env_method("compute_reward", achieved, desired, infos, indices=[0])[0]
        stored = self.rewards[batch_indices, env_indices]  # (n,)
        return np.asarray(stored - task, dtype=np.float32)
