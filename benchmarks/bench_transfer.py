"""Test policies of one engine in all engines and with all drives.

    make bench-transfer
    python benchmarks/bench_transfer.py --runs runs/own --train 0 --jobs 2

``--train N`` first trains each of ``TRAININGS`` with N seeds, except the runs that are there. The
best policy of each run in ``--runs`` and the published policies are tested in each engine, with
ideal and servo drives. Policies of few steps drop the block, and those of Push strike it, so that
errors of contact would show.

With ``--write``, results go to docs/records/transfer.json, and from there to docs/transfer.md.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
from engine_matrix import DRIVES
from shared import ROOT, describe, make_parser, publish, table
from studies.plan import Run

from tpm_gym.learning.environments import make_envs
from tpm_gym.learning.estimates import wilson
from tpm_gym.learning.policies import load_policy
from tpm_gym.learning.rollout import TEST_SEED, run_episodes

RECORD = ROOT / "docs" / "records" / "transfer.json"
PAGE = ROOT / "docs" / "transfer.md"
ENGINES = ("analytic", "pybullet", "mujoco")
PUBLISHED = ("TPMPickAndPlace-v0", "TPMPickAndPlaceJoints-v0")
TRAININGS: Final = (
    ("TPMReachDense-v0", "pybullet", "ideal", None),
    ("TPMReachDense-v0", "analytic", "ideal", None),
    ("TPMPickAndPlaceDense-v0", "analytic", "ideal", None),
    ("TPMPickAndPlaceDense-v0", "analytic", "ideal", 200_000),
    ("TPMPickAndPlaceDense-v0", "analytic", "servo", None),
    ("TPMPickAndPlaceJointsDense-v0", "analytic", "ideal", None),
    ("TPMPickAndPlaceJointsDense-v0", "analytic", "ideal", 300_000),
    ("TPMPickAndPlaceJointsDense-v0", "analytic", "servo", None),
    ("TPMConveyorDense-v0", "analytic", "ideal", None),
    ("TPMPushDense-v0", "analytic", "ideal", None),
)
"""Id, engine, drive and steps of trainings with PPO; None for the steps of the recipe."""


@dataclass(frozen=True)
class Cell:
    """Policy in an engine with a drive.

    Attributes:
        kind: Training of the policy; policies of one kind share a row.
    """

    kind: str
    env_id: str
    policy: str
    engine: str
    drive: str
    episodes: int


def commands(runs: Path, seeds: int) -> Iterator[list[str]]:
    """Yield the commands of the trainings that are left."""
    for (env_id, engine, drive, steps), seed in product(TRAININGS, range(seeds)):
        options = ["--engine", engine, "--drive", drive, "--seed", str(seed)]
        options += ["--test-episodes", "0", *(["--steps", str(steps)] if steps else [])]
        folder = runs / f"{env_id}-{engine}-{drive}-{steps or 'all'}-s{seed}"
        for _, *words in Run(folder, env_id, "ppo", tuple(options), ()).left():
            yield [sys.executable, "-m", "tpm_gym.learning", *words]


def train_all(runs: Path, seeds: int, jobs: int) -> None:
    """Train what is left, several runs at a time."""
    with ThreadPoolExecutor(jobs) as pool:
        run_quietly = partial(subprocess.run, check=True, stdout=subprocess.DEVNULL)
        for done in pool.map(run_quietly, commands(runs, seeds)):
            print(*done.args[4:], file=sys.stderr)


def cells(runs: Path, episodes: int, drives: Sequence[str]) -> Iterator[Cell]:
    """Yield each policy in each engine with each drive."""
    policies = [(_kind(config), config["env"], str(folder)) for folder, config in _trained(runs)]
    policies += [(f"{env_id}: published", env_id, env_id) for env_id in PUBLISHED]
    for kind, env_id, policy in policies:
        for engine in ENGINES:
            for drive in drives:
                yield Cell(kind, env_id, policy, engine, drive, episodes)


def _trained(runs: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield the folders of runs, with their configurations."""
    for file in sorted(runs.glob("*/config.json")):
        yield file.parent, json.loads(file.read_text(encoding="utf-8"))


def _kind(config: dict[str, Any]) -> str:
    asked = config["env_options"]
    engine, drive = asked.get("engine", "pybullet"), asked.get("drive", "ideal")
    env_id = config["env"].rpartition(":")[-1]
    return f"{env_id}: {config['algo'].upper()}, {engine}, {drive}, {config['steps']:,} steps"


def run(cell: Cell) -> dict[str, Any]:
    """Evaluate one cell on the seeds of ``tpm-gym evaluate``."""
    options = {"engine": cell.engine, "drive": cell.drive}
    count = cell.episodes if cell.engine == "analytic" else 1
    with closing(make_envs(cell.env_id, count, **options)) as envs:
        found = run_episodes(envs, load_policy(cell.policy, envs), cell.episodes, TEST_SEED)
    marks = "".join("01"[episode.success_at_end] for episode in found)
    return {**vars(cell), "successes": marks}


def lines(record: dict[str, Any]) -> Iterator[str]:
    """Yield the table in Markdown: one row for policies of a kind, median and range over seeds."""
    command = record["machine"]["command"]
    yield f"`{command}`, {record['episodes']} episodes for each policy in each cell."
    yield ""
    columns = list(dict.fromkeys((cell["engine"], cell["drive"]) for cell in record["cells"]))
    kinds = list(dict.fromkeys(cell["kind"] for cell in record["cells"]))
    yield from table(
        ["trained", "policies", *(f"{engine}, {drive}" for engine, drive in columns)],
        [[kind, *_row(kind, columns, record["cells"])] for kind in kinds],
    )


def _row(kind: str, columns: list[tuple[str, str]], found: list[dict[str, Any]]) -> Iterator[str]:
    own = [cell for cell in found if cell["kind"] == kind]
    yield str(len({cell["policy"] for cell in own}))
    for engine, drive in columns:
        here = [c for c in own if (c["engine"], c["drive"]) == (engine, drive)]
        rates = [_rate(cell) for cell in here]
        if len(rates) > 1:
            yield f"{np.median(rates):.1f}% ({min(rates):.1f} to {max(rates):.1f})"
        else:
            only = wilson([mark == "1" for mark in here[0]["successes"]])
            yield f"{rates[0]:.1f}% [{100 * only.low:.1f}, {100 * only.high:.1f}]"


def _rate(cell: dict[str, Any]) -> float:
    """Return the success rate, %."""
    marks = cell["successes"]
    return 100 * marks.count("1") / len(marks)


def main() -> None:
    """Parse the options and run."""
    parser = make_parser("Test policies in all engines.")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "transfer")
    parser.add_argument("--train", type=int, default=5, metavar="N", help="seeds to train")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--drives", nargs="+", choices=DRIVES, default=DRIVES)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    train_all(options.runs, options.train, options.jobs)
    todo = list(cells(options.runs, options.episodes, options.drives))
    found = []
    with ProcessPoolExecutor(options.jobs) as pool:
        for cell in pool.map(run, todo):
            print(*(cell[k] for k in ("kind", "engine", "drive")), _rate(cell), file=sys.stderr)
            found.append({**cell, "policy": Path(cell["policy"]).name})
    record = {
        "machine": describe(sys.argv),
        "episodes": options.episodes,
        "cells": found,
    }
    publish(record, RECORD, PAGE, "transfer", lines, write=options.write)


if __name__ == "__main__":
    main()
