"""From training runs to docs/results.md: collect what is to be kept, then write the page from it.

    python train/results.py collect --runs runs/study
    python train/results.py write

``collect`` condenses every run in a folder (its config.json, evaluations.jsonl and the evaluations
in ``tests/``, which study.py has evaluate.py write there) into one small file in docs/results/.
``write`` needs these files alone, so a fresh clone can do it. Runs that did not finish are kept.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import tyro

from tpm_gym.learning import provenance
from tpm_gym.learning.errors import ConfigError, TrainError
from tpm_gym.learning.policies import CONFIG_FILE, EVALUATIONS_FILE, TESTS

ROOT: Final = Path(__file__).resolve().parents[3]
RECORDS: Final = ROOT / "docs" / "results"
WHOLE: Final = "[!.]*.json"
"""JSON files, without the hidden halves that a process leaves which was killed while it wrote."""

_KEPT: Final = (
    "env",
    "algo",
    "recipe_file",
    "recipe",
    "seed",
    "steps",
    "envs",
    "eval_episodes",
    "threads",
    "device",
    "versions",
    "git_commit",
    "machine",
    "command",
)
_CURVES: Final = ("success_at_end", "return", "unsafe_share")
_NOT_KEPT: Final = ("records", "versions", "machine", "policy", "env")

Record = dict[str, Any]


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

    page: Path = ROOT / "docs" / "results.md"
    """The page; figures go into images/ beside it."""


def collect(config: Collect) -> list[Path]:
    """Condense every run of a folder.

    Args:
        config: The folders.

    Returns:
        The files written, in order of their names.

    Raises:
        ConfigError: The folder holds no run, or a file of a run is damaged.
    """
    folders = sorted(path.parent for path in config.runs.glob(f"*/{CONFIG_FILE}"))
    if not folders:
        raise ConfigError("--runs", config.runs, f"holds no folder with a {CONFIG_FILE}")
    written = []
    for folder in folders:
        path = config.to / f"{folder.name}.json"
        provenance.write_json(path, condense(folder))
        written.append(path)
    return written


def condense(run: Path) -> Record:
    """Return what is kept of a run, finished or not.

    Args:
        run: The run folder.

    Raises:
        ConfigError: A file of it is damaged.
    """
    config = _read(run / CONFIG_FILE)
    evaluations = _read_lines(run / EVALUATIONS_FILE)
    steps = [evaluation["steps"] for evaluation in evaluations]
    curves = {"steps": steps, "wall_seconds": [e["wall_seconds"] for e in evaluations]}
    for name in _CURVES:
        if evaluations and all(name in evaluation for evaluation in evaluations):
            curves[name] = [round(evaluation[name]["mean"], 6) for evaluation in evaluations]
    files = sorted(run.glob(f"{TESTS}/{WHOLE}"))
    tests = {path.stem: _condense_test(_read(path)) for path in files}
    return {
        "run": run.name,
        **{name: config.get(name) for name in _KEPT},
        # Runs of before these options had what is their default.
        "penalty_weight": config.get("penalty_weight", 1.0),
        "goals": config.get("goals", "sampled"),
        "resumed": len(config.get("resumed", [])),
        "finished": bool(steps) and steps[-1] >= config["steps"],
        "evaluations": curves,
        "tests": tests,
    }


def _condense_test(content: Mapping[str, Any]) -> Record:
    """Leave out the episodes, and what the run says already."""
    return {name: value for name, value in content.items() if name not in _NOT_KEPT}


def read_whole_lines(path: Path) -> list[Record]:
    """Return the records in a file of JSON lines, without one that a kill or full disk has cut.

    Args:
        path: The file; there need not be one.

    Raises:
        ValueError: A line is whole and no JSON.
    """
    if not path.is_file():
        return []
    whole = [line for line in path.read_text(encoding="utf-8").splitlines(True) if line[-1] == "\n"]
    return [json.loads(line) for line in whole]


def _read(path: Path) -> Record:
    """Read a JSON file that holds a mapping."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError("--runs", path, f"is damaged: {error}") from error
    if not isinstance(content, dict):
        raise ConfigError("--runs", path, "is damaged: it holds no mapping")
    return content


def _read_lines(path: Path) -> list[Record]:
    """Read a file of JSON lines; none where a run ended before its first."""
    try:
        return read_whole_lines(path)
    except ValueError as error:
        raise ConfigError("--runs", path, f"is damaged: {error}") from error


def write(config: Write) -> list[Path]:
    """Write the page and its figures.

    Args:
        config: The folders.

    Returns:
        The files written.

    Raises:
        ConfigError: There are no records, or one is damaged.
    """
    from tpm_gym.learning.report_figures import draw
    from tpm_gym.learning.report_page import page

    paths = sorted(config.records.glob(WHOLE))
    if not paths:
        raise ConfigError("--records", config.records, "holds no records; collect them first")
    records = [_read(path) for path in paths]
    figures = draw(records, config.page.parent / "images")
    text = page(records, [figure.name for figure in figures])
    provenance.write_whole(config.page, lambda part: part.write_text(text, encoding="utf-8"))
    return [config.page, *figures]


Command = (
    Annotated[Collect, tyro.conf.subcommand("collect")]
    | Annotated[Write, tyro.conf.subcommand("write")]
)


def main() -> None:
    """Run the command line."""
    config: Collect | Write = tyro.cli(Command, description=__doc__)
    try:
        paths = collect(config) if isinstance(config, Collect) else write(config)
    except TrainError as error:
        sys.exit(f"error: {error}")
    for path in paths:
        print(path)


if __name__ == "__main__":
    main()
