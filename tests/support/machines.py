"""The machines that properties are shown for, and places and motions all over their regions."""

from collections.abc import Iterator
from operator import attrgetter

import numpy as np
import pytest
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.mechanism import PAPER_TPM, WIDE_TPM, Machine

each_machine = pytest.mark.parametrize("machine", [PAPER_TPM, WIDE_TPM], ids=attrgetter("name"))


def anywhere(machine: Machine, count: int, seed: int = 0) -> list[Vector]:
    """Points P all over the region, m, machine's frame."""
    region, rng = machine.region, np.random.default_rng(seed)
    return [(x, y, z) for x, y, z in rng.uniform(region.low, region.high, (count, 3)).tolist()]


def within(machine: Machine, shares: ArrayLike) -> FloatArray:
    """The point (3,) of the region at these shares of its edges, m, machine's frame."""
    low, high = np.array(machine.region.low), np.array(machine.region.high)
    return machine.region.project(low + np.array(shares) * (high - low))


def excursions(machine: Machine, count: int, seed: int) -> Iterator[FloatArray]:
    """Commands from home at full speed over the whole region, m."""
    rng, command = np.random.default_rng(seed), np.array(machine.home)
    for _ in range(count):
        command = machine.region.project(command + rng.choice([-1, 0, 1], 3) * machine.step_limit)
        yield command
