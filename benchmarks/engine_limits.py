"""Success of the published policy in each engine, at two time steps, with noise on its actions.

    python benchmarks/engine_limits.py

Each engine acts on its own observations. Noise makes the policy drop, throw and shove, so that
success depends on contact. Engines agree if their numbers do, and a time step is short enough if a
shorter one gives the same numbers. Results go to docs/records/limits.json, and from there to
docs/analytic-engine.md.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from itertools import product
from typing import Any

from shared import ROOT, describe, fill, provenance, read_record, table

from tpm_gym.learning.environments import make_envs
from tpm_gym.learning.estimates import wilson
from tpm_gym.learning.policies import NoisyPolicy, load_policy
from tpm_gym.learning.rollout import TEST_SEED, run_episodes

RECORD = ROOT / "docs" / "records" / "limits.json"
PAGE = ROOT / "docs" / "analytic-engine.md"
ENV_ID = "TPMPickAndPlace-v0"
ENGINES = {"pybullet": "PyBullet", "mujoco": "MuJoCo", "analytic": "analytic"}
MILLISECONDS = (4, 1)
NOISES = (0.0, 0.3, 0.8)
"""Standard deviations of the noise, in units of the largest action."""

Cell = tuple[float, str, int, int]


def run(cell: Cell) -> dict[str, Any]:
    """Test one noise in one engine at one time step."""
    noise, engine, milliseconds, count = cell
    physics = {"time_step": milliseconds / 1000}
    with closing(make_envs(ENV_ID, 1, engine=engine, physics=physics)) as envs:
        policy = NoisyPolicy(load_policy(ENV_ID, envs), noise)
        episodes = run_episodes(envs, policy, count, TEST_SEED)
    successes = [episode.success_at_end for episode in episodes]
    return {
        "noise": noise,
        "engine": engine,
        "milliseconds": milliseconds,
        "success": wilson(successes).as_dict(),
    }


def publish() -> None:
    """Fill the page from the record."""
    fill(PAGE, "limits", lines(read_record(RECORD)))


def lines(record: dict[str, Any]) -> Iterator[str]:
    """Yield the table in Markdown: a row for each noise."""
    if not record:
        yield "Not measured on this version yet: `make bench-limits`."
        return
    found = {
        (cell["noise"], cell["engine"], cell["milliseconds"]): cell["success"]
        for cell in record["cells"]
    }
    columns = list(product(ENGINES, MILLISECONDS))
    widest = max((cell["high"] - cell["low"]) / 2 for cell in found.values())
    yield (
        f"`{record['machine']['command']}`: {record['episodes']} episodes a cell, 95% intervals of "
        f"at most +-{100 * widest:.1f} points, tpm_gym {record['machine']['versions']['tpm_gym']}."
    )
    yield ""
    yield from table(
        ["noise", *(f"{ENGINES[engine]}, {step} ms" for engine, step in columns)],
        [
            [f"{noise:g}", *(f"{found[(noise, *column)]['mean']:.1%}" for column in columns)]
            for noise in NOISES
        ],
    )


def main() -> None:
    """Parse the options, measure, write the record and fill the page."""
    parser = argparse.ArgumentParser(description="Success at two time steps, in each engine.")
    parser.add_argument("--episodes", type=int, default=400)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    todo = [
        (noise, engine, step, options.episodes)
        for noise, engine, step in product(NOISES, ENGINES, MILLISECONDS)
    ]
    found = []
    with ProcessPoolExecutor(options.jobs) as pool:
        for cell in pool.map(run, todo):
            print(cell, file=sys.stderr)
            found.append(cell)
    record = {"machine": describe(sys.argv), "episodes": options.episodes, "cells": found}
    print("\n".join(lines(record)))
    provenance.write_json(RECORD, record)
    publish()


if __name__ == "__main__":
    main()
