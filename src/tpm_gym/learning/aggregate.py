"""Statistics over training runs: interquartile means with bootstrap intervals, and time to learn.

Scores of a handful of seeds are few and skewed: the interquartile mean leaves the luckiest and the
unluckiest quarter out, and its interval says how much another set of seeds might differ (Agarwal
et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice").
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tpm_gym.learning.rollout import Estimate

BOOTSTRAP_SAMPLES: Final = 5000
BOOTSTRAP_SEED: Final = 0  # fixed: the same scores always give the same interval
LEARNED: Final = 0.95
"""Success rate from which a policy counts as having learned its task."""


def interquartile_mean(scores: Sequence[float]) -> float:
    """Mean of the scores without the lowest and highest quarter, rounded down to whole scores.

    Of five scores, that is the mean of the middle three.

    Args:
        scores: One score a run, at least one.
    """
    return float(_trimmed_means(np.asarray(scores, dtype=np.float64)[None])[0])


def interquartile_mean_interval(
    strata: Sequence[Sequence[float]],
    samples: int = BOOTSTRAP_SAMPLES,
    seed: int = BOOTSTRAP_SEED,
) -> Estimate:
    """Interquartile mean of all scores, with its 95% stratified percentile bootstrap interval.

    Runs are drawn with replacement among those of the same stratum, so that every resample has as
    many runs of each environment as there are.

    Args:
        strata: The scores of each environment, a run each, at least one in all.
        samples: Number of resamples.
        seed: Seed of the resampling.
    """
    rng = np.random.default_rng(seed)
    arrays = [np.asarray(scores, dtype=np.float64) for scores in strata if len(scores) > 0]
    drawn = [scores[rng.integers(0, scores.size, (samples, scores.size))] for scores in arrays]
    low, high = np.percentile(_trimmed_means(np.concatenate(drawn, axis=1)), [2.5, 97.5])
    mean = interquartile_mean(np.concatenate(arrays).tolist())
    # Equal scores can differ from their mean by rounding; the interval must still hold the mean.
    return Estimate(mean, min(mean, float(low)), max(mean, float(high)))


def _trimmed_means(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Interquartile means of the rows of (m, n), as (m,)."""
    count = rows.shape[1]
    cut = count // 4
    means: NDArray[np.float64] = np.sort(rows, axis=1)[:, cut : count - cut].mean(axis=1)
    return means


def settled(successes: Sequence[float], rate: float = LEARNED) -> int | None:
    """Index of the first evaluation from which success stays at ``rate`` or above to the end.

    Args:
        successes: Success rates of the evaluations during training, in order.
        rate: The rate to be kept.

    Returns:
        The index; None where the last evaluation is below, or there is none.
    """
    found = None
    for index in reversed(range(len(successes))):
        if successes[index] < rate - 1e-9:
            break
        found = index
    return found


def median_time(times: Sequence[float | None]) -> float | None:
    """Median over runs, where None is a run that never got there: later than any other.

    Returns:
        The median; None where it falls on a run that never got there.
    """
    value = median(math.inf if time is None else time for time in times)
    return value if math.isfinite(value) else None
