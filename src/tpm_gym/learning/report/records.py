"""What is kept of runs, one small file each, and the page that is written from these files.

``collect`` condenses every run in a folder (its config.json, evaluations.jsonl and the evaluations
in ``tests/``, which a study has written there), and every bisection, which has tests alone.
``write`` needs the records alone, so a fresh clone can do it. Runs that did not finish are kept.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tpm_gym.learning import provenance
from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.report.page import Record, page
from tpm_gym.learning.robustness import nominal
from tpm_gym.learning.run_folder import CONFIG_FILE, TESTS, WHOLE, evaluations

RECORDS: Final = Path("docs", "results")
PAGE: Final = Path("docs", "results.md")

_KEPT: Final = (
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
_KEPT_OF_BISECTIONS: Final = (
    "env",
    "policy",
    "episodes",
    "versions",
    "git_commit",
    "machine",
    "command",
)
_KEPT_OF_TESTS: Final = ("success_at_end", "git_commit")
_CURVES: Final = ("success_at_end", "return", "unsafe_share")
_NOT_KEPT: Final = ("records", "versions", "machine", "policy", "env")


@dataclass(frozen=True)
class Collect:
    """Condense runs into records."""

    runs: Path = Path("runs/study")
    """Folder of the run folders."""

    to: Path = RECORDS
    """Folder of the records, a file for each run."""


@dataclass(frozen=True)
class Write:
    """Write the page and its figures from the records."""

    records: Path = RECORDS
    """Folder of the records."""

    page: Path = PAGE
    """The page; figures go into images/ beside it."""


def collect(config: Collect) -> list[Path]:
    """Condense every run and bisection of a folder; return the files written, in order of names.

    Raises:
        ConfigError: The folder holds none, or one that :func:`condense` refuses.
    """
    runs = {path.parent for path in config.runs.glob(f"*/{CONFIG_FILE}")}
    bisections = {path.parent.parent for path in config.runs.glob(f"*/{TESTS}/{WHOLE}")} - runs
    if not runs | bisections:
        raise ConfigError(f"--runs {config.runs}: holds no folder with a {CONFIG_FILE} or {TESTS}")
    written = []
    for folder in sorted(runs | bisections):
        path = config.to / f"{folder.name}.json"
        record = condense(folder) if folder in runs else condense_bisection(folder)
        provenance.write_json(path, record)
        written.append(path)
    return written


def condense(run: Path) -> Record:
    """Return what is kept of a run, finished or not.

    Raises:
        ConfigError: A file of it is damaged, or the run is of another machine or drive than its id
            says, which a record has no place for.
    """
    config = _read(run / CONFIG_FILE)
    other = dict(config["env_options"])
    engine = other.pop("engine", "pybullet")
    if other:
        valid = "the page compares runs of the ids as they are; move this one elsewhere"
        raise ConfigError(f"--runs {run}: was made with {other}; {valid}")
    try:
        found = evaluations(run)
    except ValueError as error:
        raise ConfigError(f"--runs {run}: its evaluations are damaged: {error}") from error
    steps = [evaluation["steps"] for evaluation in found]
    curves = {"steps": steps, "wall_seconds": [e["wall_seconds"] for e in found]}
    for name in _CURVES:
        if found and all(name in evaluation for evaluation in found):
            curves[name] = [round(evaluation[name]["mean"], 6) for evaluation in found]
    files = sorted(run.glob(f"{TESTS}/{WHOLE}"))
    # Without the episodes, and what the run says already
    tests = {
        path.stem: {name: value for name, value in _read(path).items() if name not in _NOT_KEPT}
        for path in files
    }
    return {
        "run": run.name,
        **{name: config.get(name) for name in _KEPT},
        "engine": engine,
        "resumed": len(config.get("resumed", [])),
        "finished": bool(steps) and steps[-1] >= config["steps"],
        "evaluations": curves,
        "tests": tests,
    }


def condense_bisection(folder: Path) -> Record:
    """Return what is kept of the tests of one attribute, in order of its values.

    Raises:
        ConfigError: A file of it is damaged.
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
            **{name: first[name] for name in _KEPT_OF_BISECTIONS},
            "tests": {
                f"{test['randomisation'][attribute]:g}": {
                    name: test[name] for name in _KEPT_OF_TESTS
                }
                for test in tests
                if test["episodes"] == first["episodes"]  # others are of before
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


def write(config: Write) -> list[Path]:
    """Write the page and its figures; return the files written.

    Raises:
        ConfigError: A record is damaged.
    """
    from tpm_gym.learning.report.figures import draw  # here, since it imports matplotlib

    records = [_read(path) for path in sorted(config.records.glob(WHOLE))]
    figures = draw(records, config.page.parent / "images")
    text = page(records, [figure.name for figure in figures])
    provenance.write_whole(config.page, lambda part: part.write_text(text, encoding="utf-8"))
    return [config.page, *figures]
