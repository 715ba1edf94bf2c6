"""Records: one small file for each run, from which the page is written.

``collect`` condenses each run folder (config.json, evaluations.jsonl, the tests in ``tests/``) and
each bisection, which has tests alone. Runs that did not finish are kept.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from tpm_gym.learning.checkpoint import CheckpointStore
from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.provenance import write_json
from tpm_gym.learning.run_folder import CHECKPOINTS, CONFIG_FILE, TESTS, WHOLE, evaluations

from .bisection import nominal

Record = dict[str, Any]

RECORDS: Final = Path("docs", "results")

_OF_RUNS: Final = (
    "env",
    "algo",
    "recipe_file",
    "recipe",
    "seed",
    "steps",
    "envs",
    "eval_episodes",
    "penalty_weight",
    "goals",
    "threads",
    "device",
    "versions",
    "git_commit",
    "machine",
    "command",
)
_OF_BISECTIONS: Final = (
    "env",
    "policy",
    "episodes",
    "versions",
    "git_commit",
    "machine",
    "command",
)
_CURVES: Final = ("success_at_end", "return", "unsafe_share")
_NOT_OF_TESTS: Final = ("records", "versions", "machine", "policy", "env")


@dataclass(frozen=True)
class Collect:
    """Condense runs into records."""

    runs: Path = Path("runs/study")
    """Folder of the run folders."""

    to: Path = RECORDS
    """Folder of the records, a file for each run."""


def collect(config: Collect) -> list[Path]:
    """Condense each run and bisection of a folder; return the new files in order of their names.

    Raises:
        ConfigError: The folder holds no run, or one that :func:`condense` refuses, or a record
            would replace a file that is no record.
    """
    runs = {path.parent for path in config.runs.glob(f"*/{CONFIG_FILE}")}
    bisections = {path.parent.parent for path in config.runs.glob(f"*/{TESTS}/{WHOLE}")} - runs
    if not runs | bisections:
        raise ConfigError(f"--runs {config.runs}: holds no folder with a {CONFIG_FILE} or {TESTS}")
    written = []
    for folder in sorted(runs | bisections):
        path = config.to / f"{folder.name}.json"
        if path.exists():
            _read_record(path)
        write_json(path, condense(folder) if folder in runs else condense_bisection(folder))
        written.append(path)
    return written


def read_records(folder: Path) -> list[Record]:
    """Return the records of a folder in order of their names.

    Raises:
        ConfigError: A file is damaged, or is no record.
    """
    return [_read_record(path) for path in sorted(folder.glob(WHOLE))]


def condense(run: Path) -> Record:
    """Return the record of a run, finished or not.

    Raises:
        ConfigError: A file of the run is damaged, or the run has another machine or drive than its
            id says: records have no place for these.
    """
    config = _read(run / CONFIG_FILE)
    other = dict(config["env_options"])
    engine = other.pop("engine", "pybullet")
    if other:
        valid = "the page compares runs of the ids as they are; move this run elsewhere"
        raise ConfigError(f"--runs {run}: was made with {other}; {valid}")
    try:
        found = evaluations(run)
    except ValueError as error:
        raise ConfigError(f"--runs {run}: its evaluations are damaged: {error}") from error
    steps = [evaluation["steps"] for evaluation in found]
    curves = {"steps": steps, "wall_seconds": [e["wall_seconds"] for e in found]}
    if found and "cpu_seconds" in found[-1]:
        curves["cpu_seconds"] = [e.get("cpu_seconds") for e in found]
    for name in _CURVES:
        if found and all(name in evaluation for evaluation in found):
            curves[name] = [round(evaluation[name]["mean"], 6) for evaluation in found]
    saved = CheckpointStore(run / CHECKPOINTS).steps()
    return {
        "run": run.name,
        **{name: config.get(name) for name in _OF_RUNS},
        "engine": engine,
        "resumed": len(config.get("resumed", [])),
        "reached": max([0, *steps, *saved]),
        "finished": bool(steps) and steps[-1] >= config["steps"],
        "evaluations": curves,
        # The episodes are left out, and the entries that the run has itself.
        "tests": {
            path.stem: {
                name: value for name, value in _read(path).items() if name not in _NOT_OF_TESTS
            }
            for path in sorted(run.glob(f"{TESTS}/{WHOLE}"))
        },
    }


def condense_bisection(folder: Path) -> Record:
    """Return the record of a bisection, its tests in order of their values.

    Raises:
        ConfigError: A file of the bisection is damaged.
    """
    tests = [_read(path) for path in folder.glob(f"{TESTS}/{WHOLE}")]
    try:
        (attribute,) = {name for test in tests for name in test["randomisation"]}
        tests.sort(key=lambda test: float(test["randomisation"][attribute]))
        (first,) = [t for t in tests if t["randomisation"][attribute] == nominal(attribute)]
        return {
            "run": folder.name,
            "attribute": attribute,
            "engine": first["env_options"].get("engine", "pybullet"),
            **{name: first[name] for name in _OF_BISECTIONS},
            "tests": {
                f"{test['randomisation'][attribute]:g}": {
                    name: test[name] for name in ("success_at_end", "git_commit")
                }
                for test in tests
                if test["episodes"] == first["episodes"]  # others are from an earlier study
            },
        }
    except (KeyError, ValueError, AttributeError) as error:
        raise ConfigError(f"--runs {folder}: its tests are of no bisection: {error!r}") from error


def _read(path: Path) -> Record:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} is damaged: {error}") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{path} is damaged: it holds no mapping")
    return content


def _read_record(path: Path) -> Record:
    record = _read(path)
    needed = {"run", "env", "engine", "tests", "versions", "machine", "git_commit"}
    needed |= {"episodes"} if "attribute" in record else {"evaluations", "finished", "recipe"}
    if missing := sorted(needed - record.keys()):
        raise ConfigError(f"{path} is no record: it lacks {', '.join(missing)}; move it elsewhere")
    return record
