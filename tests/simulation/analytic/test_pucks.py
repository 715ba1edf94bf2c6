"""Objects, cups and vacuum in batches: the laws of contact, and PyBullet's results."""

from __future__ import annotations

import numpy as np
import pytest

from tpm_gym.simulation.analytic.pucks import Pucks
from tpm_gym.simulation.state import Block

STEP = 1 / 250
PUCK = Block()


def over(z: float, count: int, steps: int = 10) -> np.ndarray:
    """A point P that stands over the middle."""
    return np.zeros((steps + 2, 3, count)) + np.array([0.0, 0.0, z])[:, None]


def test_what_stands_alone_keeps_its_bits_and_what_falls_comes_to_rest() -> None:
    pucks = Pucks(PUCK, 2, STEP)
    pucks.place(slice(None), np.array([[0.0, 0.0, 0.015], [0.1, 0.0, 0.2]]))
    for _ in range(15):
        pucks.advance(slice(None), over(0.3, 2), np.zeros(2, dtype=bool))
    before = pucks.report()
    assert before["object_position"][:, 0, 2] == pytest.approx([0.015, 0.015], abs=2e-5)
    pucks.advance(slice(None), over(0.3, 2), np.zeros(2, dtype=bool))
    for name, value in pucks.report().items():
        np.testing.assert_array_equal(value, before[name])
