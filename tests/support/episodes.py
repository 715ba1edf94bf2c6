"""Episodes to compare to the last bit. Fresh processes import this too, so it imports little."""

import pickle
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, nullcontext
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np

from tpm_gym.envs import testing
from tpm_gym.envs.testing import Step, bits, fingerprint, play, random_episode
from tpm_gym.tasks.expert import Expert

__all__ = ["bits", "fingerprint", "play", "random_episode"]  # for those who import them from here

EVERYTHING: dict[str, Any] = {
    "link_mass": (0.8, 1.25),
    "block_mass": (0.5, 2.0),
    "friction": (0.5, 1.5),
    "motor_strength": (0.9, 1.1),
    "encoder_noise": 1e-4,
    "encoder_bias": 2e-4,
    "latency": 1,
    "length_error": 2e-4,
}
"""Every randomisation of any drive at once, as a configuration file would say it."""

OF_SERVOS: dict[str, Any] = {"servo_stiffness": (0.5, 2.0), "joint_friction": (0.0, 0.5)}
"""Those of servo drives."""

CASES: list[tuple[str, dict[str, Any]]] = [
    ("TPMReachJoints-v0", {}),
    ("TPMPickAndPlaceDense-v0", {}),
    ("TPMPickAndPlaceJoints-v0", {"engine": "mujoco"}),
    ("TPMPickAndPlace-v0", {"engine": "analytic", "drive": "servo"}),
    ("TPMPickAndPlace-v0", {"randomisation": EVERYTHING}),
]
"""Ids and options."""


def make(env_id: str, **options: Any) -> gym.Env[Any, Any]:
    """An environment; also where tpm_gym has not been imported yet."""
    return gym.make(f"tpm_gym:{env_id}", **options)


def expert_episode(
    env: gym.Env[Any, Any], seed: int, steps: int = 50, options: dict[str, Any] | None = None
) -> Iterator[Step]:
    """The scripted controller's: it touches, holds and lets go."""
    observation, info = env.reset(seed=seed, options=options)
    expert = Expert(env)
    yield observation, 0.0, info
    for _ in range(steps):
        observation, reward, _, _, info = env.step(expert.act(observation))
        yield observation, float(reward), info


def conforms(make: testing.Make, without: Collection[Callable[..., None]] = ()) -> None:
    """Run all checks but some, on as few environments as possible: making one takes longest."""
    env = make()

    def unless_shared(other: Any) -> Any:
        return nullcontext(env) if other is env else closing(other)

    def lent() -> Iterator[Any]:
        yield env
        while True:
            yield make()

    kept = patch.object(testing, "closing", unless_shared)
    with kept, patch.object(env.unwrapped, "metadata", env.unwrapped.metadata):
        for check in testing.CHECKS:
            if check not in without:
                closes = check is testing.refuses_steps_outside_an_episode
                check(make if closes else partial(next, lent()))
    env.close()


def all_fingerprints() -> list[str]:
    """Of an episode in each case."""
    prints = []
    for env_id, options in CASES:
        env = make(env_id, **options)
        prints.append(fingerprint(expert_episode(env, 6, steps=30)))
        env.close()
    return prints


def continued(path: str) -> str:
    """How a pickled environment goes on."""
    env = pickle.loads(Path(path).read_bytes())
    steps = repr(play(env, [np.full(4, 0.3)] * 10))
    env.close()
    return steps
