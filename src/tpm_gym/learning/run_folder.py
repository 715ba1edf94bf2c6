"""The folder of a run: what is in it, and who may write or delete there.

Nothing is ever deleted but files that a run writes, by name, and no policy unless it is asked for.
"""

from __future__ import annotations

import errno
import json
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from tpm_gym.learning.errors import RunError

if TYPE_CHECKING:
    from tpm_gym.learning.checkpoint import CheckpointStore

CONFIG_FILE: Final = "config.json"
EVALUATIONS_FILE: Final = "evaluations.jsonl"
PROGRESS_FILE: Final = "progress.csv"
CURVE_FILE: Final = "learning_curve.png"
CHECKPOINTS: Final = "checkpoints"
TESTS: Final = "tests"
BEST_FILE: Final = "best.zip"
LAST_FILE: Final = "last.zip"
EXPORTED: Final = (".json", ".safetensors")
WHOLE: Final = "[!.]*.json"
"""JSON files, without the hidden halves that a process leaves which was killed while it wrote."""

RESTORED: Final = (
    CONFIG_FILE,
    PROGRESS_FILE,
    EVALUATIONS_FILE,
    BEST_FILE,
    *(Path(BEST_FILE).with_suffix(suffix).name for suffix in EXPORTED),
)
"""Files that belong to a checkpoint: what is in them later is done again."""
_POLICIES: Final = tuple(
    Path(file).with_suffix(suffix).name
    for file in (BEST_FILE, LAST_FILE)
    for suffix in (".zip", *EXPORTED)
)
_EVENTS: Final = "events.out.tfevents.*"
_FULL: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_DISK_ERRORS: Final = (*_FULL, errno.EIO, errno.EROFS, errno.EACCES, errno.EPERM)


def prepare(run: Path, overwrite: bool) -> None:
    """Make the folder of a new run; with ``overwrite``, delete an earlier run, but no other files.

    Raises:
        RunError: There is something in it, what is to be deleted is no run, another process trains
            in it, or it cannot be made.
    """
    try:
        run.mkdir(parents=True, exist_ok=True)
        # A process killed in its first moment leaves the hidden half of a file.
        if any(not entry.name.startswith(".") for entry in run.iterdir()):
            _clear_earlier(run, overwrite)
    except FileExistsError as error:
        raise RunError(f"{run} is not a folder; choose another with --run") from error
    except OSError as error:
        raise RunError(f"cannot write to {run}: {error.strerror}; choose another --run") from error


def _clear_earlier(run: Path, overwrite: bool) -> None:
    """Delete the earlier run in a folder, if that is what is there and what was asked for."""
    if not overwrite:
        raise RunError(
            f"{run} is not an empty folder; choose another with --run, continue the earlier run "
            f"with tpm-gym resume {run}, or replace it with --overwrite"
        )
    if description(run) is None:
        raise RunError(
            f"--overwrite would delete {run}, which holds no {CONFIG_FILE} of a training and so is "
            "no earlier run; choose another folder with --run"
        )
    with claimed(run):
        clear(run)
        (run / CONFIG_FILE).unlink()  # last: a process killed half way can then do it again


def description(run: Path) -> dict[str, Any] | None:
    """Return the configuration in the folder of a run; None where no training wrote one."""
    try:
        stored = json.loads((run / CONFIG_FILE).read_bytes())
    except (OSError, ValueError):
        return None
    # Other programs, too, have a config.json.
    ours = isinstance(stored, dict) and {"algo", "env", "training_seeds"} <= stored.keys()
    return stored if ours else None


def evaluations(run: Path) -> list[dict[str, Any]]:
    """Return the evaluations of a run, without one that a kill or a full disk has cut.

    Raises:
        ValueError: A line is whole and no JSON.
    """
    try:
        lines = (run / EVALUATIONS_FILE).read_text(encoding="utf-8").splitlines(keepends=True)
    except FileNotFoundError:
        return []
    return [json.loads(line) for line in lines if line.endswith("\n")]


def is_finished(run: Path) -> bool:
    """Whether a training has gone to its end, and its last policy is there."""
    try:
        wanted = int(json.loads((run / CONFIG_FILE).read_bytes())["steps"])
        found = evaluations(run)
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return bool(found) and found[-1]["steps"] >= wanted and (run / LAST_FILE).is_file()


def holds_policy(run: Path) -> bool:
    """Whether there is a policy in the folder of a run."""
    return any((run / name).exists() for name in _POLICIES)


def clear(run: Path) -> None:
    """Delete what a training has written to its folder, but its configuration."""
    from tpm_gym.learning.checkpoint import CheckpointStore

    CheckpointStore(run / CHECKPOINTS).clear()
    clear_tests(run)
    names = {*RESTORED, *_POLICIES, CURVE_FILE} - {CONFIG_FILE}
    for path in [*(run / name for name in names), *run.glob(_EVENTS)]:
        path.unlink(missing_ok=True)


def clear_tests(run: Path) -> None:
    """Delete the evaluations of a run's policy, which will soon be another."""
    for path in (run / TESTS).glob(WHOLE):
        with suppress(ValueError):
            content = json.loads(path.read_bytes())
            if isinstance(content, dict) and {"env", "episodes", "command"} <= content.keys():
                path.unlink()
    with suppress(OSError):  # it is not there, or something else is in it
        (run / TESTS).rmdir()


@contextmanager
def claimed(run: Path) -> Iterator[None]:
    """Keep other processes out of a run; the system ends this however the process ends.

    Raises:
        RunError: Another process is in it.
    """
    if sys.platform == "win32":
        yield
        return
    import fcntl

    handle = os.open(run, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RunError(
                f"another process is training in {run}; stop it first, or choose another run"
            ) from error
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(handle)


@contextmanager
def disk_errors_named(run: Path, store: CheckpointStore) -> Iterator[None]:
    """Turn the errors of a full or broken disk into one that says how to go on.

    Training without its logs would be of no use, so it ends; only a checkpoint may fail.

    Raises:
        RunError: The disk is full, broken or not to be written to.
    """
    before = threading.excepthook

    def hook(failed: threading.ExceptHookArgs) -> None:
        # TensorBoard's thread fails as well, and its traceback would bury the error's one line.
        if not _is_disk_error(failed.exc_value):
            before(failed)

    threading.excepthook = hook
    try:
        yield
    except OSError as error:
        if not _is_disk_error(error):
            raise
        go_on = (
            "start it anew with --overwrite"
            if store.newest is None
            else f"continue from step {store.newest:,} with: tpm-gym resume {run}"
        )
        problem = error.strerror or error
        remedy = "make room" if error.errno in _FULL else "make it writable"
        raise RunError(f"cannot write to {run}: {problem}; {remedy}, then {go_on}") from error
    finally:
        threading.excepthook = before


def _is_disk_error(error: BaseException | None) -> bool:
    return isinstance(error, OSError) and error.errno in _DISK_ERRORS
