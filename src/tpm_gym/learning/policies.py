"""Policies by name: the scripted expert, uniform random actions, or an exported policy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

import tpm_gym
from tpm_gym import TPMError
from tpm_gym.learning.environments import USUAL, conditions_set_by, set_by
from tpm_gym.learning.errors import PolicyError
from tpm_gym.learning.rollout import Action, Observation, Policy
from tpm_gym.resources import POLICIES
from tpm_gym.tasks.expert import Expert

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

    from tpm_gym.envs.vector import TPMVectorEnv
    from tpm_gym.policy import Policy as ExportedPolicy

SCRIPTED: Final = ("expert", "random")
_ACTIONS: Final = 1  # not 0: NumPy pads seeds with zeros, so [seed, 0] equals seed


@dataclass(frozen=True)
class TrainedPolicy:
    """Policy of a trained algorithm.

    If ``deterministic`` is True, the policy returns its mean action. Otherwise, it samples the
    action, as in training. An exported policy has to be deterministic.
    """

    model: BaseAlgorithm | ExportedPolicy
    deterministic: bool = True

    def reset(self, observation: Observation, seeds: Sequence[int]) -> None:
        """Do nothing: the policy has no memory."""

    def act(self, observation: Observation) -> Action:
        """Return the actions for ``observation``."""
        action, _ = self.model.predict(observation, deterministic=self.deterministic)
        return action


@dataclass
class RandomPolicy:
    """Policy that draws uniform actions, with a generator of its own for each episode."""

    space: Any
    rngs: list[np.random.Generator] = field(default_factory=list)

    def reset(self, observation: Observation, seeds: Sequence[int]) -> None:
        """Seed a generator for each episode with the episode's seed and a constant.

        The environment draws its goal from a generator that is seeded with the episode's seed only.
        Without the constant, actions and goal would come from the same random numbers.
        """
        self.rngs = [np.random.default_rng([seed, _ACTIONS]) for seed in seeds]

    def act(self, observation: Observation) -> Action:
        """Return actions that do not depend on ``observation``."""
        drawn = np.array([rng.uniform(self.space.low, self.space.high) for rng in self.rngs])
        return drawn.astype(self.space.dtype)


class ExpertPolicy(Expert):
    """Policy of the expert, which is deterministic."""

    def reset(self, observation: Observation, seeds: Sequence[int] = ()) -> None:
        """Plan the motion of the episodes."""
        super().reset(observation)


@dataclass
class NoisyPolicy:
    """Policy with normal noise on its actions, with a generator of its own for each episode."""

    policy: Policy
    noise: float
    """Standard deviation, in units of the largest action."""
    rngs: list[np.random.Generator] = field(default_factory=list)

    def reset(self, observation: Observation, seeds: Sequence[int]) -> None:
        """Reset the policy; seed a generator for each episode as :class:`RandomPolicy` does."""
        self.rngs = [np.random.default_rng([seed, _ACTIONS]) for seed in seeds]
        self.policy.reset(observation, seeds)

    def act(self, observation: Observation) -> Action:
        """Return the actions of the policy, with noise."""
        actions = self.policy.act(observation)
        size = actions.shape[-1]
        noise = np.array([rng.normal(0.0, self.noise, size) for rng in self.rngs])
        noisy: Action = np.clip(actions + noise.reshape(actions.shape), -1.0, 1.0)
        return noisy.astype(np.float32)


def load_policy(spec: str, envs: TPMVectorEnv) -> Policy:
    """Return a policy that acts in ``envs``.

    Args:
        spec: ``expert``, ``random``, an exported policy (either of its files, or their common
            name), the id of a published policy, or the folder of a run (its best policy).

    Raises:
        PolicyError: There is no such policy, its files are damaged, or it does not fit ``envs``.
    """
    if spec == "random":
        return RandomPolicy(envs.single_action_space)
    if spec == "expert":
        return ExpertPolicy(envs)
    policy = _exported(spec)
    try:
        policy.check(envs)
    except TPMError as error:
        raise refused(spec, str(error)) from error
    return TrainedPolicy(policy)


def trained_in(spec: str) -> tuple[str, dict[str, Any]] | None:
    """Return the environment id and the options of a policy's training.

    The options are machine, engine, drive and shield. If the policy's file lacks an option, the
    default of the environment id is returned; if the id is not registered, the option is left out.
    The result is None for ``expert`` and ``random``, which are not trained.
    """
    if spec in SCRIPTED:
        return None
    about = _exported(spec).description
    registered = set_by(about.env_id) is not None
    found = {**USUAL, **conditions_set_by(about.env_id)} if registered else {}
    return about.env_id, found | {str(name): value for name, value in about.env_options.items()}


def refused(spec: str, problem: str) -> PolicyError:
    """Return an error about a policy."""
    return PolicyError(f"policy {spec!r}: {problem}")


def exported_in(run: Path) -> list[Path]:
    """Return the files that may hold the policy of a run, the best policy first."""
    return [run / "best.json", run / "last.json"]


def _exported(spec: str) -> ExportedPolicy:
    path = Path(spec)
    if path.is_dir():
        candidates = exported_in(path)
    elif path.suffix in (".zip", ".json", ".safetensors"):
        candidates = [path]
    else:
        candidates = [Path(f"{spec}.json"), Path(f"{spec}.safetensors"), POLICIES / f"{spec}.json"]
    found = next(filter(Path.is_file, candidates), None)
    if found is None:
        there = f"no file {' or '.join(map(str, candidates))}"
        valid = "an exported policy (.json), the id of a published one, or the folder of a run"
        raise refused(spec, f"{there}; expected {', '.join(SCRIPTED)}, {valid}")
    try:
        return tpm_gym.load_policy(found)
    except TPMError as error:
        raise refused(spec, str(error)) from error
