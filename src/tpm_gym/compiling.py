"""Compile functions by Numba, and keep their machine code on disk.

Importing this module imports Numba, which takes some 0.3 s. Modules that compile are therefore
imported when something is first computed.
"""

from __future__ import annotations

import hashlib
import inspect
import logging
import sys
import threading
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
"""Time of compiling without a message, s."""
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

    It is compiled again when a source changes that is compiled into it, and when the file on disk
    is damaged. Where no folder can be written, it is compiled in memory.
    """
    dispatcher: Any = compiled(function)
    dispatcher._cache = _Cache(function)
    return cast(_Function, dispatcher)


class _Disk(_CACHING.FunctionCache):  # type: ignore[misc]  # Numba has no types
    """Numba's files, found by signature and processor alone.

    Numba also asks for an equal pickle of the closure. But the pickle of a function differs between
    a process that reads its source and one that reads its bytecode. The stamp covers the closure.
    """

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        return sig, codegen.magic_tuple()


class _Cache:
    """Numba's cache of a function, renewed with any of the function's sources; never raises."""

    _announced = False

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
            # Numba's own stamp covers only the file of the function. This stamp is computed at the
            # first use, because the decorator does not know functions that are defined later.
            self._disk._cache_file._source_stamp = stamp(self._function)
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
        if _Cache._announced:
            return
        _Cache._announced = True
        where = (
            f"once; the machine code is kept in {self.cache_path}"
            if self.cache_path
            else "in every process: set NUMBA_CACHE_DIR to a folder that can be written"
        )
        _LOGGER.warning(
            "compiling %s and others, which takes up to a minute, %s", self._label, where
        )


_CONSTANTS = (int, float, complex, str, np.generic, np.ndarray)


def stamp(function: Callable[..., Any]) -> str:
    """Compute a hash of all that is compiled into a function: its sources and constants."""
    parts = sorted(set(_parts(function, function.__module__.partition(".")[0], set())))
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _parts(value: Any, package: str, seen: set[int]) -> Iterator[str]:
    """Yield the sources of ``package`` and the constants that a value refers to."""
    value = getattr(value, "py_func", value)
    if id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, tuple):
        for part in value:
            yield from _parts(part, package, seen)
    elif inspect.isfunction(value) or inspect.isclass(value):
        if value.__module__.partition(".")[0] != package:
            return
        yield _text(getattr(sys.modules.get(value.__module__), "__file__", None))
        for used in _used(value) if inspect.isfunction(value) else ():
            yield from _parts(used, package, seen)
    elif isinstance(value, _CONSTANTS):  # the repr of others may differ between processes
        yield repr(value)


def _used(function: Any) -> Iterator[Any]:
    """Yield the values of a function's names: globals, attributes of modules, closure."""
    names, scope = set(_names(function.__code__)), function.__globals__
    yield from (cell.cell_contents for cell in function.__closure__ or ())
    for name in names & scope.keys():
        yield scope[name]
        if isinstance(scope[name], ModuleType):
            yield from (vars(scope[name])[other] for other in names & vars(scope[name]).keys())


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _text(file: str | None) -> str:
    with suppress(OSError, TypeError):
        return Path(cast(str, file)).read_text(encoding="utf-8")
    return ""
