"""Success of policies, good and weak, in every engine with every drive."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tpm_gym.learning.environments import make_env
from tpm_gym.learning.policies import load_policy
from tpm_gym.learning.rollout import (
    TEST_SEED,
    Action,
    GoalEnv,
    Observation,
    Policy,
    run_episodes,
    summarise,
)

IDS = ("TPMPickAndPlace-v0", "TPMPickAndPlaceJoints-v0")
DRIVES = ("ideal", "servo")
NOISY = "noisy expert"
NOISE = 0.5
"""Standard deviation of what is added to the noisy expert's actions: it drops, throws, shoves."""


@dataclass(frozen=True)
class Cell:
    """One policy in one engine with one drive."""

    env_id: str
    policy: str
    engine: str
    drive: str
    episodes: int


@dataclass
class NoisyExpert:
    """The scripted expert with a trembling hand."""

    expert: Policy
    rng: np.random.Generator = field(default_factory=np.random.default_rng)

    def reset(self, observation: Observation, seed: int) -> None:
        """Plan, and seed the tremble with the episode's seed."""
        self.rng = np.random.default_rng(seed)
        self.expert.reset(observation, seed)

    def act(self, observation: Observation) -> Action:
        """What the expert does, and normal noise."""
        action = self.expert.act(observation)
        noise = self.rng.normal(0.0, NOISE, action.shape)
        return np.clip(action + noise, -1.0, 1.0).astype(np.float32)


def cells(engines: Iterable[str], episodes: int, weak: dict[str, str]) -> Iterator[Cell]:
    """All combinations; ``weak`` names a policy that was stopped early for each id."""
    for env_id in IDS:
        for policy in ("expert", NOISY, env_id, weak[env_id]):
            for engine in engines:
                for drive in DRIVES:
                    yield Cell(env_id, policy, engine, drive, episodes)


def run_all(todo: list[Cell], jobs: int) -> Iterator[dict[str, Any]]:
    """Evaluate cells in so many processes, and give their records in order."""
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(run, todo)


def run(cell: Cell) -> dict[str, Any]:
    """Evaluate one cell on the seeds that ``tpm-gym evaluate`` takes."""
    start = time.perf_counter()
    with closing(make_env(cell.env_id, engine=cell.engine, drive=cell.drive)) as env:
        episodes = run_episodes(env, _policy(cell.policy, env), cell.episodes, TEST_SEED)
    metrics = summarise(episodes)
    return {
        **vars(cell),
        "metrics": {name: estimate.as_dict() for name, estimate in metrics.items()},
        "successes": [episode.success_at_end for episode in episodes],
        "seconds": time.perf_counter() - start,
    }


def _policy(name: str, env: GoalEnv) -> Policy:
    if name == NOISY:
        return NoisyExpert(load_policy("expert", env))
    return load_policy(name, env)
