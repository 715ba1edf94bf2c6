"""The folder of a run: made, emptied, kept from other processes; errors of its disk explained."""

from __future__ import annotations

import errno
import json
import os
import shutil
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from tpm_gym.learning.checkpoint import CheckpointStore
from tpm_gym.learning.errors import NotARunError, RunBusyError, RunExistsError, RunWriteError
from tpm_gym.learning.policies import CONFIG_FILE

_DISK_ERRORS: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)


def prepare(run: Path, overwrite: bool) -> None:
    """Make the folder of a new run, empty but for hidden files.

    Args:
        run: The folder.
        overwrite: Whether an earlier run in it is to be deleted.

    Raises:
        RunExistsError: There is something in it.
        NotARunError: What is to be deleted is no run.
        RunBusyError: Another process trains in it.
    """
    # A process killed in its first moment leaves the hidden half of a file.
    if run.exists() and (not run.is_dir() or any(_visible(run))):
        if not overwrite:
            raise RunExistsError(run)
        # Deleting is for folders that train.py has written, whatever --run was set to.
        if description(run) is None:
            raise NotARunError(run, CONFIG_FILE)
        with claimed(run):
            clear(run)
    run.mkdir(parents=True, exist_ok=True)


def description(run: Path) -> dict[str, Any] | None:
    """Return the configuration in the folder of a run; None where train.py wrote none.

    Args:
        run: The folder.
    """
    try:
        stored = json.loads((run / CONFIG_FILE).read_bytes())
    except (OSError, ValueError):
        return None
    # Other programs, too, have a config.json.
    ours = isinstance(stored, dict) and {"algo", "env", "training_seeds"} <= stored.keys()
    return stored if ours else None


def clear(run: Path, but: str | None = None) -> None:
    """Delete what is in the folder of a run.

    Args:
        run: The folder.
        but: Name of a file that stays.
    """
    # Last goes what says that this is a run: a process killed half way can then do it again.
    for entry in sorted(run.iterdir(), key=lambda entry: entry.name == CONFIG_FILE):
        if entry.name == but:
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        else:
            entry.unlink()


def _visible(run: Path) -> Iterator[Path]:
    return (entry for entry in run.iterdir() if not entry.name.startswith("."))


@contextmanager
def claimed(run: Path) -> Iterator[None]:
    """Keep other processes out of a run; the system ends this however the process ends.

    Raises:
        RunBusyError: Another process is in it.
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
            raise RunBusyError(run) from error
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
        RunWriteError: The disk is full or broken.
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
        raise RunWriteError(run, error.strerror or str(error), store.newest) from error
    finally:
        threading.excepthook = before


def _is_disk_error(error: BaseException | None) -> bool:
    return isinstance(error, OSError) and error.errno in _DISK_ERRORS
