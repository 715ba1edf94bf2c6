"""When the cup seals: the whole lip on the block's top, near it, and not askew."""

import math
from itertools import product

import numpy as np
import pytest
from walk import turn

from tpm_gym.arrays import rotate
from tpm_gym.mechanism.cup import CUP, sealed

SIZE = WIDTH, HEIGHT = 0.036, 0.030
CENTRE = (0.1, -0.2, 0.3)
DOWN = (0.0, 0.0, -1.0)
REACH = WIDTH / 2 - CUP.radius


def test_the_vacuum_pulls_with_60_kpa_on_the_lip_and_less_than_the_spring():
    pull_off = CUP.vacuum * CUP.area
    assert pull_off == pytest.approx(60e3 * np.pi * CUP.radius**2, rel=0.02)
    assert pull_off < CUP.preload  # or a heavy block would pull the cup out


def lies(offset: tuple[float, float, float], tilt: float = 0.0, yaw: float = 0.0) -> bool:
    """Whether the cup seals with its lip ``offset`` from the top, in a block that is turned."""
    (s, c), (z, w) = ((math.sin(angle / 2), math.cos(angle / 2)) for angle in (tilt, yaw))
    quaternion = (s * w, -s * z, c * z, c * w)  # about its own axis, then about the world's x
    top = rotate(quaternion, (0.0, 0.0, HEIGHT / 2))
    assert np.allclose(top, turn((1, 0, 0), tilt) @ (0, 0, HEIGHT / 2))
    lip = np.add(CENTRE, top) + rotate(quaternion, offset)
    return sealed(tuple(lip.tolist()), DOWN, CENTRE, quaternion, SIZE)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.0])
def test_it_seals_where_the_whole_lip_is_covered_and_near(yaw):
    for x, y, gap in product((-1.01, -0.99, 0.0, 0.99, 1.01), repeat=3):
        expected = max(abs(x), abs(y), abs(gap)) < 1
        assert lies((x * REACH, y * REACH, gap * CUP.seal_gap), yaw=yaw) is expected


@pytest.mark.parametrize("share", [-1.01, -0.99, 0.0, 0.99, 1.01])
def test_it_seals_on_blocks_that_lean_as_far_as_the_lip_follows(share):
    assert lies((0.0, 0.0, 0.0), tilt=share * CUP.seal_tilt, yaw=0.3) is (abs(share) < 1)
    assert not lies((0.0, 0.0, 0.0), tilt=math.pi)  # the underside
