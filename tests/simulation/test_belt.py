"""The belt: objects on it move at its speed, equally in all engines."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from tpm_gym import PAPER_TPM
from tpm_gym.arrays import FloatArray
from tpm_gym.errors import ConfigurationError
from tpm_gym.simulation import Belt, Block, Scene, Simulation
from tpm_gym.simulation.stage import boards

ENGINES = ("pybullet", "mujoco", "analytic")
BELT = Belt(-0.6, 0.0)
SPEED = 0.2  # m/s
PERIOD = 0.04  # s
TALL, FLAT = 0.040, 0.030  # m; the lowest lip stops a tall block, and passes over a flat one

Steps = Sequence[tuple[tuple[float, float, float], int]]
"""Steps of P (m, world) in a control period, and their numbers."""


class Line:
    """A robot whose P begins at a point (3,) m, and blocks on its belt."""

    def __init__(
        self,
        engine: str,
        point: tuple[float, float, float],
        places: Sequence[tuple[float, float, float]],
        height: float = FLAT,
        speeds: Sequence[float] = (SPEED,),
    ) -> None:
        blocks = tuple(Block(f"block {k}", height=height) for k in range(len(places)))
        count = len(speeds)
        self.simulation = Simulation(Scene(objects=blocks, belt=BELT), engine=engine, count=count)
        theta = PAPER_TPM.require_inverse(PAPER_TPM.mount.to_paper(np.array(point)))
        objects = {b.name: np.tile(p, (count, 1)) for b, p in zip(blocks, places, strict=True)}
        self.simulation.reset(
            np.arange(count), theta, objects, belt_speed=np.array(speeds, dtype=float)
        )

    def run(self, steps: Steps, vacuum: bool = False) -> FloatArray:
        """Places of the first block after each control period, (k, n, 3) m."""
        places, simulation = [], self.simulation
        for step, count in steps:
            for _ in range(count):
                command = simulation.commands + PAPER_TPM.mount.rotate(np.array(step))
                simulation.move(command, np.full(len(command), vacuum))
                places.append(simulation.state().object_position[:, 0])
        return np.array(places)


STILL = (0.0, 0.0, 0.0)
SCENES: dict[str, tuple[dict[str, Any], Steps, bool]] = {
    "dropped from 5 mm": (
        {"point": (-0.1, -0.03, 0.15), "places": [(-0.3, -0.03, 0.02)]},
        [(STILL, 25)],
        False,
    ),
    "against the lip, which stops it": (
        {"point": (-0.1, -0.03, 0.067), "places": [(-0.3, -0.03, 0.02)], "height": TALL},
        [(STILL, 40)],
        False,
    ),
    "held by the cup on the belt, then above it": (
        {"point": (-0.1, -0.03, 0.07), "places": [(-0.1, -0.03, 0.015)]},
        [(STILL, 5), ((0.0, 0.0, 0.003), 5), (STILL, 10)],
        True,
    ),
    "picked while it moves": (
        {"point": (-0.14, -0.03, 0.085), "places": [(-0.15, -0.03, 0.015)]},
        [
            ((0.008, 0.0, 0.0), 5),
            ((0.008, 0.0, -0.005), 3),
            ((0.008, 0.0, 0.0), 5),
            ((0.008, 0.0, 0.01), 5),
            (STILL, 5),
        ],
        True,
    ),
}


@pytest.mark.parametrize("scene", SCENES)
def test_engines_agree_within_2_mm_where_a_block_is(scene: str) -> None:
    options, steps, vacuum = SCENES[scene]
    places = {engine: Line(engine, **options).run(steps, vacuum) for engine in ENGINES}
    for engine in ENGINES[1:]:
        np.testing.assert_allclose(places[engine], places["pybullet"], atol=2e-3, err_msg=engine)
    if vacuum:  # and the cup has it
        assert all(found[-1, 0, 2] > 0.025 for found in places.values())


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("speed", [0.02, SPEED, -SPEED])
def test_a_block_on_the_belt_moves_at_its_speed_within_1_percent(engine: str, speed: float) -> None:
    line = Line(engine, (-0.1, -0.03, 0.15), [(-0.3, -0.03, 0.015)], speeds=[speed])
    places = line.run([(STILL, 25)])[:, 0]
    state = line.simulation.state()
    np.testing.assert_allclose(state.belt_speed, [speed], rtol=0, atol=0)
    np.testing.assert_allclose(state.object_velocity[0, 0], [speed, 0, 0], atol=0.01 * abs(speed))
    way = places[-1] - places[4]
    np.testing.assert_allclose(
        way, [20 * PERIOD * speed, 0, 0], atol=0.01 * 20 * PERIOD * abs(speed)
    )


@pytest.mark.parametrize("engine", ENGINES)
def test_a_block_beside_the_belt_or_on_one_that_stands_still_rests(engine: str) -> None:
    for x, speed in ((0.05, SPEED), (-0.1, 0.0)):
        place = (x, -0.03, 0.015)
        line = Line(engine, (-0.1, -0.03, 0.15), [place], speeds=[speed])
        np.testing.assert_allclose(line.run([(STILL, 10)])[-1, 0], place, atol=1e-4)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_belt_that_ran_in_the_last_episode_stands_still(engine: str) -> None:
    place = (-0.3, -0.03, FLAT / 2)
    line = Line(engine, (-0.1, -0.03, 0.15), [place])
    line.run([(STILL, 10)])
    simulation = line.simulation
    theta = PAPER_TPM.require_inverse(simulation.commands)
    objects = {"block 0": np.array([place])}
    simulation.reset(np.arange(1), theta, objects)
    assert np.abs(line.run([(STILL, 10)]) - place).max() < 1e-3


def test_each_robot_has_a_speed_of_its_own_and_computes_as_it_does_alone() -> None:
    speeds, start = [0.05, 0.0, 0.2], [(-0.3, -0.03, 0.015)]
    together = Line("analytic", (-0.1, -0.03, 0.15), start, speeds=speeds).run([(STILL, 10)])
    for row, speed in enumerate(speeds):
        alone = Line("analytic", (-0.1, -0.03, 0.15), start, speeds=[speed]).run([(STILL, 10)])
        np.testing.assert_array_equal(together[:, row], alone[:, 0])


def test_impossible_belts_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="end"):
        Belt(0.1, 0.1)
    with pytest.raises(ConfigurationError, match="start"):
        boards((0.45, 0.3), Belt(-0.4, 0.0))
    with pytest.raises(ConfigurationError, match="end"):
        boards((0.45, 0.3), Belt(-0.5, 0.5))
    simulation = Simulation(Scene(), engine="analytic")
    with pytest.raises(ConfigurationError, match="no belt"):
        simulation.reset(np.arange(1), np.zeros(3), belt_speed=np.zeros(1))
