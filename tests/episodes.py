"""Episodes to compare to the last bit."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np

from tpm_gym.expert import Expert

Step = tuple[dict[str, Any], float, dict[str, Any]]
"""Observation, reward and info."""

EVERYTHING: dict[str, Any] = {
    "link_mass": (0.8, 1.25),
    "puck_mass": (0.5, 2.0),
    "friction": (0.5, 1.5),
    "motor_strength": (0.9, 1.1),
    "encoder_noise": 1e-4,
    "encoder_bias": 2e-4,
    "latency": 1,
    "length_error": 2e-4,
}
"""Every randomisation at once, as a configuration file would say it."""


def random_episode(env: gym.Env[Any, Any], seed: int, steps: int = 50) -> Iterator[Step]:
    """Whole excursions, not jitter; the actions come from the seed too."""
    rng = np.random.default_rng(seed)
    observation, info = env.reset(seed=seed)
    yield observation, 0.0, info
    for _ in range(steps):
        action = rng.choice([-1.0, 0.0, 1.0], env.action_space.shape)
        observation, reward, _, _, info = env.step(action.astype(np.float32))
        yield observation, float(reward), info


def expert_episode(env: gym.Env[Any, Any], seed: int, steps: int = 50) -> Iterator[Step]:
    """The scripted controller's: it touches, holds and lets go."""
    observation, info = env.reset(seed=seed)
    expert = Expert(env)
    expert.reset(observation)
    yield observation, 0.0, info
    for _ in range(steps):
        observation, reward, _, _, info = env.step(expert.act(observation))
        yield observation, float(reward), info


def fingerprint(steps: Iterable[Step]) -> str:
    """A hash of every bit of an episode."""
    digest = hashlib.sha256()
    for observation, reward, info in steps:
        for array in observation.values():
            digest.update(array.tobytes())
        digest.update(repr((reward, info)).encode())
    return digest.hexdigest()
