"""Success in each task: the expert in each engine, and experts and policies under other conditions.

    make bench-tasks
    python benchmarks/bench_tasks.py --policies runs/variants/*

The expert plays each task on the paper's machine in each engine, on the wide machine, and with
goals that tempt towards the singularity. Policies are tested under the conditions in which they
were trained. With ``--write``, a cell that is measured again replaces the old one in
docs/records/tasks.json, from which docs/tasks.md is filled.
"""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from shared import ROOT, describe, make_parser, processor_line, publish, read_record, table

from tpm_gym.errors import ConfigurationError
from tpm_gym.learning import provenance
from tpm_gym.learning.configuration import EnvOptions
from tpm_gym.learning.evaluation import EvaluationConfig, evaluate
from tpm_gym.learning.run_folder import CONFIG_FILE
from tpm_gym.tasks.registry import TASKS

RECORD, PAGE = ROOT / "docs" / "records" / "tasks.json", ROOT / "docs" / "tasks.md"
ENGINES: Final = ("analytic", "pybullet", "mujoco")
IDS: Final = {f"TPM{kind.__name__}-v0": kind for kind in TASKS.values()}
OTHERS: Final = ({"machine": "wide"}, {"goals": "tempting"})
SHOWN: Final = 0.0005
"""Smallest share of steps with unsafe conditioning that the page shows."""
_KEY: Final = ("env", "policy", "machine", "goals", "engine")


def measure(
    env: str,
    engine: str,
    episodes: int,
    policy: str = "expert",
    machine: str = "paper",
    goals: str = "sampled",
) -> dict[str, Any]:
    """Test a policy; "refused" has the reason where a task cannot be had in this way."""
    named = policy if policy == "expert" else Path(policy).name
    cell: dict[str, Any] = dict(zip(_KEY, (env, named, machine, goals, engine), strict=True))
    options = EnvOptions(machine=machine, engine=engine)
    config = EvaluationConfig((policy,), env, episodes, goals=goals, env_options=options)
    try:
        (result,) = evaluate(config, Console(quiet=True))
    except ConfigurationError as error:
        return cell | {"refused": str(error)}
    told = {name: result.metrics[name].as_dict() for name in ("success_at_end", "unsafe_share")}
    return cell | {"episodes": episodes, "commit": provenance.git_commit(), **told}


def experts(ids: list[str], episodes: int, fewer: int) -> Iterator[dict[str, Any]]:
    """Measure the expert in each engine, then under other conditions in two of them."""
    for env in ids:
        for engine in ENGINES:
            yield measure(env, engine, episodes)
        for other in OTHERS:
            yield measure(env, "analytic", episodes, **other)
            yield measure(env, "pybullet", fewer, **other)


def policies(folders: list[Path], episodes: int, fewer: int) -> Iterator[dict[str, Any]]:
    """Measure the policies of run folders under the conditions of their training."""
    for folder in folders:
        config = json.loads((folder / CONFIG_FILE).read_text(encoding="utf-8"))
        machine = config["env_options"].get("machine", "paper")
        for engine, count in (("analytic", episodes), ("pybullet", fewer)):
            yield measure(config["env"], engine, count, str(folder), machine, config["goals"])


# -- the page -------------------------------------------------------------------------------------


def lines(record: dict[str, Any]) -> Iterator[str]:
    """Yield the tables of the page."""
    cells = {tuple(cell[name] for name in _KEY): cell for cell in record["cells"]}

    def shown(*key: str) -> str:
        cell = cells.get(key)
        if cell is None:
            return "-"
        if "refused" in cell:
            return "refused"
        unsafe = cell["unsafe_share"]["mean"]
        below = f" ({unsafe:.1%})" if unsafe >= SHOWN else ""
        return f"{cell['success_at_end']['mean']:.1%} of {cell['episodes']:,}{below}"

    yield from table(
        ["task", "lines", *(f"expert, {engine}" for engine in ENGINES)],
        [
            [name, str(_length(kind))]
            + [shown(name, "expert", "paper", "sampled", engine) for engine in ENGINES]
            for name, kind in IDS.items()
        ],
    )
    yield ""
    trained = [cell for cell in record["cells"] if cell["policy"] != "expert"]
    groups = [(name, "expert", *_conditions(other)) for name in IDS for other in OTHERS]
    groups += dict.fromkeys(tuple(cell[name] for name in _KEY[:-1]) for cell in trained)
    yield from table(
        ["task", "played by", "machine", "goals", "analytic", "pybullet"],
        [
            [group[0], _controller(group[1]), *group[2:]]
            + [shown(*group, engine) for engine in ENGINES[:2]]
            for group in sorted(groups)
            if any((*group, engine) in cells for engine in ENGINES)
        ],
    )
    yield ""
    yield f"{processor_line(record['conditions'])}; `make bench-tasks`."


def _conditions(other: dict[str, str]) -> tuple[str, str]:
    return other.get("machine", "paper"), other.get("goals", "sampled")


def _controller(policy: str) -> str:
    return policy if policy == "expert" else f"policy, seed {policy.rpartition('-s')[2]}"


def _length(kind: type) -> int:
    """Return the lines of a task's file."""
    return len(Path(inspect.getfile(kind)).read_text(encoding="utf-8").splitlines())


def main() -> None:
    """Measure, and publish the record."""
    parser = make_parser("Success in each task.")
    parser.add_argument("--envs", nargs="+", choices=IDS, default=[*IDS], help="default: all")
    parser.add_argument("--policies", nargs="+", type=Path, help="run folders, instead of experts")
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--fewer", type=int, default=200, help="in PyBullet, other conditions")
    options = parser.parse_args()
    record = (options.write and read_record(RECORD)) or {"cells": []}
    record["conditions"] = describe(sys.argv)
    counts = options.episodes, options.fewer
    if options.policies:
        found = policies(options.policies, *counts)
    else:
        found = experts(options.envs, *counts)
    for cell in found:
        key = [cell[name] for name in _KEY]
        left = [old for old in record["cells"] if [old[name] for name in _KEY] != key]
        record["cells"] = [*left, cell]
        if options.write:  # an interrupted run keeps its results
            provenance.write_json(RECORD, record)
        print(cell, file=sys.stderr)
    publish(record, RECORD, PAGE, "tasks", lines, write=options.write)


if __name__ == "__main__":
    main()
