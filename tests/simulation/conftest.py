"""The simulation that most tests here look at."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tpm_gym.simulation import Block, Scene, Simulation


@pytest.fixture
def simulation() -> Iterator[Simulation]:
    """The paper's machine over an empty table."""
    simulation = Simulation(Scene())
    yield simulation
    simulation.close()


@pytest.fixture
def with_puck() -> Iterator[Simulation]:
    """The same with a puck."""
    simulation = Simulation(Scene(objects=(Block(),)))
    yield simulation
    simulation.close()
