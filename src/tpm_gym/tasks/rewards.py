"""Reward terms as pure functions over any leading batch shape."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray

__all__ = ["dense", "distance", "singularity_penalty", "sparse"]


def distance(achieved: ArrayLike, desired: ArrayLike) -> FloatArray:
    """Return the Euclidean distance (...,) m of points (..., k) m."""
    gap: Any = np.subtract(achieved, desired, dtype=np.float64)
    parts = [*(gap * gap).T]
    result: FloatArray = np.sqrt(sum(parts[1:], parts[0])).T  # numpy's sum costs several times more
    return result


def sparse(gap: FloatArray, tolerance: float) -> FloatArray:
    """Return 0 where ``gap`` (m) is below ``tolerance`` (m), else -1, also where it is NaN."""
    return np.where(gap < tolerance, 0.0, -1.0)


def dense(gap: ArrayLike, unit: float = 0.1) -> FloatArray:
    """Return minus ``gap`` (m) in units of ``unit`` (m), so that a typical error costs about 1."""
    reward: FloatArray = np.asarray(gap, dtype=np.float64) / -unit
    return reward


def singularity_penalty(conditioning: FloatArray, safe: float) -> FloatArray:
    """Return 1 - (conditioning / safe)^4, and 0 where conditioning >= safe, (...,) in [0, 1].

    The penalty is 1 at a singularity, smooth down to the threshold, and steepest there, so that
    crossing the threshold has a price. Trained policies ignored a cubic step, which is flat at both
    ends: SAC on goals next to the threshold, joint increments, spent 24% of the time below it
    without a penalty, 19% with the cubic step, 1% with this.

    Args:
        conditioning: (...,) 1/cond(J) in [0, 1].
        safe: Conditioning from which on the penalty is zero; positive.
    """
    share = conditioning / safe
    squared = share * share
    return np.maximum(1.0 - squared * squared, 0.0)
