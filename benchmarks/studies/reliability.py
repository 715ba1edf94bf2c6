"""Statistics over few seeds and several tasks (Agarwal et al. 2021, as in their package rliable).

rliable itself needs arch, statsmodels and seaborn; its interquartile mean and its stratified
bootstrap are these lines.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.learning.estimates import Estimate

_SEED: Final = 0  # fixed: the same scores always give the same interval
_SAMPLES: Final = 2000


def interquartile_mean(scores: Sequence[ArrayLike]) -> Estimate:
    """Return the mean of the middle half of all scores, with its 95% interval.

    Args:
        scores: Scores of the seeds of each task. May be infinite.
    """
    values = [np.asarray(task, np.float64) for task in scores]
    mean = float(middle(np.concatenate(values)))
    low, high = interval(middle(np.concatenate(resampled(values), axis=1)))
    return Estimate(mean, min(mean, float(low)), max(mean, float(high)))


def profile(scores: Sequence[ArrayLike], limits: ArrayLike) -> NDArray[Any]:
    """Return the share of all scores at or above each limit, (n,), and its interval: (3, n)."""
    values, edges = [np.asarray(task, np.float64) for task in scores], np.asarray(limits)
    share = (np.concatenate(values)[:, None] >= edges).mean(axis=0)
    shares = (np.concatenate(resampled(values), axis=1)[..., None] >= edges).mean(axis=1)
    return np.array([share, *interval(shares)])


def middle(values: NDArray[Any]) -> NDArray[Any]:
    """Return the mean without the lowest and the highest quarter, over the last axis."""
    cut = values.shape[-1] // 4
    kept: NDArray[Any] = np.sort(values)[..., cut : values.shape[-1] - cut]
    means: NDArray[Any] = kept.mean(axis=-1)
    return means


def resampled(values: Sequence[NDArray[Any]]) -> list[NDArray[Any]]:
    """Draw seeds with replacement within each task, (samples, seeds)."""
    rng = np.random.default_rng(_SEED)
    return [task[rng.integers(0, len(task), (_SAMPLES, len(task)))] for task in values]


def interval(samples: NDArray[Any]) -> NDArray[Any]:
    """Return the 2.5% and the 97.5% quantile over the first axis; samples may be infinite."""
    ends: NDArray[Any] = np.quantile(samples, [0.025, 0.975], axis=0, method="nearest")
    return ends
