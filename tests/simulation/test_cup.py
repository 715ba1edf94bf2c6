"""The vacuum cup takes, holds, lets go, and never presses harder than its spring."""

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from alone import PLACE, SPRUNG, Alone, level
from inside import around_each_step, from_cup, place_of, push, slide
from numpy.typing import ArrayLike

from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.mechanism.cup import CUP
from tpm_gym.simulation import Block, Plant, Scene, State
from tpm_gym.simulation.randomisation import NOMINAL

G = 9.81
each_engine = pytest.mark.parametrize("engine", ["pybullet", "mujoco", "analytic"])
inside_engines = pytest.mark.parametrize("engine", ["pybullet", "mujoco"])


def start(
    engine: str,
    height: float = 0.05,
    offset: ArrayLike = (0.0, 0.0),
    plant: Plant = NOMINAL,
    **of_block: Any,
) -> Alone:
    """A block below the cup, ``offset`` m off its middle."""
    simulation, block = Alone(Scene((Block(**of_block),)), engine=engine), Block(**of_block)
    place = (*((1, -1) * PLACE + offset), block.height / 2)
    simulation.reset(PAPER_TPM.inverse(level(height)), {block.name: place}, plant=plant)
    return simulation


def go(simulation: Alone, height: float, steps: int, vacuum: bool) -> State:
    for _ in range(steps):
        state = simulation.move(level(height), vacuum)
    return state


def holding(engine: str, **options: Any) -> Alone:
    """A block that was pressed before it was sealed, in the air, at rest and at full vacuum."""
    simulation = start(engine, **options)
    go(simulation, 0.0295, 6, vacuum=False)
    go(simulation, 0.0295, 6, vacuum=True)
    for height in (*np.linspace(0.03, 0.07, 20), *[0.07] * 5):
        state = go(simulation, height, 1, vacuum=True)
    assert state.held == 0
    assert state.vacuum == pytest.approx(CUP.vacuum, rel=1e-3)
    return simulation


@contextmanager
def recorded(simulation: Alone) -> Iterator[SimpleNamespace]:
    """Force of the cup on the block (N, downwards), slide and height of the block, each time step.

    The force is known when a time step is solved, the rest when it has ended.
    """
    seen = SimpleNamespace(forces=[], slides=[], heights=[])

    def after() -> None:
        seen.slides.append(slide(simulation))
        seen.heights.append(place_of(simulation)[2])

    solved = lambda: seen.forces.append(-from_cup(simulation)[2])  # noqa: E731
    with around_each_step(simulation, solved=solved, after=after):
        yield seen


# -- taken, held, let go ---------------------------------------------------------------------------


@each_engine
def test_it_takes_what_it_touches_lifts_it_and_lets_go(engine):
    simulation = start(engine)
    assert go(simulation, 0.04, 3, vacuum=True).held == -1  # 10 mm above: nothing to suck on
    assert go(simulation, 0.03, 4, vacuum=True).held == 0
    go(simulation, 0.06, 8, vacuum=True)
    lifted = go(simulation, 0.09, 8, vacuum=True)
    assert lifted.held == 0
    assert lifted.object_position[0, 2] == pytest.approx(0.075, abs=2e-3)
    assert go(simulation, 0.09, 2, vacuum=False).held == -1
    dropped = go(simulation, 0.09, 15, vacuum=False)
    assert dropped.vacuum < 1.0
    assert dropped.object_position[0, 2] == pytest.approx(0.015, abs=1e-3)


@each_engine
@pytest.mark.parametrize("pressed", [False, True])
def test_the_block_jumps_neither_when_it_is_taken_nor_when_it_is_let_go(engine, pressed):
    simulation = start(engine, offset=(0.006, 0.004))
    before = go(simulation, 0.025 if pressed else 0.031, 4, vacuum=not pressed)
    after = go(simulation, 0.025 if pressed else 0.031, 3, vacuum=True)
    assert after.held == 0
    assert np.linalg.norm(after.object_position - before.object_position) < 1e-3
    held = go(simulation, 0.028, 6, vacuum=True)
    let_go = go(simulation, 0.028, 3, vacuum=False)
    assert let_go.held == -1
    assert np.linalg.norm(let_go.object_position - held.object_position) < 0.1e-3


@each_engine
def test_a_held_block_stays_put_at_full_speed(engine):
    simulation = holding(engine)
    state = simulation.read()
    grip, point = state.object_position - state.platform_position, level(0.07)
    for step in (1, 1, 1, -1, -1, -1, 1, -1, 1, -1):
        point = point + (0.03 * step, 0.0, -0.02 * step)
        state = simulation.move(point, vacuum=True)
        assert state.held == 0
        moved = state.object_position - state.platform_position - grip
        assert np.linalg.norm(moved) < (2e-3 if engine == "pybullet" else 0.1e-3)
    assert state.closure_error < 0.5e-3


@each_engine
def test_a_held_block_pressed_on_the_table_stays_held(engine):
    simulation = holding(engine)
    for height in np.arange(0.06, 0.012, -0.006):
        assert go(simulation, height, 1, vacuum=True).held == 0
    state = go(simulation, 0.012, 5, vacuum=True)
    assert state.object_position[0, 2] == pytest.approx(0.015, abs=0.1e-3)
    for height in (0.02, 0.03, 0.04, 0.05):
        assert go(simulation, height, 1, vacuum=True).held == 0


@inside_engines
def test_in_the_air_it_falls_from_rest(engine):
    simulation, speeds = holding(engine), list[float]()
    step = simulation.engine.time_step

    def note():
        speeds.append(simulation.engine.read().object_velocity[0, 0, 2])

    with around_each_step(simulation, after=note):
        go(simulation, 0.07, 2, vacuum=False)
    begun = int(np.argmax(np.array(speeds) < -1e-2))
    # The vacuum lasts 30 ms: 7 whole time steps; it is let go at the end of the eighth.
    assert begun == 8
    fallen = -G * step * np.arange(1, len(speeds) - begun + 1)
    np.testing.assert_allclose(speeds[begun:], fallen, atol=1e-3)


@inside_engines
@pytest.mark.parametrize(
    ("direction", "mass"),
    [
        ((0, 0, -1), 0.05),
        ((1, 0, 0), 1.0),
        ((0, 1, 0), 0.05),
        ((1, 0, -1), 0.3),
        ((-1, 1, -1), 1.0),
    ],
)
def test_a_held_block_comes_off_at_the_pull_off_force(engine, direction, mass):
    simulation, load = holding(engine, mass=mass), 11.5
    along, weight = direction / np.linalg.norm(direction), np.array((0, 0, -mass * G))

    def pull():
        nonlocal load
        if simulation.engine._cup.grip.hold.which == 0:
            load += 0.002  # N a time step
            push(simulation, load * along - weight, 0)

    with around_each_step(simulation, before=pull):
        while go(simulation, 0.07, 1, vacuum=True).held == 0 and load < 20:
            pass
    assert load == pytest.approx(CUP.vacuum * CUP.area, abs=0.05)


@each_engine
@pytest.mark.parametrize(("mass", "kept"), [(0.2, True), (0.3, False)])
def test_who_pulls_too_hard_loses_the_block(engine, mass, kept):
    # Down at full speed and up again: 37.5 m/s^2 and the weight are 9.5 N, and 14.2 N.
    simulation = holding(engine, plant=Plant(block_mass=mass / Block().mass))
    for height in np.arange(0.07, 0.25, 0.012):
        assert go(simulation, height, 1, vacuum=True).held == 0
    for height in (0.22, 0.19, 0.16, 0.19, 0.22):
        state = go(simulation, height, 1, vacuum=True)
    assert (state.held == 0) == kept
    assert (state.vacuum > 0.99 * CUP.vacuum) == kept
    state = go(simulation, 0.22, 8, vacuum=True)
    assert state.object_position[0, 2] == pytest.approx(0.205 if kept else 0.015, abs=2e-3)
    assert state.vacuum > 0.99 * CUP.vacuum if kept else state.vacuum < 1


def test_it_is_sealed_in_the_time_step_in_which_it_touches_at_any_speed(monkeypatch):
    pytest.importorskip("pybullet")
    found = []
    for fastest in (None, 1e3):  # m/s; so fast, the cup could be anywhere, and always looks
        if fastest is not None:
            monkeypatch.setattr("tpm_gym.simulation.bullet.cup._FASTEST", fastest)
        simulation = start("pybullet", height=0.132)
        states = [go(simulation, 0.132 - 0.03 * k, 1, vacuum=True) for k in (1, 2, 3, 4, 4)]
        assert states[-1].held == 0
        found.append([(state.vacuum, *state.object_position[0]) for state in states])
    assert found[0] == found[1]


@each_engine
@pytest.mark.parametrize("steps", [1, 3, 5])
def test_a_moment_of_any_pressure_is_gone_back_to_exactly(engine, steps):
    simulation = start(engine, height=0.0315)
    course = (True, True, False, True, True, True)
    for index, vacuum in enumerate(course):
        if index == steps:
            moment = simulation.save()
        state = simulation.move(level(0.03), vacuum)
    assert 0 < state.vacuum < CUP.vacuum
    assert simulation.restore(moment).vacuum > 0
    for vacuum in course[steps:]:
        again = simulation.move(level(0.03), vacuum)
    for name, value in vars(state).items():
        np.testing.assert_array_equal(getattr(again, name), value, err_msg=name)


@each_engine
def test_a_reset_while_holding_lets_go(engine):
    simulation = holding(engine)
    state = simulation.reset(PAPER_TPM.inverse(level(0.1)), {"object": (0.0, -0.03, 0.015)})
    assert (state.held, state.vacuum) == (-1, 0)
    state = go(simulation, 0.1, 5, vacuum=True)
    assert np.allclose(state.object_position, (0.0, -0.03, 0.015), atol=1e-3)


# -- the spring ------------------------------------------------------------------------------------


@inside_engines
@pytest.mark.parametrize("speed", [0.005, 0.03])  # m a control period; the second is full speed
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.012, 0.012)])
def test_the_cup_yields_to_the_block_at_its_preload_and_comes_out_again(engine, speed, offset):
    simulation = start(engine, height=0.06, offset=offset)
    with recorded(simulation) as seen:
        for height in np.arange(0.06, 0.012, -speed):
            simulation.move(level(height))
        state = go(simulation, 0.012, 10, vacuum=False)  # 18 mm below the top of the block
    mass = PAPER_TPM.mechanism.link("cup").mass  # stopped in one time step
    blow = mass * speed / 0.04 / simulation.engine.time_step
    assert max(seen.forces) <= SPRUNG + blow + 0.1
    assert seen.forces[-1] == pytest.approx(SPRUNG, rel=1e-3)
    assert min(seen.slides) == pytest.approx(-0.018, abs=1e-4)
    assert seen.slides[-1] == pytest.approx(-0.018, abs=1e-4)
    # The block stays on the table: 0.16 mm into it at PyBullet's blow, then as if nothing pressed.
    pressed = 0.2e-3 if engine == "pybullet" else 5e-6
    np.testing.assert_allclose(seen.heights, 0.015, atol=pressed)
    assert seen.heights[-1] == pytest.approx(0.015, abs=0.03e-3)
    assert np.allclose(state.object_quaternion, (0, 0, 0, 1), atol=1e-3)
    assert state.closure_error < 1e-5
    before = state.object_position
    with recorded(simulation) as seen:
        state = go(simulation, 0.06, 10, vacuum=False)
    assert state.held == -1  # without vacuum
    assert seen.forces[-1] == 0
    assert seen.slides[-1] == pytest.approx(0, abs=1e-5)
    assert np.linalg.norm(state.object_position - before) < 1e-4


@inside_engines
def test_the_cup_stays_out_in_free_motion_at_full_speed(engine):
    simulation = start(engine, height=0.2)
    with recorded(simulation) as seen:
        for height in 0.2 + 0.03 * np.cumsum((1, 1, -1, -1, -1, 1, -1, 1, 1)):
            simulation.move(level(height))
    assert np.abs(seen.slides).max() < 1e-5


@inside_engines
def test_beyond_its_stroke_the_cup_stops_and_the_block_holds(engine):
    simulation = start(engine)
    state = go(simulation, 0.006, 12, vacuum=False)  # 24 mm below the top, 4 mm beyond the stroke
    # In MuJoCo the motors are at their limit.
    assert slide(simulation) == pytest.approx(-CUP.stroke, abs=0.5e-3)
    assert state.object_position[0, 2] == pytest.approx(0.015, abs=0.1e-3)
    assert state.closure_error < 1e-5


@inside_engines
def test_weld_and_contact_do_not_fight(engine):
    simulation, loads = start(engine, height=0.09), list[Any]()
    for height in (0.06, 0.03, 0.012):  # at full speed: half a millimetre into the block
        go(simulation, height, 1, vacuum=False)
    state = go(simulation, 0.012, 5, vacuum=True)
    assert state.held == 0
    assert state.vacuum == pytest.approx(CUP.vacuum, rel=1e-2)
    engine_load = "_load" if engine == "pybullet" else "load"
    note = lambda: loads.append(getattr(simulation.engine._cup, engine_load)())  # noqa: E731
    with recorded(simulation) as seen, around_each_step(simulation, solved=note):
        # Pressed on the table, taken off it, and at rest.
        for height in (0.012, 0.02, 0.03, 0.03, 0.045, 0.06, 0.06, 0.06, 0.06, 0.06):
            assert go(simulation, height, 1, vacuum=True).held == 0
    assert not any(seen.forces)
    tension, shear = loads[-1]
    assert tension == pytest.approx(Block().mass * G, abs=1e-3)
    assert shear < 1e-3
