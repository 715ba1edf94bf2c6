"""Episodes of the scripted expert in the replay buffer, before training starts.

A sparse reward teaches a policy nothing until it has picked up the object by chance, which takes
very long. With demonstrations in the replay buffer it learns within minutes (Nair et al. 2018).
They are stored as whole episodes, so that hindsight can relabel them. They count as environment
steps, so that no learning curve hides them.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from tpm_gym.learning.environments import make_env
from tpm_gym.learning.rollout import GoalEnv, Observation
from tpm_gym.tasks.expert import Expert

_OF_VECTORS: Final = ("num_envs", "vectorization_mode", "autoreset_mode", "stagger")


class Demonstrations(BaseCallback):
    """Callback that fills the replay buffer with the expert's episodes when training starts.

    Every second episode has normally distributed noise on the motion, so that the policy learns in
    states that the expert never reaches by itself. The expert does not plan again after the noise,
    so some of these episodes fail.

    Attributes:
        successes: Share of the episodes that ended in success; NaN before they are played.
    """

    def __init__(self, episodes: int, noise: float = 0.3, verbose: int = 0) -> None:
        """Set the number of episodes and the noise.

        Args:
            episodes: Number of episodes, rounded up to a multiple of the number of environments.
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
        specs = self.training_env.get_attr("spec")
        envs = [make_env(spec.id, **_of_one(spec)) for spec in specs]
        rng = np.random.default_rng(model.seed)
        outcomes: list[bool] = []
        for episode in range(0, self.episodes, len(envs)):
            noisy = self.noise * (np.arange(episode, episode + len(envs)) % 2)
            outcomes += self._play(model, envs, noisy, rng)
        for env in envs:
            env.close()
        self.successes = float(np.mean(outcomes))
        self.logger.record("demonstrations/success_rate", self.successes)

    def _play(
        self,
        model: OffPolicyAlgorithm,
        envs: Sequence[GoalEnv],
        noise: NDArray[Any],
        rng: np.random.Generator,
    ) -> list[bool]:
        """Play an episode of equal length in each environment; return whether each succeeded."""
        experts = [Expert(env) for env in envs]
        seen = [env.reset(seed=int(rng.integers(1_000_000)))[0] for env in envs]
        for expert, observation in zip(experts, seen, strict=True):
            expert.reset(observation)
        while True:
            actions = np.array([e.act(o) for e, o in zip(experts, seen, strict=True)])
            actions[:, :3] += noise[:, None] * rng.normal(size=(len(envs), 3))
            actions = np.clip(actions, -1, 1).astype(np.float32)
            steps = [env.step(action) for env, action in zip(envs, actions, strict=True)]
            after = [step[0] for step in steps]
            ended = np.array([step[2] or step[3] for step in steps])
            infos = [{**step[4], "TimeLimit.truncated": step[3]} for step in steps]
            assert model.replay_buffer is not None
            model.replay_buffer.add(
                _stack(seen),  # type: ignore[arg-type]  # a dict, as HER's buffer wants it
                _stack(after),  # type: ignore[arg-type]
                actions,
                np.array([step[1] for step in steps]),
                ended,
                infos,
            )
            model.num_timesteps += len(envs)
            seen = after
            if ended.all():
                return [bool(step[4]["is_success"]) for step in steps]

    def _on_step(self) -> bool:
        return True


def _of_one(spec: EnvSpec) -> dict[str, Any]:
    """Return the arguments of a single environment, without those of a vector."""
    return {name: value for name, value in spec.kwargs.items() if name not in _OF_VECTORS}


def _stack(observations: Sequence[Observation]) -> Observation:
    """Stack the observations of several environments along a new first axis."""
    names = observations[0]
    return {name: np.stack([seen[name] for seen in observations]) for name in names}
