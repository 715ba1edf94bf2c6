"""The simulation that most tests here look at."""

import pytest

from tpm_gym.simulation import Block, Scene, Simulation


@pytest.fixture
def simulation() -> Simulation:
    """The paper's machine over an empty table."""
    return Simulation(Scene())


@pytest.fixture
def with_block() -> Simulation:
    """The same with a block."""
    return Simulation(Scene(objects=(Block(),)))
