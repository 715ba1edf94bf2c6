"""Columns of a block of rows, for compiled loops; see :mod:`tpm_gym.mechanism.tpm.rows`."""

import math
from typing import Final

from tpm_gym.arrays import FloatArray
from tpm_gym.compiling import compilable
from tpm_gym.kinematics.equations import Triple

BLOCK: Final = 64
"""Rows of a block; their columns stay in the cache."""


def fill(built: FloatArray, start: int, count: int, each: int, own: FloatArray) -> None:
    """Fill the columns ``own`` with the machine parameters of the rows from ``start`` on.

    Where all rows are of one machine, the first block's columns serve all.
    """
    if start == 0 or len(built) > 1:
        for j in range(count):
            machine = (start + j) // each
            for k in range(len(own)):
                own[k, j] = built[machine, k]


def read(rows: FloatArray, start: int, count: int, columns: FloatArray, first: int) -> None:
    """Copy rows (count, 3) to the columns from ``first`` on."""
    for j in range(count):
        columns[first, j] = rows[start + j, 0]
        columns[first + 1, j] = rows[start + j, 1]
        columns[first + 2, j] = rows[start + j, 2]


def write(columns: FloatArray, first: int, start: int, count: int, rows: FloatArray) -> None:
    """Copy columns from ``first`` on to rows (m, 3) or (m, 3, 3)."""
    for j in range(count):
        for k in range(3):  # loops of constant length are unrolled
            if rows.ndim == 2:
                rows[start + j, k] = columns[first + k, j]
            else:
                for i in range(3):
                    rows[start + j, k, i] = columns[first + 3 * k + i, j]


def put(columns: FloatArray, first: int, j: int, values: Triple, real: bool) -> None:
    """Set three columns of a row, to NaN if there is no solution."""
    columns[first, j] = values[0] if real else math.nan
    columns[first + 1, j] = values[1] if real else math.nan
    columns[first + 2, j] = values[2] if real else math.nan


def get(columns: FloatArray, first: int, j: int) -> Triple:
    """Return three columns of a row."""
    return columns[first, j], columns[first + 1, j], columns[first + 2, j]


compilable(fill, read, write, put, get)
