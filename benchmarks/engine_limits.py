"""Success of a policy in each engine, at several time steps, with noise on its actions.

    python benchmarks/engine_limits.py [--policy FILE]

Each engine acts on its own observations. Noise makes the policy drop, throw and shove, so that
success depends on contact. Engines agree if their numbers do, and a time step is short enough if a
shorter one gives the same numbers. With ``--write``, results go to docs/records/limits.json, and
from there to docs/analytic-engine.md.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from itertools import product
from typing import Any, NamedTuple

from shared import ROOT, describe, make_parser, publish, table

from tpm_gym.learning.environments import make_envs
from tpm_gym.learning.estimates import wilson
from tpm_gym.learning.policies import NoisyPolicy, load_policy, trained_in
from tpm_gym.learning.rollout import TEST_SEED, run_episodes

RECORD = ROOT / "docs" / "records" / "limits.json"
PAGE = ROOT / "docs" / "analytic-engine.md"
ENV_ID = "TPMPickAndPlace-v0"
ENGINES = {"pybullet": "PyBullet", "mujoco": "MuJoCo", "analytic": "analytic"}
MILLISECONDS = (4, 1)
NOISES = (0.0, 0.3, 0.8)
"""Standard deviations of the noise, in units of the largest action."""

BATCH = 250
"""Number of episodes that the analytic engine runs at a time."""


class Cell(NamedTuple):
    """Noise, engine and time step of one test."""

    noise: float
    engine: str
    milliseconds: float
    episodes: int
    policy: str = ENV_ID


def run(cell: Cell) -> dict[str, Any]:
    """Test a policy, given by the id of a published one, or by its file."""
    env_id, _ = trained_in(cell.policy) or (ENV_ID, {})
    physics = {"time_step": cell.milliseconds / 1000}
    count = BATCH if cell.engine == "analytic" else 1
    with closing(make_envs(env_id, count, engine=cell.engine, physics=physics)) as envs:
        policy = NoisyPolicy(load_policy(cell.policy, envs), cell.noise)
        episodes = run_episodes(envs, policy, cell.episodes, TEST_SEED)
    successes = [episode.success_at_end for episode in episodes]
    return {
        "noise": cell.noise,
        "engine": cell.engine,
        "milliseconds": cell.milliseconds,
        "success": wilson(successes).as_dict(),
    }


def lines(record: dict[str, Any]) -> Iterator[str]:
    """Yield the table in Markdown: a row for each noise."""
    if not record:
        yield "Not measured on this version yet: `make bench-limits`."
        return
    found = {
        (cell["noise"], cell["engine"], cell["milliseconds"]): cell["success"]
        for cell in record["cells"]
    }
    noises, engines, steps = (list(dict.fromkeys(values)) for values in zip(*found, strict=True))
    columns = list(product(engines, steps))
    widest = max((cell["high"] - cell["low"]) / 2 for cell in found.values())
    yield (
        f"`{record['machine']['command']}`: {record['episodes']} episodes a cell, 95% intervals of "
        f"at most +-{100 * widest:.1f} points, tpm_gym {record['machine']['versions']['tpm_gym']}."
    )
    yield ""
    yield from table(
        ["noise", *(f"{ENGINES[engine]}, {step:g} ms" for engine, step in columns)],
        [
            [f"{noise:g}", *(f"{found[(noise, *column)]['mean']:.1%}" for column in columns)]
            for noise in noises
        ],
    )


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = make_parser("Success of a policy in each engine.")
    parser.add_argument("--policy", default=ENV_ID, help="id of a published policy, or a file")
    parser.add_argument("--milliseconds", type=float, nargs="+", default=MILLISECONDS)
    parser.add_argument("--noises", type=float, nargs="+", default=NOISES)
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args(arguments)
    if options.write and options.policy != ENV_ID:
        parser.error(f"--write is for the published policy, {ENV_ID}")
    return options


def main() -> None:
    """Parse the options, measure and publish the record."""
    options = parse()
    todo = [
        Cell(noise, engine, step, options.episodes, options.policy)
        for noise, engine, step in product(options.noises, ENGINES, options.milliseconds)
    ]
    found = []
    with ProcessPoolExecutor(options.jobs) as pool:
        for cell in pool.map(run, todo):
            print(cell, file=sys.stderr)
            found.append(cell)
    record = {"machine": describe(sys.argv), "episodes": options.episodes, "cells": found}
    publish(record, RECORD, PAGE, "limits", lines, write=options.write)


if __name__ == "__main__":
    main()
