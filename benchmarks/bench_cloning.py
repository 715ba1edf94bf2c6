"""Behaviour cloning from datasets of 10, 50 and 400 episodes, over several seeds.

    python benchmarks/bench_cloning.py

``tpm-gym collect`` makes the datasets, Minari loads them. Each seed learns from episodes of its
own, by the same number of updates of :func:`tpm_gym.learning.cloning.clone`. Speeds and the
command are hidden from the networks: the last action can be read from them, and a network that sees
them repeats it. Policies are tested in the analytic engine, in the episodes that
``tpm-gym evaluate`` takes. With ``--write``, results go to docs/records/cloning.json, and from
there to docs/datasets.md.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from gymnasium import spaces
from minari import MinariDataset
from numpy.typing import NDArray
from shared import ROOT, describe, fill, make_parser, publish, read_record, table
from stable_baselines3 import PPO
from studies.reliability import interquartile_mean

from tpm_gym.learning import AnalyticVecEnv, CollectConfig, GoalGapExtractor, collect
from tpm_gym.learning.cloning import clone
from tpm_gym.learning.environments import make_envs
from tpm_gym.learning.estimates import wilson
from tpm_gym.learning.policies import TrainedPolicy
from tpm_gym.learning.provenance import write_json
from tpm_gym.learning.rollout import TEST_SEED, run_episodes
from tpm_gym.tasks import Task

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
HIDDEN: Final = ("velocity", "command", "object_velocity")
"""Entries of the observation that the networks do not see."""


class Places(GoalGapExtractor):
    """Features without the entries of the observation that tell the last action."""

    def __init__(self, observation_space: spaces.Dict, shown: Sequence[bool]) -> None:
        """Set which numbers of the observation are shown."""
        super().__init__(observation_space, unit=0.02)
        self.register_buffer("shown", torch.tensor(shown, dtype=torch.float32))

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the features of a batch."""
        seen = observations["observation"] * self.shown
        return super().forward(observations | {"observation": seen})


def network(task: Task, hidden: Sequence[str]) -> dict[str, Any]:
    """Return the arguments of a policy whose networks do not see the entries ``hidden``."""
    shown = [entry.name not in hidden for entry in task.entries for _ in entry.scale]
    return {
        "net_arch": [128, 128],
        "activation_fn": torch.nn.ReLU,
        "features_extractor_class": Places,
        "features_extractor_kwargs": {"shown": shown},
    }


def steps_of(dataset: MinariDataset, first: int, count: int) -> tuple[dict[str, Any], NDArray[Any]]:
    """Return observations and actions of some episodes, (n, ...)."""
    episodes = list(dataset.iterate_episodes(range(first, first + count)))
    names = episodes[0].observations
    seen = {k: np.concatenate([e.observations[k][:-1] for e in episodes]) for k in names}
    return seen, np.concatenate([e.actions for e in episodes])


def learn(
    dataset: MinariDataset, env_id: str, size: int, seed: int, options: argparse.Namespace
) -> list[bool]:
    """Clone a policy from ``size`` episodes; return the outcomes of its test."""
    seen, actions = steps_of(dataset, seed * max(SIZES), size)
    batches = -(-len(actions) // BATCH)
    made: dict[str, Any] = {"engine": "analytic", "autoreset_mode": "SameStep"}
    envs = make_envs(env_id, 2, **made)
    with closing(AnalyticVecEnv(envs)) as few:
        policy = network(envs.task, options.hide)
        model = PPO("MultiInputPolicy", few, seed=seed, policy_kwargs=policy, device="cpu")
        clone(model, seen, actions, np.zeros(len(actions)), -(-options.updates // batches))
    with closing(make_envs(env_id, EPISODES, engine="analytic")) as envs:
        records = run_episodes(envs, TrainedPolicy(model), EPISODES, TEST_SEED)
    return [record.success_at_end for record in records]


def measure(options: argparse.Namespace, folder: Path) -> Iterator[dict[str, Any]]:
    """Collect the datasets, and yield a row for each id, kind and size."""
    seeds = range(options.seeds)
    for kind, env_id in product(KINDS, options.envs):
        episodes = options.seeds * max(SIZES)
        collect(CollectConfig(env=(env_id,), kind=(kind,), episodes=episodes, out=folder))
        dataset = MinariDataset(folder / env_id / f"{kind}-v0" / "data")
        shown = [bool(episode.infos["is_success"][-1]) for episode in dataset]
        for size in SIZES:
            tests = [learn(dataset, env_id, size, seed, options) for seed in seeds]
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


def _place(row: dict[str, Any]) -> tuple[Any, ...]:
    """Return the place of a row in the table."""
    return row["kind"], row["env"], row["episodes"]


def main() -> None:
    """Measure and publish, or fill the page from the record."""
    parser = make_parser(__doc__.partition("\n")[0])
    parser.add_argument("--updates", type=int, default=UPDATES, help="updates of each training")
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--envs", nargs="+", choices=IDS, default=IDS, help="keep rows of others")
    parser.add_argument("--hide", nargs="*", default=HIDDEN, help="hidden entries; no name: none")
    parser.add_argument("--only-page", action="store_true", help="write the page, measure nothing")
    args = parser.parse_args()
    if args.only_page:
        fill(PAGE, "cloning", lines(read_record(RECORD)))
        return
    torch.set_num_threads(1)
    counts = {"updates": args.updates, "tested": EPISODES, "hidden": list(args.hide)}
    record = {**describe(sys.argv), **counts, "rows": []}
    with tempfile.TemporaryDirectory() as folder:
        old = (args.write and read_record(RECORD)) or {"rows": []}
        rows = {_place(row): row for row in old["rows"] if row["env"] not in args.envs}
        for row in measure(args, Path(folder)):
            rows[_place(row)] = row
            record["rows"] = [rows[place] for place in sorted(rows)]
            if args.write:  # an interrupted run keeps its results
                write_json(RECORD, record)
    publish(record, RECORD, PAGE, "cloning", lines, write=args.write)


if __name__ == "__main__":
    main()
