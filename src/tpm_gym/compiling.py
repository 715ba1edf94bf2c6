"""Compilation of functions by Numba; their machine code is kept on disk.

Importing this module imports Numba, which takes some 0.3 s. Modules with compiled functions are
therefore imported only at the first computation.
"""

from __future__ import annotations

import hashlib
import inspect
import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, Final, TypeVar, cast

import numba
import numpy as np
from numba import literal_unroll
from numba.core import caching
from numba.extending import register_jitable

__all__ = ["PATIENCE", "compilable", "compiled", "kept", "literal_unroll", "stamp"]

_Function = TypeVar("_Function", bound=Callable[..., Any])

_CACHING: Any = caching
PATIENCE: Final = 1.0
"""Time after which a message says that functions are being compiled, s."""
_PAUSE: Final = 10.0
"""Least time between two such messages, s."""
_LOGGER: Final = logging.getLogger("tpm_gym")


def compilable(*functions: Callable[..., Any]) -> None:
    """Let compiled functions call these functions, which stay callable from Python."""
    for function in functions:
        register_jitable(forceinline=True)(function)


def compiled(function: _Function) -> _Function:
    """Compile a function in memory; it releases the GIL, and division by zero gives infinity."""
    return cast(_Function, numba.njit(error_model="numpy", nogil=True)(function))


def kept(function: _Function) -> _Function:
    """Compile a function as :func:`compiled` does, and keep its machine code on disk.

    It is compiled again if any source code that goes into it has changed, or if the file on disk is
    damaged. If no folder can be written, it is compiled in memory.
    """
    dispatcher: Any = compiled(function)
    dispatcher._cache = _Cache(function)
    return cast(_Function, dispatcher)


class _Code(_CACHING.CompileResultCacheImpl):  # type: ignore[misc]  # Numba has no types
    """Content of a file in Numba's cache: a function's machine code and :func:`stamp` (a hash)."""

    stamp = ""

    def reduce(self, cres: Any) -> Any:
        """Return the stamp and Numba's data, which are written to the file."""
        return self.stamp, super().reduce(cres)

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        """Return the machine code; None if its source code has changed since it was compiled.

        Numba writes a new index first, then the new code. In between, the new index points to the
        old code. This remains so if the process is killed in between.
        """
        stamp, code = payload
        return super().rebuild(target_context, code) if stamp == self.stamp else None


class _Disk(_CACHING.FunctionCache):  # type: ignore[misc]
    """Numba's files, found by stamp, signature and processor.

    Numba itself also compares a pickle of the function's closure. This class does not: the pickle
    differs between a process that reads the source code and one that reads its bytecode. The stamp
    covers the closure.
    """

    _impl_class = _Code

    def renew(self, stamp: str) -> None:
        """Set the stamp that files must have; Numba's own stamp covers one source file only."""
        self._cache_file._source_stamp = self._impl.stamp = stamp

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        return sig, codegen.magic_tuple()


class _Cache:
    """Cache of a function's machine code, renewed if its source code changes; never raises."""

    _announced: float | None = None  # time of the last message

    def __init__(self, function: Callable[..., Any]) -> None:
        """Find a folder that can be written."""
        self._function = function
        self._label = f"{function.__module__}.{function.__qualname__}"
        try:
            self._disk = _Disk(function)
        except (RuntimeError, OSError):
            self._disk = _CACHING.NullCache()

    @property
    def cache_path(self) -> str | None:
        """Folder, or None if no folder can be written."""
        return cast("str | None", self._disk.cache_path)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load the machine code of a signature; None if it has to be compiled."""
        found = None
        if not isinstance(self._disk, _CACHING.NullCache):
            # At the first use, because the decorator does not know functions that are defined later
            self._disk.renew(stamp(self._function))
        try:
            found = self._disk.load_overload(sig, target_context)
        except Exception:  # damaged: unpickling raises almost anything
            with suppress(OSError):
                self._disk.flush()
        # If two processes wrote at the same time, the file may contain another signature's code.
        if found is not None and found.signature.args == sig:
            return found
        self._timer = threading.Timer(PATIENCE, self._announce)
        self._timer.daemon = True
        self._timer.start()
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save the machine code of a signature, if it can be written."""
        self._timer.cancel()
        with suppress(OSError):
            self._disk.save_overload(sig, data)

    def _announce(self) -> None:
        last, now = _Cache._announced, time.monotonic()
        if last is not None and now - last < _PAUSE:
            return
        _Cache._announced = now
        if last is not None:
            _LOGGER.warning("still compiling: now %s", self._label)
            return
        where = (
            f"once; the machine code is kept in {self.cache_path}"
            if self.cache_path
            else "in every process: set NUMBA_CACHE_DIR to a folder that can be written"
        )
        _LOGGER.warning(
            "compiling %s and others, which takes up to a minute, %s", self._label, where
        )


_CONSTANTS = (int, float, complex, str, np.generic, np.dtype, numba.types.Number)
_LIBRARIES: Final = {"numba", "numpy", *sys.stdlib_module_names}
"""Packages from which :func:`stamp` includes only the names of functions, not their sources."""


def stamp(function: Callable[..., Any]) -> str:
    """Compute a hash of all that is compiled into a function: bytecode, source code, constants."""
    # This file is included because it has the options of Numba.
    return hashlib.sha256("\n".join([_text(__file__), *_parts(function, {})]).encode()).hexdigest()


def _parts(value: Any, seen: dict[Any, int]) -> Iterator[str]:
    """Yield the texts about a value that :func:`stamp` hashes.

    The texts are equal in all processes in which code and constants are equal. Their order matters,
    because the same parts in another order make another function.
    """
    value = getattr(value, "py_func", value)
    if isinstance(value, tuple):
        yield f"tuple of {len(value)}"
        for part in value:
            yield from _parts(part, seen)
    elif isinstance(value, np.ndarray):
        yield f"{value.dtype} {value.shape} {value.tobytes().hex()}"
    elif isinstance(value, _CONSTANTS):
        yield repr(value)
    elif isinstance(value, CodeType):
        yield f"{value.co_code.hex()} {value.co_names} {value.co_varnames}"
        yield from _parts(value.co_consts, seen)
    elif not (isinstance(value, ModuleType) or inspect.isfunction(value) or inspect.isclass(value)):
        yield type(value).__qualname__  # the repr may differ between processes
    elif id(value) in seen:
        yield f"number {seen[id(value)]}"
    else:
        seen[id(value)] = len(seen)
        yield from _sources(value, seen)


def _sources(value: Any, seen: dict[Any, int]) -> Iterator[str]:
    """Yield the source code of a function, class or module, then text about all that it uses.

    A function's bytecode is included, because its file may have been edited since the import.
    """
    module = str(value.__name__ if isinstance(value, ModuleType) else value.__module__)
    yield f"{module} {getattr(value, '__qualname__', '')}"
    if module.partition(".")[0] in _LIBRARIES:
        return
    file = getattr(sys.modules.get(module), "__file__", None)
    if file not in seen:
        seen[file] = len(seen)
        yield _text(file)
    if inspect.isfunction(value):
        for used in (value.__code__, *_used(value)):
            yield from _parts(used, seen)
    elif isinstance(value, ModuleType):  # a namespace, whose functions are called by name
        for _, own in sorted(vars(value).items()):
            own = getattr(own, "py_func", own)
            if inspect.isfunction(own) and own.__module__ == module:
                yield from _parts(own, seen)


def _used(function: Any) -> Iterator[Any]:
    """Yield the values that a function uses: closure, defaults, globals, attributes of modules."""
    names, scope = set(_names(function.__code__)), function.__globals__
    yield from (cell.cell_contents for cell in function.__closure__ or ())
    yield function.__defaults__
    for name in sorted(names & scope.keys()):
        yield scope[name]
        if isinstance(scope[name], ModuleType):
            there = vars(scope[name])
            yield from (there[other] for other in sorted(names & there.keys()))


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _text(file: str | None) -> str:
    with suppress(OSError, TypeError, ValueError):  # no file, or no text
        return Path(cast(str, file)).read_text(encoding="utf-8")
    return ""
