"""Episodes of the scripted expert from which an algorithm learns before it acts itself.

For an algorithm with a replay buffer, the episodes are added to the buffer (Nair et al. 2018). With
them, SAC and TQC learn pick-and-place from a sparse reward within minutes. Episodes are stored
whole, so that hindsight can relabel them. For an on-policy algorithm such as PPO, networks are
fitted to the episodes first (behaviour cloning), and training continues from there (Rajeswaran et
al. 2018). In both cases the episodes count as environment steps, so that learning curves include
them.
"""

from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from tpm_gym.learning.cloning import clone
from tpm_gym.learning.environments import make_envs
from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.rollout import Action, Observation
from tpm_gym.tasks.expert import Expert

_OTHER: Final = ("num_envs", "vectorization_mode", "autoreset_mode", "stagger", "render_mode")


class _Step(NamedTuple):
    """Control step of n environments.

    ``wanted`` are the expert's actions. ``actions``, which the environments execute, are the
    expert's actions plus noise.
    """

    seen: Observation
    wanted: Action
    actions: Action
    after: Observation
    rewards: NDArray[Any]
    ended: NDArray[Any]
    told: dict[str, Any]


class Demonstrations(BaseCallback):
    """Callback that plays the expert's episodes and trains on them when training starts.

    Every second episode has normally distributed noise on the motion, so that the policy learns in
    states that the expert never reaches by itself; some of these episodes fail. A replay buffer
    records the actions with their noise. Cloning imitates the expert's action without the noise
    (Laskey et al. 2017).

    ``successes`` is the share of the episodes that ended in success, NaN before they are played.
    """

    def __init__(
        self, episodes: int, noise: float = 0.3, epochs: int = 10, verbose: int = 0
    ) -> None:
        """Set the number of episodes and the noise.

        Args:
            episodes: Number of episodes, rounded up to a multiple of the number of environments.
            noise: Standard deviation of the noise, in units of the largest action.
            epochs: Number of passes over the episodes when an on-policy algorithm is fitted to
                them.
        """
        super().__init__(verbose)
        self.episodes, self.noise, self.epochs = episodes, noise, epochs
        self.successes = float("nan")

    def _on_training_start(self) -> None:
        model = self.model
        if model.num_timesteps > 0:
            return  # a resumed run has already used the episodes
        if isinstance(model, OnPolicyAlgorithm):
            self._clone(model)
        elif isinstance(model, OffPolicyAlgorithm) and model.replay_buffer is not None:
            self._record(model.replay_buffer)
        else:
            raise TypeError(f"{type(model).__name__} cannot learn from demonstrations")
        self.logger.record("demonstrations/success_rate", self.successes)

    def _record(self, buffer: Any) -> None:
        """Add the steps to a replay buffer."""
        for step in self._play():
            infos = [
                {"reward_terms": {k: v[row] for k, v in step.told["reward_terms"].items()}}
                | {"TimeLimit.truncated": bool(ended)}
                for row, ended in enumerate(step.ended)
            ]
            buffer.add(step.seen, step.after, step.actions, step.rewards, step.ended, infos)

    def _clone(self, model: OnPolicyAlgorithm) -> None:
        """Fit the networks to the steps."""
        normalised = model.get_vec_normalize_env()
        if normalised is not None and normalised.norm_obs:
            # Its statistics change while the policy acts, and the fit would no longer hold.
            problem = "networks cannot be fitted to observations that are not yet normalised"
            raise ConfigError(f"VecNormalize: {problem}; give it norm_obs=False")
        steps = list(self._play())
        seen = {k: np.concatenate([step.seen[k] for step in steps]) for k in steps[0].seen}
        wanted = np.concatenate([step.wanted for step in steps])
        returns = np.concatenate(_returns(steps, model.gamma))
        clone(model, seen, wanted, returns, self.epochs)

    def _play(self) -> Iterator[_Step]:
        """Play all episodes: one in each environment at a time."""
        model = self.model
        count, spec = self.training_env.num_envs, self.training_env.get_attr("spec")[0]
        options = {"max_episode_steps": spec.max_episode_steps, **spec.kwargs}
        options = {name: own for name, own in options.items() if name not in _OTHER}
        envs = make_envs(spec.id, count, autoreset_mode=AutoresetMode.DISABLED, **options)
        expert, rng = Expert(envs), np.random.default_rng(model.seed)
        outcomes: list[bool] = []
        for episode in range(0, self.episodes, count):
            noise = self.noise * (np.arange(episode, episode + count) % 2)
            seen, _ = envs.reset(seed=rng.integers(1_000_000, size=count).tolist())
            left = np.ones(count, dtype=np.bool_)
            while left.any():
                wanted = expert.act(seen)
                actions = wanted.copy()
                actions[:, :3] += noise[:, None] * rng.normal(size=(count, 3))
                actions = np.clip(actions, -1, 1).astype(np.float32)
                after, rewards, _, ended, told = envs.step(actions)
                left &= ~ended
                # Past a singularity an episode ends early. Another takes its place, since a buffer
                # records all environments at once; it ends with the last of the others.
                ended |= not left.any()
                yield _Step(seen, wanted, actions, after, rewards, ended, told)
                model.num_timesteps += count
                outcomes += [bool(success) for success in told["is_success"][ended]]
                seen = after
                if ended.any() and left.any():
                    seen, _ = envs.reset(options={"reset_mask": ended})
        envs.close()
        self.successes = float(np.mean(outcomes))

    def _on_step(self) -> bool:
        return True


def _returns(steps: Sequence[_Step], gamma: float) -> list[NDArray[Any]]:
    """Return, for each step, the discounted sum of the rewards from this step on.

    The sums of a step are an array (n,), one for each of n environments. The last reward of an
    episode is assumed to continue for ever, since only a time limit ends the episode. If gamma is
    1, this sum would be infinite, so the last reward is counted only once.
    """
    found: list[NDArray[Any]] = []
    total: Any = 0.0
    for step in reversed(steps):
        last = step.rewards / (1 - gamma if gamma < 1 else 1)
        total = np.where(step.ended, last, step.rewards + gamma * total)
        found.append(total)
    return found[::-1]
