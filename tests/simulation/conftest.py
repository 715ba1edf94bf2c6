"""Simulations that most tests here look at: PyBullet's, of one robot."""

import pytest
from alone import Alone

from tpm_gym.simulation import Block, Scene


@pytest.fixture
def simulation():
    """The paper's machine over an empty table."""
    return Alone()


@pytest.fixture
def with_block():
    """The same with a block."""
    return Alone(Scene(objects=(Block(),)))
