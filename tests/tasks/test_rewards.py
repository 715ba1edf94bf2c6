"""The reward terms: exact at their ends, steep where it matters, the same alone or in a batch."""

from typing import Any

import numpy as np
import pytest

from tpm_gym.arrays import FloatArray
from tpm_gym.mechanism.tpm import PAPER_TPM
from tpm_gym.simulation import compiled
from tpm_gym.tasks import Reach, dense

SAFE = 0.08
distance = Reach(PAPER_TPM).gap


def singularity_penalty(conditioning: Any, safe: float, passed: bool = False) -> FloatArray:
    c = np.atleast_1d(np.asarray(conditioning, dtype=float))
    never = np.zeros(c.shape, dtype=bool)
    return compiled.singularity_penalty(c, safe, never, never | passed)


def test_penalty_is_zero_where_it_is_safe_and_one_at_a_singularity() -> None:
    safe = np.linspace(SAFE, 1, 50)
    np.testing.assert_array_equal(singularity_penalty(safe, SAFE), 0)
    assert singularity_penalty(0.0, SAFE) == 1
    assert singularity_penalty(1.0, SAFE, passed=True) == 1
    assert singularity_penalty(SAFE / 2, SAFE) == pytest.approx(15 / 16)
    assert singularity_penalty(np.nextafter(SAFE, 0) - 1e-6, SAFE) > 0


@pytest.mark.parametrize("safe", [0.01, SAFE, 0.3, 1.0])
def test_penalty_falls_with_the_conditioning_steepest_at_the_threshold(safe: float) -> None:
    # Flat there, crossing it would cost nothing, and policies would not care.
    c = np.linspace(0, safe, 1001)
    slopes = -np.diff(singularity_penalty(c, safe)) / np.diff(c)
    assert (slopes >= 0).all()
    assert (np.diff(slopes) > -1e-9).all()
    assert slopes[-1] == pytest.approx(4 / safe, rel=2e-3)
    assert slopes[0] == pytest.approx(0, abs=1e-6 / safe)
    assert singularity_penalty(0.9 * safe, safe) > 0.3


def test_distance_is_euclidean_and_broadcasts() -> None:
    assert distance([1.0, 2.0, 2.0], [0.0, 0.0, 0.0]) == pytest.approx(3)
    batch = np.random.default_rng(1).normal(size=(6, 3))
    goal = np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(distance(batch, goal), np.linalg.norm(batch - goal, axis=1))
    np.testing.assert_array_equal(distance(batch, goal), distance(goal, batch))


def test_one_pair_is_as_far_apart_as_in_a_batch_to_the_last_bit() -> None:
    one, other = np.random.default_rng(0).normal(size=(2, 2000, 3)).astype(np.float32)
    single = [distance(a, b) for a, b in zip(one, other, strict=True)]
    np.testing.assert_array_equal(single, distance(one, other))


def test_sparse_is_zero_strictly_within_the_tolerance_and_minus_one_elsewhere() -> None:
    gaps = np.array([0.0, 0.0099, 0.01, 0.0101, 3.0, np.nan])
    found = Reach(PAPER_TPM).goal_term(gaps)
    np.testing.assert_array_equal(found, [0, 0, -1, -1, -1, -1])
    assert found.dtype == np.float64


def test_dense_is_minus_the_gap_in_units() -> None:
    np.testing.assert_allclose(dense([0.0, 0.1, 0.25]), [0, -1, -2.5])
    np.testing.assert_allclose(dense([0.0, 0.1, 0.25], unit=0.05), [0, -2, -5])
