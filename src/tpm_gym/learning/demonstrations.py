"""Episodes of the scripted expert in the replay buffer, before training starts.

With demonstrations in the replay buffer, pick-and-place learns from a sparse reward within minutes
(Nair et al. 2018). They are stored as whole episodes, so that hindsight can relabel them, and count
as environment steps, so that no learning curve hides them.
"""

from typing import Any, Final, cast

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from tpm_gym.envs.vector import TPMVectorEnv
from tpm_gym.learning.environments import make_envs
from tpm_gym.tasks.expert import Expert

_OTHER: Final = ("num_envs", "vectorization_mode", "autoreset_mode", "stagger", "render_mode")


class Demonstrations(BaseCallback):
    """Callback that fills the replay buffer with the expert's episodes when training starts.

    Every second episode has normally distributed noise on the motion, so that the policy learns in
    states that the expert never reaches by itself; some of these episodes fail.

    ``successes`` is the share of the episodes that ended in success, NaN before they are played.
    """

    def __init__(self, episodes: int, noise: float = 0.3, verbose: int = 0) -> None:
        """Set the number of episodes and the noise.

        Args:
            episodes: Rounded up to a multiple of the number of environments.
            noise: Standard deviation, in units of the largest action.
        """
        super().__init__(verbose)
        self.episodes, self.noise = episodes, noise
        self.successes = float("nan")

    def _on_training_start(self) -> None:
        model = self.model
        if not isinstance(model, OffPolicyAlgorithm) or model.replay_buffer is None:
            raise TypeError(f"{type(model).__name__} has no replay buffer to put episodes in")
        if model.num_timesteps > 0:
            return  # a resumed run has them already
        count, spec = self.training_env.num_envs, self.training_env.get_attr("spec")[0]
        options = {name: own for name, own in spec.kwargs.items() if name not in _OTHER}
        envs = make_envs(spec.id, count, autoreset_mode=AutoresetMode.DISABLED, **options)
        rng = np.random.default_rng(model.seed)
        outcomes: list[bool] = []
        for episode in range(0, self.episodes, count):
            noise = self.noise * (np.arange(episode, episode + count) % 2)
            outcomes += self._play(model, envs, noise, rng)
        envs.close()
        self.successes = float(np.mean(outcomes))
        self.logger.record("demonstrations/success_rate", self.successes)

    def _play(
        self,
        model: OffPolicyAlgorithm,
        envs: TPMVectorEnv,
        noise: NDArray[Any],
        rng: np.random.Generator,
    ) -> list[bool]:
        """Play an episode of equal length in each environment; return whether each succeeded."""
        expert, count, buffer = Expert(envs), envs.num_envs, cast(Any, model.replay_buffer)
        seen, _ = envs.reset(seed=rng.integers(1_000_000, size=count).tolist())
        while True:
            actions = expert.act(seen)
            actions[:, :3] += noise[:, None] * rng.normal(size=(count, 3))
            actions = np.clip(actions, -1, 1).astype(np.float32)
            after, rewards, _, ended, told = envs.step(actions)
            infos = [
                {"reward_terms": {k: v[row] for k, v in told["reward_terms"].items()}}
                | {"TimeLimit.truncated": bool(ended[row])}
                for row in range(count)
            ]
            buffer.add(seen, after, actions, rewards, ended, infos)
            model.num_timesteps += count
            seen = after
            if ended.all():
                return [bool(success) for success in told["is_success"]]

    def _on_step(self) -> bool:
        return True
