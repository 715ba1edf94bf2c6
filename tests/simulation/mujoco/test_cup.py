"""The vacuum cup in MuJoCo takes, holds, lets go, and never presses harder than its spring."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from alone import Alone
from inside_mujoco import around_each_step, on_object, push
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray
from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.mechanism.cup import CUP
from tpm_gym.simulation import Block, Plant, Scene, State
from tpm_gym.simulation.mujoco.model import object_name

PLACE = np.array([-0.04, 0.028])  # x, y of the block and of P, machine's frame
G = 9.81


def level(height: float) -> FloatArray:
    """Point P (machine's frame) with the lip at ``height`` above the table."""
    return np.array([*PLACE, PAPER_TPM.mount.height - height - CUP.length])


def start(
    offset: ArrayLike = (0.0, 0.0), height: float = 0.10, plant: Plant | None = None
) -> Alone:
    simulation = Alone(Scene(objects=(Block(),)), engine="mujoco")
    x, y = np.array((1, -1)) * PLACE + offset
    theta = PAPER_TPM.inverse(tuple(level(height)))
    simulation.reset(theta, {"object": (x, y, 0.015)}, plant=plant or Plant())
    return simulation


def go(simulation: Alone, height: float, steps: int, vacuum: bool) -> State:
    for _ in range(steps):
        state = simulation.move(level(height), vacuum)
    return state


def start_holding(**options: Any) -> Alone:
    """The block is sealed to the cup at full vacuum, in the air and at rest."""
    simulation = start(height=0.05, **options)
    go(simulation, 0.0295, 6, vacuum=False)
    go(simulation, 0.0295, 6, vacuum=True)
    for height in (0.04, 0.05, 0.06, *[0.07] * 5):
        state = go(simulation, height, 1, vacuum=True)
    assert state.held == 0
    assert state.vacuum == pytest.approx(CUP.vacuum, rel=1e-3)
    return simulation


def slide(simulation: Alone) -> float:
    engine: Any = simulation.engine
    position: float = engine.data.joint("cup_slide").qpos.item()
    return position


def last(simulation: Alone, read: Callable[[], Any], vacuum: bool) -> Any:
    """What ``read`` says in the last time step of a control period in which the robot stays."""
    said: list[Any] = []
    with around_each_step(simulation, solved=lambda: said.append(read())):
        simulation.move(PAPER_TPM.mount.to_paper(simulation.read().command), vacuum)
    return said[-1]


def test_it_takes_what_it_touches_lifts_it_and_lets_go() -> None:
    simulation = start(height=0.05)
    assert go(simulation, 0.04, 3, vacuum=True).held == -1  # 10 mm above: nothing to suck on
    assert go(simulation, 0.03, 4, vacuum=True).held == 0
    go(simulation, 0.06, 8, vacuum=True)
    lifted = go(simulation, 0.09, 8, vacuum=True)
    assert lifted.held == 0
    assert lifted.object_position[0, 2] == pytest.approx(0.075, abs=2e-3)
    assert go(simulation, 0.09, 2, vacuum=False).held == -1
    dropped = go(simulation, 0.09, 15, vacuum=False)
    assert dropped.vacuum < 1.0
    assert dropped.object_position[0, 2] == pytest.approx(0.015, abs=1e-4)


def test_what_was_pressed_is_sealed_without_penetration_and_does_not_jump() -> None:
    simulation = start(offset=(0.006, 0.004), height=0.05)
    before = go(simulation, 0.025, 4, vacuum=False)  # pressed
    after = go(simulation, 0.025, 2, vacuum=True)
    assert after.held == 0
    assert np.linalg.norm(after.object_position - before.object_position) < 0.02e-3
    lip = simulation.engine.robot.cup()[0][2]  # type: ignore[attr-defined]
    assert lip - 0.030 == pytest.approx(0.02e-3, abs=5e-6)  # clear of the face


def test_a_held_block_at_rest_hangs_by_its_weight_alone() -> None:
    simulation = start_holding()
    engine: Any = simulation.engine
    tension, shear = last(simulation, engine._cup.load, vacuum=True)
    assert tension == pytest.approx(Block().mass * G, rel=1e-3)
    assert shear < 1e-3
    assert (
        last(simulation, lambda: -on_object(simulation)[2], vacuum=True) == 0.0
    )  # the weld takes the contact's place


def test_a_held_block_stays_put_at_full_speed() -> None:
    simulation = start_holding()
    state = simulation.read()
    grip, point = state.object_position - state.platform_position, level(0.07)
    for step in (1, 1, 1, -1, -1, -1, 1, -1, 1, -1):
        point = point + (0.03 * step, 0.0, -0.02 * step)
        state = simulation.move(point, vacuum=True)
        assert state.held == 0
        moved = state.object_position - state.platform_position - grip
        assert np.linalg.norm(moved) < 0.1e-3
    assert state.closure_error < 0.06e-3


DIRECTIONS = [(0, 0, -1), (1, 0, 0), (0, 1, 0), (1, 0, -1), (-1, 1, -1)]


@pytest.mark.parametrize("direction", DIRECTIONS, ids=str)
def test_it_is_pulled_off_at_twelve_newtons_in_any_direction(direction: Any) -> None:
    simulation = start_holding()
    unit, weight = direction / np.linalg.norm(direction), np.array((0, 0, -Block().mass * G))
    for newtons in np.arange(11.0, 13.0, 0.1):
        push(simulation, object_name(0), newtons * unit - weight)
        if simulation.move(level(0.07), vacuum=True).held < 0:
            break
    assert newtons == pytest.approx(CUP.vacuum * CUP.area, rel=0.02)


def test_too_heavy_a_block_is_lost_when_it_is_jerked_up() -> None:
    simulation = start(height=0.05, plant=Plant(block_mass=10.0))
    go(simulation, 0.0295, 8, vacuum=True)
    assert go(simulation, 0.031, 4, vacuum=True).held == 0
    state = simulation.read()
    for height in (0.061, 0.091, 0.121, 0.151):
        state = simulation.move(level(height), vacuum=True)
    assert state.held == -1


@pytest.mark.parametrize("speed", [0.005, 0.03])  # m a control period; the second is full speed
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.012, 0.012)])
def test_the_cup_yields_to_the_block_at_its_preload(speed: float, offset: Any) -> None:
    simulation, rows = start(offset=offset, height=0.06), []
    engine: Any = simulation.engine

    def note() -> None:
        height = engine._scenery.read()[0][0].position[2]
        rows.append((slide(simulation), height))

    with around_each_step(simulation, after=note):
        for height in np.arange(0.06, 0.012, -speed):
            simulation.move(level(height))
        state = go(simulation, 0.012, 10, vacuum=False)  # 18 mm below the top of the block
    slides, heights = np.transpose(rows)
    assert slides.min() == pytest.approx(-0.018, abs=0.02e-3)
    assert slides[-1] == pytest.approx(-0.018, abs=0.01e-3)
    assert (abs(heights - 0.015) < 5e-6).all()
    assert np.allclose(state.object_quaternion, (0, 0, 0, 1), atol=1e-3)
    weight = PAPER_TPM.mechanism.link("cup").mass * G
    force = last(simulation, lambda: -on_object(simulation)[2], vacuum=False)
    assert force == pytest.approx(CUP.preload + weight, rel=1e-3)


@pytest.mark.parametrize("direction", np.radians(np.arange(0, 360, 45)))
def test_a_pressed_cup_that_slides_pulls_with_mu_n_along_its_slip(direction: float) -> None:
    simulation, forces = start(height=0.05), []
    go(simulation, 0.022, 6, vacuum=False)
    along = np.array([np.cos(direction), np.sin(direction), 0.0])
    with around_each_step(simulation, solved=lambda: forces.append(on_object(simulation))):
        for index in range(1, 9):
            simulation.move(level(0.022) + 0.001 * index * along)
    force = np.mean(forces[20:], axis=0)
    slip = PAPER_TPM.mount.rotate(along)
    weight = PAPER_TPM.mechanism.link("cup").mass * G
    expected = CUP.friction * Block().friction * (CUP.preload + weight)
    np.testing.assert_allclose(force[:2], expected * slip[:2], atol=0.01 * expected)


def test_the_cup_comes_out_again_and_stays_out_in_free_motion() -> None:
    simulation, slides = start(height=0.05), []
    go(simulation, 0.015, 8, vacuum=False)
    assert slide(simulation) == pytest.approx(-0.015, abs=0.02e-3)
    go(simulation, 0.08, 10, vacuum=False)
    with around_each_step(simulation, after=lambda: slides.append(abs(slide(simulation)))):
        for height in (0.11, 0.14, 0.17, 0.14, 0.11, 0.14, 0.11):
            simulation.move(level(height))
    assert max(slides) < 1e-5


def test_beyond_its_stroke_the_cup_stops_and_the_block_holds() -> None:
    simulation = start(height=0.05)
    state = go(simulation, 0.006, 12, vacuum=False)  # 24 mm below the top, 4 mm beyond the stroke
    assert slide(simulation) == pytest.approx(-CUP.stroke, abs=0.5e-3)  # motors at their limit
    assert state.object_position[0, 2] == pytest.approx(0.015, abs=0.1e-3)
    assert state.closure_error < 1e-5


@pytest.mark.parametrize("steps", [1, 3, 8])
def test_a_moment_of_any_pressure_is_gone_back_to_exactly(steps: int) -> None:
    simulation = start(height=0.05)
    for index in range(4 + steps):
        simulation.move(level(0.0295), vacuum=index >= 4)
    moment = simulation.save()
    ends = []
    for _ in range(2):
        state = simulation.restore(moment)
        for height, vacuum in ((0.04, True), (0.06, True), (0.06, False), (0.08, True)):
            state = simulation.move(level(height), vacuum)
        ends.append({name: np.asarray(value).tobytes() for name, value in vars(state).items()})
    assert ends[0] == ends[1]


def test_a_reset_while_holding_lets_go() -> None:
    simulation = start_holding()
    theta = PAPER_TPM.inverse(tuple(level(0.1)))
    state = simulation.reset(theta, {"object": (0.0, -0.03, 0.015)})
    assert (state.held, state.vacuum) == (-1, 0.0)
    state = go(simulation, 0.1, 5, vacuum=True)
    assert np.allclose(state.object_position, (0.0, -0.03, 0.015), atol=1e-5)
