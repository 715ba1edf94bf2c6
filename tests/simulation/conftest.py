"""The simulation that most tests here look at."""

from __future__ import annotations

import pytest

from tpm_gym.simulation import Block, Scene, Simulation


@pytest.fixture
def simulation() -> Simulation:
    """The paper's machine over an empty table."""
    return Simulation(Scene())


@pytest.fixture
def with_puck() -> Simulation:
    """The same with a puck."""
    return Simulation(Scene(objects=(Block(),)))
