"""Vector algebra on tuples of three floats, for compiled functions."""

from __future__ import annotations

import math
from typing import Any

from tpm_gym.arrays import Vector
from tpm_gym.compiling import compilable, compiled

Frame = tuple[Vector, Vector, Vector]
"""Axes of a body: three unit vectors, world frame."""
Symmetric = tuple[float, float, float, float, float, float]
"""Upper triangle of a symmetric matrix (3, 3), by rows."""


@compiled
def three(values: Any) -> Vector:
    """Return the first three elements of an array."""
    return values[0], values[1], values[2]


@compiled
def put(values: Any, vector: Vector) -> None:
    """Write a vector into the first three elements of an array."""
    values[0], values[1], values[2] = vector


@compiled
def plus(a: Vector, b: Vector, times: float = 1.0) -> Vector:
    """Return a + times * b."""
    return a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2]


@compiled
def dot(a: Vector, b: Vector) -> float:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a: Vector, b: Vector) -> Vector:
    """Return the vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def onto(start: Vector, matrices: Any, row: int, a: Vector, sign: float = 1.0) -> Vector:
    """Return ``start + sign * matrices[row] @ a``; ``matrices`` is an array (n, 3, 3)."""
    x, y, z = a[0] * sign, a[1] * sign, a[2] * sign
    m = matrices
    return (
        start[0] + m[row, 0, 0] * x + m[row, 0, 1] * y + m[row, 0, 2] * z,
        start[1] + m[row, 1, 0] * x + m[row, 1, 1] * y + m[row, 1, 2] * z,
        start[2] + m[row, 2, 0] * x + m[row, 2, 1] * y + m[row, 2, 2] * z,
    )


def row_of(values: Any, row: int) -> Vector:
    """Return row ``row`` of an array (n, 3), faster than ``three(values[row])``."""
    return values[row, 0], values[row, 1], values[row, 2]


def page_row(values: Any, page: int, row: int) -> Vector:
    """Return a row of an array (k, n, 3)."""
    return values[page, row, 0], values[page, row, 1], values[page, row, 2]


def put_page_row(values: Any, page: int, row: int, vector: Vector) -> None:
    """Write a vector into a row of an array (k, n, 3)."""
    values[page, row, 0], values[page, row, 1], values[page, row, 2] = vector


def put_row(values: Any, row: int, vector: Vector) -> None:
    """Write a vector into a row of an array (n, 3)."""
    values[row, 0], values[row, 1], values[row, 2] = vector


def spread(matrix: Symmetric, a: Vector) -> Vector:
    """Return the product of a matrix and a vector."""
    p, q, r, s, t, u = matrix
    x, y, z = a
    return p * x + q * y + r * z, q * x + s * y + t * z, r * x + t * y + u * z


def inverted(matrix: Symmetric) -> Symmetric:
    """Return the inverse of a matrix."""
    a, b, c, d, e, f = matrix
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1 / (a * p + b * q + c * r)
    return (
        p * scale, q * scale, r * scale,
        (a * f - c * c) * scale, (b * c - a * e) * scale, (a * d - b * b) * scale,
    )  # fmt: skip


def solved(matrix: Symmetric, right: Vector) -> Vector:
    """Return the solution x of ``matrix @ x = right``."""
    return spread(inverted(matrix), right)


compilable(onto, page_row, put_page_row, row_of, put_row, spread, inverted, solved)


@compiled
def length(a: Vector) -> float:
    """Return the Euclidean length."""
    return math.sqrt(dot(a, a))


@compiled
def level_length(x: float, y: float) -> float:
    """Return the length of a horizontal vector, with equal bits on all computers.

    ``math.hypot`` may differ in the last bit between computers.
    """
    return math.sqrt(x * x + y * y)


@compiled
def clip(value: float, low: float, high: float) -> float:
    """Clip a number to an interval."""
    return min(max(value, low), high)


@compiled
def axes(quaternion: Any) -> Frame:
    """Return the axes of a body from its orientation quaternion (x, y, z, w)."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )
