"""A root finder that knows nothing of the mechanism, and how two sets of solutions compare.

It samples equations densely over an unknown angle, bisects every change of sign, and looks into
every extremum that comes near zero for a pair of roots between two samples.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import FloatArray

SAMPLES = 180
Rows = NDArray[np.int64]
Equation = Callable[[Rows, FloatArray], FloatArray]


def circle_roots(f: Equation, rows: int) -> tuple[Rows, FloatArray]:
    """All zeros on the circle of ``rows`` equations f(row, angle): rows and angles, by rows."""
    grid = np.linspace(-np.pi, np.pi, SAMPLES + 1)[:-1] + 0.001234
    step = 2 * np.pi / SAMPLES
    value = f(np.arange(rows)[:, None], np.broadcast_to(grid, (rows, SAMPLES)))
    after, before = np.roll(value, -1, axis=1), np.roll(value, 1, axis=1)
    row, sample = np.nonzero(np.sign(value) != np.sign(after))
    low = grid[sample]
    # An extremum that faces zero may hide two roots between samples: find it by a ternary search.
    facing = (np.abs(value) <= np.abs(before)) & (np.abs(value) <= np.abs(after))
    facing &= (np.sign(before) == np.sign(value)) & (np.sign(after) == np.sign(value))
    other, sample = np.nonzero(facing)
    start, sign = grid[sample] - step, np.sign(value[other, sample])
    left, right = start, start + 2 * step
    for _ in range(80):
        third = (right - left) / 3
        closer = sign * f(other, left + third) < sign * f(other, right - third)
        left, right = np.where(closer, left, left + third), np.where(closer, right - third, right)
    bottom = (left + right) / 2
    twice = sign * f(other, bottom) < 0
    pair, start, bottom = other[twice], start[twice], bottom[twice]
    row = np.concatenate([row, pair, pair])
    low = np.concatenate([low, start, bottom])
    high = np.concatenate([low[: len(row) - 2 * len(pair)] + step, bottom, start + 2 * step])
    first = np.sign(f(row, low))
    for _ in range(60):
        middle = (low + high) / 2
        same = np.sign(f(row, middle)) == first
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    order = np.argsort(row, kind="stable")
    return row[order], (low + high)[order] / 2


def unmatched(numeric: list[FloatArray], ours: list[FloatArray]) -> tuple[int, int, float]:
    """Inputs with another number of solutions, solutions compared, and the largest distance."""
    other, compared, worst = 0, 0, 0.0
    for roots, solutions in zip(numeric, ours, strict=True):
        other += len(roots) != len(solutions)
        if len(roots) == len(solutions) and len(roots):
            distance = np.abs(roots[:, None] - solutions).max(axis=-1)
            worst = max(worst, distance.min(axis=0).max(), distance.min(axis=1).max())
            compared += len(roots)
    return other, compared, worst


def unit(angle: FloatArray) -> FloatArray:
    """Angles (n, k) as points of circles (n, 2 k), so that 2 pi does not matter."""
    return np.concatenate([np.cos(angle), np.sin(angle)], axis=-1)
