"""Context manager that discards the output of PyBullet's C code."""

import ctypes
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_lock = threading.RLock()


@contextmanager
def silence(descriptor: int = 1) -> Iterator[None]:
    """Discard what Python and C code print within the context.

    This affects the whole process. So a lock admits only one thread at a time.

    Args:
        descriptor: File descriptor: 1 is the standard output, 2 the standard error.
    """
    with _lock:
        try:
            kept = os.dup(descriptor) if os.name == "posix" else -1
        except OSError:  # there is no such output
            kept = -1
        if kept < 0:
            yield
            return
        _flush()
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), descriptor)
            try:
                yield
            finally:
                _flush()
                os.dup2(kept, descriptor)
                os.close(kept)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, ValueError, OSError):  # it may be None, or closed
            stream.flush()
    ctypes.CDLL(None).fflush(None)
