"""Means over episodes with 95% intervals."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

_Z95: Final = 1.959963984540054  # 97.5% quantile of the standard normal distribution
_SEED: Final = 0  # fixed: the same values always give the same interval
_SAMPLES: Final = 2000
_BLOCK: Final = 100


@dataclass(frozen=True)
class Estimate:
    """Mean over episodes with its 95% interval."""

    mean: float
    low: float
    high: float
    worst: float | None = None
    """Worst value of all steps of all episodes, if the metric has one."""

    def as_dict(self) -> dict[str, float]:
        """Return the estimate as plain data, without ``worst`` if there is none."""
        return {name: value for name, value in vars(self).items() if value is not None}


def wilson(outcomes: Sequence[bool]) -> Estimate:
    """Return the share of True outcomes with its 95% Wilson score interval (Wilson 1927)."""
    n = len(outcomes)
    rate = sum(outcomes) / n
    spread = _Z95**2 / n
    centre = (rate + spread / 2) / (1 + spread)
    half = _Z95 / (1 + spread) * math.sqrt(rate * (1 - rate) / n + spread / (4 * n))
    # Rounding must not exclude rates of 0 and 1.
    return Estimate(rate, max(0.0, min(rate, centre - half)), min(1.0, max(rate, centre + half)))


def bootstrap(values: Sequence[float], worst: float | None = None) -> Estimate:
    """Return the mean of values with its 95% percentile bootstrap interval (Efron 1979).

    ``worst`` becomes the attribute ``worst`` of the estimate.
    """
    sample = np.asarray(values, dtype=np.float64)  # (n,)
    rng = np.random.default_rng(_SEED)
    # In blocks, since the matrix of all resamples of many values does not fit in memory.
    means = [
        sample[rng.integers(0, sample.size, (_BLOCK, sample.size))].mean(axis=1)
        for _ in range(_SAMPLES // _BLOCK)
    ]
    low, high = np.percentile(np.concatenate(means), [2.5, 97.5])
    mean = float(sample.mean())
    # Equal values can differ from their mean by rounding; the interval must contain the mean.
    return Estimate(mean, min(mean, float(low)), max(mean, float(high)), worst)
