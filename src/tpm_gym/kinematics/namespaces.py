"""Elementwise functions of numpy arrays and torch tensors, for the equations.

The functions of :mod:`tpm_gym.kinematics.equations` call the functions of a :class:`Namespace`, so
that they work with arrays and with tensors. Tensors have gradients and work on GPUs.
:mod:`tpm_gym.kinematics.compiled` is the namespace for compiled code.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from tpm_gym.arrays import FloatArray, is_tensor

Numbers = Any
"""A float, an array (...,) or a tensor (...,): an argument of a namespace's functions."""
_One = Callable[[Any], Any]
_TURN = 2 * math.pi
_BLOCK = 4096  # rows computed at a time, so that intermediate results stay in the cache


@dataclass(frozen=True)
class Namespace:
    """Elementwise functions of one kind of numbers.

    Attributes:
        root: Square root; 0 for negative numbers.
        clip: Nearest number in [-1, 1].
        arccos: Arccosine of the clipped number.
        arcsin: Arcsine of the clipped number.
        cos_third: Cosine of a third of the arccosine of the clipped number.
        positive: Angle in [0, 2 pi) from an angle in [-pi, pi].
        signs: Array or tensor with the two elements -1 and 1, from arguments (x, shape). Its shape
            is ``shape``, such as (2, 1). A tensor has the type and the device of ``x``.
        stack: Components (...,) joined along a new last axis.
        join: Points (..., 3) broadcast with each other, and joined along their last axis.
        solve: Solutions of linear systems (..., k, k) for right sides (..., k).
    """

    cos: _One
    sin: _One
    arctan2: Callable[[Any, Any], Any]
    sqrt: _One
    root: _One
    clip: _One
    arccos: _One
    arcsin: _One
    cos_third: _One
    maximum: Callable[[Any, float], Any]
    where: Callable[[Any, Any, Any], Any]
    positive: _One
    signs: Callable[[Any, tuple[int, ...]], Any]
    stack: Callable[[Sequence[Any]], Any]
    join: Callable[[Sequence[Any]], Any]
    solve: Callable[[Any, Any], Any]


def namespace_of(*values: object) -> Namespace:
    """Return the namespace of tensors if an argument is a tensor, else the namespace of arrays."""
    return _torch() if any(map(is_tensor, values)) else NUMPY


def _clip(x: Any) -> Any:
    return np.minimum(np.maximum(x, -1.0), 1.0)


NUMPY = Namespace(
    cos=np.cos,
    sin=np.sin,
    arctan2=np.arctan2,
    sqrt=np.sqrt,
    root=lambda x: np.sqrt(np.maximum(x, 0.0)),
    clip=_clip,
    arccos=lambda x: np.arccos(_clip(x)),
    arcsin=lambda x: np.arcsin(_clip(x)),
    cos_third=lambda x: np.cos(np.arccos(_clip(x)) / 3.0),
    maximum=np.maximum,
    where=np.where,
    positive=lambda x: np.where(x < 0, x + _TURN, x),
    signs=lambda like, shape: np.array([-1.0, 1.0]).reshape(shape),
    stack=lambda columns: np.stack(columns, axis=-1),
    join=lambda points: np.concatenate(np.broadcast_arrays(*points), axis=-1),
    solve=lambda matrix, right: np.linalg.solve(matrix, right[..., None])[..., 0],
)


@cache
def _torch() -> Namespace:
    """Return the namespace for tensors.

    Infinite derivatives are set to 0. Otherwise, an infinite derivative in one branch of the
    kinematics would make the derivatives of the other branches NaN, as PyTorch multiplies it by 0.
    """
    import torch  # here, since torch is optional

    def like(x: Any, other: Any) -> Any:
        return torch.as_tensor(x, dtype=other.dtype, device=other.device)

    def root(x: Any, none: Any) -> Any:
        return torch.where(none, 0.0, torch.where(none, 1.0, x).sqrt())

    def arccos(x: Any) -> Any:
        end = abs(x) >= 1
        return torch.where(end, like(math.pi, x) * (x < 0), torch.where(end, 0.0, x).arccos())

    def join(points: Sequence[Any]) -> Any:
        tensor = next(point for point in points if is_tensor(point))
        shape = np.broadcast_shapes(*(tuple(point.shape) for point in points))
        return torch.cat([like(point, tensor).expand(shape) for point in points], -1)

    return Namespace(
        cos=torch.cos,
        sin=torch.sin,
        arctan2=lambda y, x: torch.arctan2(y, like(x, y)),
        sqrt=lambda x: root(x, x == 0),
        root=lambda x: root(x, x <= 0),
        clip=lambda x: torch.clip(x, -1.0, 1.0),
        arccos=arccos,
        arcsin=lambda x: math.pi / 2 - arccos(x),
        cos_third=lambda x: torch.cos(arccos(x) / 3.0),
        maximum=lambda x, least: torch.clip(x, min=least),
        where=torch.where,
        positive=lambda x: torch.where(x < 0, x + _TURN, x),
        signs=lambda other, shape: like([-1.0, 1.0], other).reshape(shape),
        stack=lambda columns: torch.stack(list(columns), -1),
        join=join,
        solve=torch.linalg.solve,
    )


def by_rows(
    text: Callable[[Any, Namespace], Sequence[Numbers]], points: FloatArray
) -> list[FloatArray]:
    """Evaluate the equations in the function ``text`` for points (..., k), in blocks of n points.

    ``text`` takes two arguments: a tuple of the k components of a block's points, each an array
    (n,); and the namespace. Each result of ``text`` is a column (n,), a tuple of q columns, or a
    tuple of p such tuples.

    Returns:
        For each result of ``text``, an array for all points: (...,) for a column, (..., q) for a
        tuple of q columns, (..., p, q) for a tuple of p such tuples.
    """
    ns, shape = namespace_of(points), points.shape[:-1]
    flat = points.reshape(-1, points.shape[-1])
    step = _BLOCK if ns is NUMPY else max(1, len(flat))
    blocks = []
    with np.errstate(all="ignore"):
        for start in range(0, max(1, len(flat)), step):
            columns = flat[start : start + step].T
            if ns is NUMPY:
                columns = np.ascontiguousarray(columns)
            results = text(tuple(columns), ns)
            blocks.append([ns.stack([*_columns(result)]) for result in results])
    tables = [
        parts[0] if len(parts) == 1 else np.concatenate(parts)
        for parts in zip(*blocks, strict=True)
    ]
    return [
        table.reshape((*shape, *_axes(result)))
        for table, result in zip(tables, results, strict=True)
    ]


def _columns(result: Numbers) -> Iterator[Numbers]:
    if isinstance(result, tuple):
        for part in result:
            yield from _columns(part)
    else:
        yield result


def _axes(result: Numbers) -> tuple[int, ...]:
    return (len(result), *_axes(result[0])) if isinstance(result, tuple) else ()
