"""Success of policies, with and without noise, in each engine with each drive."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from itertools import product
from typing import Any

from tpm_gym.learning.environments import make_envs
from tpm_gym.learning.policies import NoisyPolicy, load_policy
from tpm_gym.learning.rollout import TEST_SEED, run_episodes, summarise

IDS = ("TPMPickAndPlace-v0", "TPMPickAndPlaceJoints-v0")
DRIVES = ("ideal", "servo")
NOISE = 0.3
"""Standard deviation of the noise on actions, which makes policies drop, throw and shove."""


@dataclass(frozen=True)
class Cell:
    """Policy with noise on its actions, in an engine with a drive."""

    env_id: str
    policy: str
    noise: float
    engine: str
    drive: str
    episodes: int


def cells(engines: Iterable[str], episodes: int) -> list[Cell]:
    """Return all combinations of expert and published policy, with and without noise."""
    policies = [(env_id, name) for env_id in IDS for name in ("expert", env_id)]
    return [
        Cell(env_id, policy, noise, engine, drive, episodes)
        for (env_id, policy), noise, engine, drive in product(
            policies, (0.0, NOISE), engines, DRIVES
        )
    ]


def run_all(todo: list[Cell], jobs: int) -> Iterator[dict[str, Any]]:
    """Evaluate cells in ``jobs`` processes; yield their records in order."""
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(run, todo)


def run(cell: Cell) -> dict[str, Any]:
    """Evaluate one cell on the seeds of ``tpm-gym evaluate``."""
    start = time.perf_counter()
    with closing(make_envs(cell.env_id, 1, engine=cell.engine, drive=cell.drive)) as envs:
        policy = load_policy(cell.policy, envs)
        noisy = NoisyPolicy(policy, cell.noise) if cell.noise else policy
        episodes = run_episodes(envs, noisy, cell.episodes, TEST_SEED)
    metrics = summarise(episodes)
    return {
        **vars(cell),
        "metrics": {name: estimate.as_dict() for name, estimate in metrics.items()},
        "seconds": time.perf_counter() - start,
    }
