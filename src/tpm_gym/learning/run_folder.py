"""Folder of a run: names of its files, and rules for writing and deleting them.

Only files that a run writes are deleted. Policies are deleted only by ``--overwrite``, and by
resuming from a checkpoint that does not contain them.
"""

import json
import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

from pydantic import TypeAdapter
from typing_extensions import TypedDict

from tpm_gym.learning.checkpoint import CheckpointStore
from tpm_gym.learning.errors import RunError
from tpm_gym.learning.provenance import read_json

CONFIG_FILE: Final = "config.json"
EVALUATIONS_FILE: Final = "evaluations.jsonl"
PROGRESS_FILE: Final = "progress.csv"
CURVE_FILE: Final = "learning_curve.png"
CHECKPOINTS: Final = "checkpoints"
TESTS: Final = "tests"
BEST_FILE: Final = "best.zip"
LAST_FILE: Final = "last.zip"
WHOLE: Final = "[!.]*.json"
"""Pattern of complete JSON files; partial files, which a killed process leaves, are hidden."""

_BEST: Final = (BEST_FILE, "best.json", "best.safetensors")
LAST: Final = (LAST_FILE, "last.json", "last.safetensors")


class _Estimate(TypedDict):
    mean: float
    low: float
    high: float


_Evaluation = TypedDict(
    "_Evaluation",
    {
        "steps": int,
        "episodes": int,
        "success_at_end": _Estimate,
        "success_once": _Estimate,
        "return": _Estimate,
    },
)
"""Values that each line of the evaluations file must have, so that a training can be resumed."""
RESTORED: Final = (CONFIG_FILE, PROGRESS_FILE, EVALUATIONS_FILE, *_BEST)
"""Files that a checkpoint holds. Resuming replaces each file by its copy in the checkpoint, except
the configuration, which is written anew. So lines that were added to a file after the checkpoint
are removed, and the resumed training writes them again."""


def prepare(run: Path, overwrite: bool) -> None:
    """Make the folder of a new run; with ``overwrite``, delete the files of an earlier run."""
    try:
        run.mkdir(parents=True, exist_ok=True)
        # A process that is killed at its start leaves a hidden, partial file.
        if all(entry.name.startswith(".") for entry in run.iterdir()):
            return
    except OSError as error:
        raise RunError(f"cannot write to {run}: {error.strerror}; choose another --run") from error
    if not overwrite:
        raise RunError(
            f"{run} is not an empty folder; choose another with --run, continue the earlier run "
            f"with {resume_command(run)}, or replace it with --overwrite"
        )
    if description(run) is None:
        raise RunError(
            f"--overwrite would delete {run}, which holds no {CONFIG_FILE} of a training; choose "
            "another folder with --run"
        )
    with claimed(run):
        clear(run)
        (run / CONFIG_FILE).unlink()  # last, so that --overwrite works again after a kill


def description(run: Path) -> dict[str, Any] | None:
    """Return the configuration in the folder of a run; None if no training wrote one."""
    try:
        stored = read_json(run / CONFIG_FILE)
    except (OSError, ValueError):
        return None
    # Other programs have a config.json, too.
    ours = isinstance(stored, dict) and {"algo", "env", "training_seeds"} <= stored.keys()
    return stored if ours else None


def resume_command(run: Path) -> str:
    """Return the command line that resumes a run.

    If the environment id has a module, as in ``module:id``, the command contains the id: a module
    is imported only if the user names it in the command. A name in a file of the run is not enough.
    """
    env = str((description(run) or {}).get("env", ""))
    return shlex.join(["tpm-gym", "resume", str(run), *(["--env", env] if ":" in env else [])])


def evaluations(run: Path) -> list[dict[str, Any]]:
    """Return the evaluations of a run, without a last line that a kill cut off."""
    try:
        return _lines((run / EVALUATIONS_FILE).read_bytes())
    except FileNotFoundError:
        return []


def checked(data: bytes) -> list[dict[str, Any]]:
    """Return the evaluations in the content of a file; raise a ValueError if one is damaged."""
    found = _lines(data)
    TypeAdapter(list[_Evaluation]).validate_python(found, strict=True)
    return found


def _lines(data: bytes) -> list[dict[str, Any]]:
    return [json.loads(line) for line in data.splitlines(keepends=True) if line.endswith(b"\n")]


def is_finished(run: Path) -> bool:
    """Return whether a training has taken all its steps and saved its last policy."""
    try:
        wanted = int(read_json(run / CONFIG_FILE)["steps"])
        found = evaluations(run)
        return bool(found) and found[-1]["steps"] >= wanted and (run / LAST_FILE).is_file()
    except (OSError, ValueError, KeyError, TypeError):
        return False


def holds_policy(run: Path) -> bool:
    """Return whether the folder of a run holds a policy."""
    return any((run / name).exists() for name in (*_BEST, *LAST))


def clear(run: Path) -> None:
    """Delete the files of a training except its configuration."""
    CheckpointStore(run / CHECKPOINTS).clear()
    clear_tests(run)
    names = {*RESTORED, *LAST, CURVE_FILE} - {CONFIG_FILE}
    for path in [*(run / name for name in names), *run.glob("events.out.tfevents.*")]:
        path.unlink(missing_ok=True)


def clear_tests(run: Path) -> None:
    """Delete the evaluations of a policy that is about to be replaced."""
    for path in (run / TESTS).glob(WHOLE):
        with suppress(ValueError):
            content = read_json(path)
            if isinstance(content, dict) and {"env", "episodes", "command"} <= content.keys():
                path.unlink()
    with suppress(OSError):  # absent, or it holds other files
        (run / TESTS).rmdir()


@contextmanager
def claimed(run: Path) -> Iterator[None]:
    """Lock a run; the system releases the lock when the process ends, even by a kill."""
    if sys.platform == "win32":
        yield
        return
    import fcntl

    handle = os.open(run, os.O_RDONLY)
    try:
        with suppress(OSError):  # a file system without locks
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise RunError(
                    f"another process is training in {run}; stop it first, or choose another run"
                ) from error
        yield
    finally:
        os.close(handle)


@contextmanager
def disk_errors_named(run: Path, store: CheckpointStore) -> Iterator[None]:
    """Convert errors of a full or broken disk to a RunError that says how to continue.

    Errors of a pipe to a process that has ended are converted, too.
    """
    try:
        yield
    except (OSError, EOFError) as error:
        go_on = (
            "start it anew with --overwrite"
            if store.newest is None
            else f"continue from step {store.newest:,} with: {resume_command(run)}"
        )
        problem = f"cannot write to {run}: {error}"
        if isinstance(error, ConnectionError | EOFError):
            problem = (
                f"a worker or the reader of the output has ended ({type(error).__name__}; a "
                "worker's own error stands above, and without one memory was full)"
            )
        raise RunError(f"{problem}; put that right, then {go_on}") from error
