"""Means with 95% intervals: of episodes, and of training runs; and the time a run takes to learn.

Scores of a handful of seeds are few and skewed: the interquartile mean leaves the luckiest and the
unluckiest quarter out, and its interval says how much another set of seeds might differ (Agarwal
et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice").
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Final

import numpy as np
from numpy.typing import NDArray

BOOTSTRAP_SAMPLES: Final = 5000
BOOTSTRAP_SEED: Final = 0  # fixed: the same values always give the same interval
LEARNED: Final = 0.95
"""Success rate from which a policy counts as having learned its task."""

_Z95: Final = 1.959963984540054  # 97.5% quantile of the standard normal distribution
_EPISODE_SAMPLES: Final = 2000
_EPISODE_BLOCK: Final = 100


@dataclass(frozen=True)
class Estimate:
    """A mean over episodes with its 95% interval.

    Attributes:
        mean: Sample mean.
        low: Lower end of the interval.
        high: Upper end of the interval.
        worst: The worst value of any step of any episode, where the metric has one.
    """

    mean: float
    low: float
    high: float
    worst: float | None = None

    def as_dict(self) -> dict[str, float]:
        """Return the estimate as plain data, without ``worst`` where there is none."""
        return {name: value for name, value in vars(self).items() if value is not None}


def wilson(outcomes: Sequence[bool]) -> Estimate:
    """Return a success rate with its 95% Wilson score interval (Wilson 1927)."""
    n = len(outcomes)
    rate = sum(outcomes) / n
    spread = _Z95**2 / n
    centre = (rate + spread / 2) / (1 + spread)
    half = _Z95 / (1 + spread) * math.sqrt(rate * (1 - rate) / n + spread / (4 * n))
    # At rates of 0 and 1 one end equals the rate but for rounding, which must not exclude the rate.
    return Estimate(rate, max(0.0, min(rate, centre - half)), min(1.0, max(rate, centre + half)))


def bootstrap(values: Sequence[float], worst: float | None = None) -> Estimate:
    """Return a mean with its 95% percentile bootstrap interval (Efron 1979)."""
    sample = np.asarray(values, dtype=np.float64)  # (n,)
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    # Not all resamples at once: with many episodes their matrix would not fit in memory.
    means = np.concatenate(
        [
            sample[rng.integers(0, sample.size, (_EPISODE_BLOCK, sample.size))].mean(axis=1)
            for _ in range(_EPISODE_SAMPLES // _EPISODE_BLOCK)
        ]
    )
    low, high = np.percentile(means, [2.5, 97.5])
    mean = float(sample.mean())
    # Equal values can differ from their mean by rounding; the interval must still hold the mean.
    return Estimate(mean, min(mean, float(low)), max(mean, float(high)), worst)


def interquartile_mean(scores: Sequence[float], samples: int = BOOTSTRAP_SAMPLES) -> Estimate:
    """Return the interquartile mean of runs with its 95% percentile bootstrap interval.

    The mean is that without the lowest and highest quarter, rounded down to whole scores: of five
    scores, that of the middle three.
    """
    values = np.asarray(scores, dtype=np.float64)  # (n,)
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    drawn = values[rng.integers(0, values.size, (samples, values.size))]  # (samples, n)
    low, high = np.percentile(_trimmed_means(drawn), [2.5, 97.5])
    mean = float(_trimmed_means(values[None])[0])
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
