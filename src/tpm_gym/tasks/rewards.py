"""Reward terms as pure functions over any leading batch shape."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics.namespaces import Numbers

__all__ = ["dense", "distance", "singularity_penalty", "sparse"]


def distance(achieved: ArrayLike, desired: ArrayLike) -> Numbers:
    """Euclidean distance of points (..., k) m, as (...,) m; of one pair as a plain float."""
    one, other = np.asarray(achieved), np.asarray(desired)
    if one.ndim == other.ndim == 1:  # plain floats: numpy's calls cost more than they compute
        total = 0.0  # not by sum(), which rounds otherwise from Python 3.12 on
        for a, b in zip(one.tolist(), other.tolist(), strict=True):
            total += (a - b) * (a - b)
        return math.sqrt(total)
    gap = np.subtract(one, other, dtype=np.float64)
    first, *others = (gap * gap).T
    for part in others:  # numpy's sum costs several times as much
        first = first + part
    result: FloatArray = np.sqrt(first).T
    return result


def sparse(gap: Numbers, tolerance: float) -> Numbers:
    """0 where ``gap`` (m) is below ``tolerance`` (m), else -1, also where it is no number."""
    return -(1.0 - (gap < tolerance))


def dense(gap: ArrayLike, unit: float = 0.1) -> Numbers:
    """Minus ``gap`` (m) in units of ``unit`` (m), so that a typical error costs about 1."""
    if not isinstance(gap, float):  # which is fastest as it is
        gap = np.asarray(gap, dtype=np.float64)
    return -gap / unit


def singularity_penalty(conditioning: Numbers, safe: float) -> Numbers:
    """Nearness to a singularity: 1 - (conditioning / safe)^4, and 0 where conditioning >= safe.

    1 at a singularity, smooth down to the threshold, and steepest there, so that crossing it has a
    price: of a cubic step, flat at both ends, trained policies took no notice. (SAC on goals next
    to the threshold, joint increments: 24% of the time below it without a penalty, 19% with the
    cubic step, 1% with this.)

    Args:
        conditioning: (...,) 1/cond(J) in [0, 1].
        safe: Conditioning from which on the penalty is zero; positive.

    Returns:
        (...,) in [0, 1]; for a float a float.
    """
    share = conditioning / safe
    squared = share * share
    penalty = 1.0 - squared * squared
    return max(penalty, 0.0) if isinstance(penalty, float) else np.maximum(penalty, 0.0)
