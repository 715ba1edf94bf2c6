"""Compiled checks of points in boxes. Importing this module imports Numba."""

from tpm_gym.arrays import FloatArray
from tpm_gym.compiling import kept

__all__ = ["all_within"]


@kept
def all_within(points: FloatArray, low: FloatArray, high: FloatArray) -> bool:
    """Return whether all points (m, 3) are in the box between low and high (3,); NaN is not."""
    for row in range(len(points)):
        for axis in range(3):
            if not low[axis] <= points[row, axis] <= high[axis]:
                return False
    return True
