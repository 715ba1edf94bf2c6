"""Types of arrays, checks of numbers from users, and rotations of vectors.

A check that takes an ``error`` raises it with name, value and valid range.
"""

import math
import sys
from collections.abc import Callable
from contextlib import suppress
from numbers import Real
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.errors import InputError, TPMError, UnreachableError
from tpm_gym.errors import brief as brief

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
"""Quaternion (x, y, z, w)."""

_Error = Callable[[str, Any, str], TPMError]
_Explained = TypeVar("_Explained", bound=TPMError)


def numbers(name: str, value: ArrayLike, error: _Error = InputError) -> FloatArray:
    """Return real numbers of any shape, finite or not; an array of floats is not copied.

    Strings, dates, complex numbers and other values that numpy would convert are refused, and so
    are masked arrays, whose mask would be ignored.
    """
    if type(value) is np.ndarray and value.dtype.char in "df":  # the common case, fast
        return value if value.dtype.char == "d" else value.astype(np.float64)
    if not _holds_masked(value):
        # Not ragged lists, integers beyond the range of floats, tensors that require gradients
        with suppress(TypeError, ValueError, OverflowError, RuntimeError):
            array = np.asarray(value)
            if array.dtype.char == "d":
                return array
            items = array.flat if array.dtype.kind == "O" else ()
            if array.dtype.kind in "biufO" and all(isinstance(v, Real) for v in items):
                with np.errstate(over="ignore"):
                    return array.astype(np.float64)
    raise error(name, brief(value), "real numbers in an array of regular shape")


def finite(
    name: str, value: ArrayLike, shape: tuple[int, ...], error: _Error = InputError
) -> FloatArray:
    """Return finite numbers of exactly this shape."""
    array = numbers(name, value, error)
    # all() costs twice as much
    if array.shape != shape or np.count_nonzero(np.isfinite(array)) < array.size:
        valid = f"finite numbers of shape {shape}" if shape else "a finite number"
        raise error(name, brief(value), valid)
    return array


def vector(name: str, value: ArrayLike, error: _Error = InputError) -> Vector:
    """Return three finite numbers as plain floats."""
    if isinstance(value, tuple) and len(value) == 3:
        a, b, c = value  # the common case, fast
        if type(a) is type(b) is type(c) is float and math.isfinite(a + b + c):
            return a, b, c
    array = numbers(name, value, error)
    if array.shape == (3,):
        a, b, c = array.tolist()
        if math.isfinite(a) and math.isfinite(b) and math.isfinite(c):
            return a, b, c
    raise error(name, brief(value), "three finite numbers, of shape (3,)")


def is_number(value: Any) -> bool:
    """Return whether a value is a finite real number, and no boolean."""
    with suppress(OverflowError):  # an integer beyond the range of floats
        return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    return False


def is_whole(value: Any, least: int) -> bool:
    """Return whether a value is a whole number of at least ``least``, and no boolean."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    return whole and bool(value >= least)


def points(name: str, value: ArrayLike) -> FloatArray:
    """Return points (..., 3), finite or not, in float64.

    A torch tensor remains a torch tensor, on the same device.

    Raises:
        InputError: If they are no real numbers or the last axis does not have length 3.
    """
    array: Any = value
    if type(value) is np.ndarray or not is_tensor(value):
        array = numbers(name, value)
    elif array.is_complex() or str(array.layout) != "torch.strided":
        raise InputError(name, brief(value), "real numbers of shape (..., 3), in a dense tensor")
    else:
        array = array.double()
    if array.ndim == 0 or array.shape[-1] != 3:
        raise InputError(f"shape of {name}", tuple(array.shape), "(..., 3)")
    return array  # type: ignore[no-any-return]


def finite_points(name: str, value: ArrayLike) -> FloatArray:
    """Return points (..., 3) as :func:`points` does, all finite.

    Raises:
        InputError: If they are no real numbers, not all finite, or not of that shape.
    """
    array = points(name, value)
    wrong = ~(abs(array) < math.inf).all(-1)
    if wrong.any():
        raise InputError(name, array[wrong].reshape(-1, 3)[0].tolist(), "finite")
    return array


def explained(
    explain: Callable[[Vector], _Explained], points: FloatArray, chosen: BoolArray
) -> _Explained:
    """Return the error of the first of ``points`` (..., 3) for which ``chosen`` (...,) is true.

    ``explain`` makes the error from the point. If it is an UnreachableError, its attribute
    ``index`` is set to the index of this point in the array.
    """
    x, y, z = points[chosen][0].tolist()
    error = explain((x, y, z))
    if isinstance(error, UnreachableError):
        error.index = tuple(np.argwhere(chosen.tolist())[0].tolist())
    return error


def is_tensor(value: object) -> bool:
    """Return whether a value is a tensor; torch is not imported for it."""
    return isinstance(value, getattr(sys.modules.get("torch"), "Tensor", ()))


def rotate(quaternion: Quaternion, vector: Vector) -> Vector:
    """Rotate a vector by a unit quaternion."""
    x, y, z, w = quaternion
    a, b, c = vector
    # v + w t + q x t, with t = 2 q x v
    s, t, u = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return (
        a + w * s + y * u - z * t,
        b + w * t + z * s - x * u,
        c + w * u + x * t - y * s,
    )


def _holds_masked(value: Any) -> bool:
    """Return whether a value is a masked array, or a sequence that holds one."""
    items = {type(item) for item in value} if isinstance(value, (list, tuple)) else {type(value)}
    return any(issubclass(kind, np.ma.MaskedArray) for kind in items)
