"""Episodes of a policy at several moments of its training, for datasets of kind ``replay``.

The policy acts as in training, with its exploration. The moments are spread evenly over the
training; if the training begins with demonstrations, over the steps after them. The episodes have
seeds of their own and do not affect the training.
"""

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Final

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from tpm_gym.envs.vector import TPMVectorEnv
from tpm_gym.learning.configuration import TrainingConfig
from tpm_gym.learning.demonstrations import Demonstrations
from tpm_gym.learning.environments import make_envs
from tpm_gym.learning.policies import TrainedPolicy
from tpm_gym.learning.rollout import Policy
from tpm_gym.learning.training import make_model, training_envs_of

MOMENTS: Final = 10

Record = Callable[[TPMVectorEnv, Policy, int, int], Iterator[Any]]


@dataclass(eq=False)
class _Moments(BaseCallback):
    """Callback that calls ``use`` with the model at each moment, from the start to the end."""

    steps: int
    use: Callable[[BaseAlgorithm, int], object]

    def __post_init__(self) -> None:
        super().__init__()
        self._reached = 0

    def _on_training_start(self) -> None:
        self._first = self.num_timesteps  # after the demonstrations

    def _on_rollout_start(self) -> None:
        done = (self.num_timesteps - self._first) / (self.steps - self._first)
        self._use_until(1 + int(done * (MOMENTS - 1)))

    def _on_training_end(self) -> None:
        self._use_until(MOMENTS)

    def _use_until(self, moment: int) -> None:
        for index in range(self._reached, moment):
            self.use(self.model, index)
        self._reached = moment

    def _on_step(self) -> bool:
        return True


def episodes(config: TrainingConfig, count: int, record: Record) -> list[Any]:
    """Train a policy, play episodes with it at several moments of the training, and return them.

    Args:
        config: Complete configuration of the training. Its seed is also that of the first episode.
        count: Number of episodes, spread evenly over the moments.
        record: Function that plays the episodes of a moment. Its arguments are environments,
            policy, number of episodes and first seed.
    """
    options, seed = config.env_options, config.seed
    torch.set_num_threads(config.threads)
    found: list[Any] = []
    parts = [count * moment // MOMENTS for moment in range(MOMENTS + 1)]
    most = -(-count // MOMENTS) if options.in_batches else 1
    with (
        training_envs_of(config) as training_envs,
        closing(make_envs(config.env, most, **options.given())) as envs,
    ):

        def use(model: BaseAlgorithm, moment: int) -> None:
            first, end = parts[moment : moment + 2]
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(seed + first)
                policy = TrainedPolicy(model, deterministic=False)
                found.extend(record(envs, policy, end - first, seed + first))

        model = make_model(config, training_envs)
        called: list[BaseCallback] = [_Moments(config.steps, use)]
        if config.recipe.demonstrations:
            called.insert(0, Demonstrations(**config.recipe.demonstrations))
        model.learn(config.steps, callback=called)
    return found
