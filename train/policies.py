"""Policies by name: the scripted expert, uniform random actions, or a file that train.py saved."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol, cast

import gymnasium as gym
import numpy as np

from errors import PolicyError
from rollout import Action, GoalEnv, Observation, Policy

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

CONFIG_FILE: Final = "config.json"
BEST_FILE: Final = "best.zip"
LAST_FILE: Final = "last.zip"
ALGORITHMS: Final = ("sac", "tqc", "ppo")
SCRIPTED: Final = ("expert", "random")


class Predictor(Protocol):
    """The part of a Stable-Baselines3 algorithm that acts."""

    def predict(self, observation: Any, *, deterministic: bool = False) -> tuple[Any, Any]:
        """Return the action, and the state of a recurrent policy."""


class _Expert(Protocol):
    """The part of ``tpm_gym.expert.Expert`` that acts."""

    def reset(self, obs: Observation) -> None: ...

    def act(self, obs: Observation) -> Action: ...


@dataclass(frozen=True)
class TrainedPolicy:
    """Acts with the mean action of a trained algorithm.

    Attributes:
        model: The Stable-Baselines3 algorithm.
    """

    model: Predictor

    def reset(self, observation: Observation, seed: int) -> None:
        """Do nothing: the policy has no memory."""

    def act(self, observation: Observation) -> Action:
        """Return the deterministic action for ``observation``."""
        action, _ = self.model.predict(observation, deterministic=True)
        return cast(Action, action)


class RandomPolicy:
    """Draws actions uniformly, from a generator seeded anew in every episode.

    Args:
        space: The action space.
    """

    def __init__(self, space: gym.spaces.Box) -> None:
        """Remember the space; the generator is seeded by ``reset``."""
        self._space = space
        self._rng = np.random.default_rng()

    def reset(self, observation: Observation, seed: int) -> None:
        """Seed the generator with the seed of the episode."""
        self._rng = np.random.default_rng(seed)

    def act(self, observation: Observation) -> Action:
        """Return an action that does not depend on ``observation``."""
        return self._rng.uniform(self._space.low, self._space.high).astype(self._space.dtype)


@dataclass(frozen=True)
class ExpertPolicy:
    """Acts with the scripted controller of tpm_gym.

    Attributes:
        expert: The controller.
    """

    expert: _Expert

    def reset(self, observation: Observation, seed: int) -> None:
        """Plan the motion of the episode; the controller is deterministic."""
        self.expert.reset(observation)

    def act(self, observation: Observation) -> Action:
        """Return the action of the controller."""
        return self.expert.act(observation)


def load_policy(spec: str, env: GoalEnv) -> Policy:
    """Return the policy that ``spec`` names.

    Only load files you trust: a saved policy is a pickle, and loading it can run code.

    Args:
        spec: ``expert``, ``random``, a .zip file saved by train.py, or the folder of a run (its
            best policy).
        env: The environment the policy will act in.

    Raises:
        PolicyError: There is no such policy, or it does not fit ``env``.
    """
    if spec == "random":
        if not isinstance(env.action_space, gym.spaces.Box):
            raise PolicyError(spec, f"needs a Box action space, not {env.action_space}")
        return RandomPolicy(env.action_space)
    if spec == "expert":
        from tpm_gym.expert import Expert

        return ExpertPolicy(Expert(env))
    path = _policy_file(spec)
    model = _load_model(spec, path)
    _check_spaces(spec, model, env)
    return TrainedPolicy(model)


def trained_env(spec: str) -> str | None:
    """Return the id of the environment a policy was trained on, None for a scripted one.

    Raises:
        PolicyError: There is no such policy, or its run folder does not say.
    """
    if spec in SCRIPTED:
        return None
    return _from_config(spec, _policy_file(spec), "env")


def _policy_file(spec: str) -> Path:
    """Return the .zip file that ``spec`` names."""
    path = Path(spec)
    candidates = [path / BEST_FILE, path / LAST_FILE] if path.is_dir() else [path]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    looked_for = " or ".join(str(candidate) for candidate in candidates)
    raise PolicyError(
        spec,
        f"no file {looked_for}; expected {', '.join(SCRIPTED)}, a .zip saved by train.py, or the "
        "folder of a run",
    )


def _from_config(spec: str, path: Path, key: str) -> str:
    """Return an entry of the run's configuration, from beside or above the policy file."""
    folders = path.resolve().parents[:2]  # the run folder, or checkpoints/ inside it
    for folder in folders:
        file = folder / CONFIG_FILE
        if file.is_file():
            try:
                return str(json.loads(file.read_text(encoding="utf-8"))[key])
            except (ValueError, KeyError, TypeError) as error:
                raise PolicyError(spec, f"{file} is damaged: no entry {key!r}") from error
    raise PolicyError(
        spec, f"no {CONFIG_FILE} beside {path.name} or above it; keep the file in its run folder"
    )


def _load_model(spec: str, path: Path) -> BaseAlgorithm:
    """Load a saved algorithm for acting only."""
    algorithm = _from_config(spec, path, "algo")
    if algorithm not in ALGORITHMS:
        raise PolicyError(spec, f"algorithm {algorithm!r} is none of {', '.join(ALGORITHMS)}")
    import torch  # Imported here so that scripted policies do not pay for it.

    # These networks are too small to share among threads, and one thread repeats exactly.
    torch.set_num_threads(1)
    # Acting stores nothing: no room is needed, nor a hindsight buffer, which would ask for an
    # environment.
    unused: dict[str, Any] = {
        "replay_buffer_class": None,
        "replay_buffer_kwargs": {},
        "buffer_size": 1,
    }
    try:
        return algorithm_class(algorithm).load(path, device="cpu", custom_objects=unused)
    except Exception as error:  # A damaged archive or pickle can raise anything at all.
        raise PolicyError(spec, f"cannot be loaded as {algorithm}: {error}") from error


def algorithm_class(name: str) -> type[BaseAlgorithm]:
    """Return the Stable-Baselines3 class of an algorithm in ``ALGORITHMS``."""
    if name == "tqc":
        from sb3_contrib import TQC

        return TQC
    from stable_baselines3 import PPO, SAC

    return SAC if name == "sac" else PPO


def _check_spaces(spec: str, model: BaseAlgorithm, env: GoalEnv) -> None:
    """Refuse a policy that was trained with other observations or actions."""
    pairs = {
        "observation": (model.observation_space, env.observation_space),
        "action": (model.action_space, env.action_space),
    }
    for kind, (trained, given) in pairs.items():
        if trained != given:
            raise PolicyError(
                spec, f"was trained with {kind} space {trained}, the environment has {given}"
            )
