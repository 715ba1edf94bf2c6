"""Functions of floats that Numba compiles.

Objects touch a few at a time, with many branches: NumPy would spend its time on calls.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import numba
from numba.extending import register_jitable

from tpm_gym.arrays import rotate
from tpm_gym.mechanism.cup import sealed
from tpm_gym.simulation.vacuum import hold_after, holds, pressure_after

__all__ = ["SOURCES", "compiled", "kept", "source_files"]

_Function = TypeVar("_Function", bound=Callable[..., Any])

for _law in (rotate, sealed, pressure_after, holds, hold_after):  # compiled functions may call them
    register_jitable(_law)


def compiled(function: _Function) -> _Function:
    """Compile a function; divisions by zero give infinities."""
    return cast(_Function, numba.njit(error_model="numpy")(function))


def kept(function: _Function) -> _Function:
    """Compile a function and keep it on disk; its last argument is ``sources: str = SOURCES``.

    Numba itself sees changes of the function's own file only.
    """
    try:
        return cast(_Function, numba.njit(error_model="numpy", cache=True)(function))
    except RuntimeError:  # nowhere to write: beside the file, or in the user's cache
        return compiled(function)


def source_files() -> list[Path]:
    """All that may be compiled into a function."""
    package = Path(__file__).parents[2]
    rooms = ("mechanism", "simulation", "simulation/analytic", "simulation/analytic/contact")
    return [package / "arrays.py", *(f for room in rooms for f in (package / room).glob("*.py"))]


SOURCES: Final = hashlib.sha256(
    b"".join(f.read_bytes() for f in sorted(source_files()))
).hexdigest()
"""So that a kept function is one of today's."""
