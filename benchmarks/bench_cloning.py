"""Behaviour cloning from datasets of 10, 50 and 400 episodes, over five seeds.

    python benchmarks/bench_cloning.py

``tpm-gym collect`` makes the datasets, Minari loads them. Each seed learns from episodes of its
own. Networks and optimiser are those that PPO starts from with demonstrations; each training takes
the same number of updates. Policies are tested in the analytic engine, in the episodes that
``tpm-gym evaluate`` takes. Results go to docs/records/cloning.json, and from there to
docs/datasets.md.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from minari import MinariDataset
from numpy.typing import NDArray
from shared import ROOT, describe, fill, read_record, table
from stable_baselines3 import PPO
from studies.reliability import interquartile_mean

from tpm_gym.learning import AnalyticVecEnv, CollectConfig, GoalGapExtractor, collect
from tpm_gym.learning.cloning import clone
from tpm_gym.learning.environments import make_envs
from tpm_gym.learning.estimates import wilson
from tpm_gym.learning.policies import TrainedPolicy
from tpm_gym.learning.provenance import write_json
from tpm_gym.learning.rollout import TEST_SEED, run_episodes

RECORD = ROOT / "docs" / "records" / "cloning.json"
PAGE = ROOT / "docs" / "datasets.md"
IDS: Final = ("TPMPickAndPlace-v0", "TPMPush-v0")
KINDS: Final = ("expert", "noisy")
SIZES: Final = (10, 50, 400)
SEEDS: Final = 5
UPDATES: Final = 2000
BATCH: Final = 256  # of clone()
EPISODES: Final = 200
"""Test episodes of each policy."""
NETWORK: Final[dict[str, Any]] = {
    "net_arch": [128, 128],
    "features_extractor_class": GoalGapExtractor,
    "features_extractor_kwargs": {"unit": 0.02},
}


def steps_of(dataset: MinariDataset, first: int, count: int) -> tuple[dict[str, Any], NDArray[Any]]:
    """Return observations and actions of some episodes, (n, ...)."""
    episodes = list(dataset.iterate_episodes(range(first, first + count)))
    names = episodes[0].observations
    seen = {k: np.concatenate([e.observations[k][:-1] for e in episodes]) for k in names}
    return seen, np.concatenate([e.actions for e in episodes])


def learn(dataset: MinariDataset, env_id: str, size: int, seed: int, updates: int) -> list[bool]:
    """Clone a policy from ``size`` episodes; return the outcomes of its test."""
    seen, actions = steps_of(dataset, seed * max(SIZES), size)
    batches = -(-len(actions) // BATCH)
    options: dict[str, Any] = {"engine": "analytic", "autoreset_mode": "SameStep"}
    with closing(AnalyticVecEnv(make_envs(env_id, 2, **options))) as few:
        model = PPO("MultiInputPolicy", few, seed=seed, policy_kwargs=NETWORK, device="cpu")
        clone(model, seen, actions, np.zeros(len(actions)), -(-updates // batches))
    with closing(make_envs(env_id, EPISODES, engine="analytic")) as envs:
        records = run_episodes(envs, TrainedPolicy(model), EPISODES, TEST_SEED)
    return [record.success_at_end for record in records]


def measure(updates: int, seeds: int, folder: Path) -> Iterator[dict[str, Any]]:
    """Collect the datasets, and yield a row for each id, kind and size."""
    episodes = seeds * max(SIZES)
    collect(CollectConfig(env=IDS, kind=KINDS, episodes=episodes, out=folder))
    for kind, env_id in product(KINDS, IDS):
        dataset = MinariDataset(folder / env_id / f"{kind}-v0" / "data")
        shown = [bool(episode.infos["is_success"][-1]) for episode in dataset]
        for size in SIZES:
            tests = [learn(dataset, env_id, size, seed, updates) for seed in range(seeds)]
            row = {
                **{"env": env_id, "kind": kind, "episodes": size},
                "shown": wilson(shown).as_dict(),
                "seeds": [wilson(outcomes).as_dict() for outcomes in tests],
                "success": interquartile_mean([np.mean(tests, axis=1)]).as_dict(),
            }
            print(env_id, kind, size, row["success"], file=sys.stderr, flush=True)
            yield row


def lines(record: dict[str, Any]) -> Iterator[str]:
    """Yield the table of the page."""
    head = ("id", "dataset", "success of its episodes", "episodes", "success", "each seed")
    rows = []
    for row in record.get("rows", []):
        mean, low, high = (100 * row["success"][name] for name in ("mean", "low", "high"))
        rows.append(
            (
                *(row["env"], row["kind"], f"{row['shown']['mean']:.1%}", str(row["episodes"])),
                f"{mean:.1f}% [{low:.1f}, {high:.1f}]",
                ", ".join(f"{100 * seed['mean']:.1f}" for seed in row["seeds"]),
            )
        )
    yield from table(head, rows)


def main() -> None:
    """Measure, or write the page from the record."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--updates", type=int, default=UPDATES, help="updates of each training")
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--only-page", action="store_true", help="write the page, measure nothing")
    args = parser.parse_args()
    if not args.only_page:
        torch.set_num_threads(1)
        about = describe(sys.argv)
        with tempfile.TemporaryDirectory() as folder:
            rows = []
            for row in measure(args.updates, args.seeds, Path(folder)):
                rows.append(row)
                counts = {"updates": args.updates, "tested": EPISODES}
                write_json(RECORD, {**about, **counts, "rows": rows})
    fill(PAGE, "cloning", lines(read_record(RECORD)))


if __name__ == "__main__":
    main()
