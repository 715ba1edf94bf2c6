"""Coulomb's cone: friction has its length and direction, whichever way things slide or are pulled.

PyBullet's direct solver has a box by itself; its numbers are in brackets.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from alone import PLACE, SPRUNG, Alone, level
from inside import around_each_step, from_cup, from_table, place_of, push, throw

from tpm_gym.arrays import FloatArray
from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.mechanism.cup import CUP
from tpm_gym.simulation import Block, Plant, Scene, State
from tpm_gym.simulation.randomisation import NOMINAL
from tpm_gym.simulation.state import CONTROL_PERIOD

G = 9.81
DIRECTIONS = [0.0, 22.5, 135.0, 270.0]  # degrees from x
BLOCK, OTHER = Block(), Block("other")
BASE = Block("base", width=0.3, height=0.02, mass=5.0)
AWAY = [(0.25, 0.15), (0.1, 0.15)]  # m; nothing is near
UNDER = (PLACE[0], -PLACE[1])  # world
each_engine = pytest.mark.parametrize("engine", ["pybullet", "mujoco"])


def unit(degrees: float) -> FloatArray:
    return np.array([math.cos(math.radians(degrees)), math.sin(math.radians(degrees)), 0.0])


def start(
    engine: str,
    *blocks: Block,
    places: Sequence[tuple[float, float]] = AWAY,
    plant: Plant = NOMINAL,
) -> Alone:
    simulation = Alone(Scene(objects=blocks), engine=engine)
    pairs = zip(blocks, places, strict=False)
    where = {block.name: (*place, block.height / 2) for block, place in pairs}
    simulation.reset(PAPER_TPM.inverse(level(0.05)), where, plant=plant)
    rest(simulation)
    return simulation


def rest(simulation: Alone, steps: int = 1) -> Any:
    for _ in range(steps):
        state = simulation.move(level(0.05))
    return state


def velocity(simulation: Alone) -> FloatArray:
    found: FloatArray = simulation.engine.read().object_velocity[0, 0]
    return found


def angle(one: FloatArray, other: FloatArray) -> float:
    """Degrees between two directions."""
    cosine = one @ other / np.linalg.norm(one) / np.linalg.norm(other)
    return math.degrees(math.acos(min(1.0, cosine)))


def way_to_stop(simulation: Alone, speed: float, braking: float) -> float:
    """In whole time steps, m."""
    return speed**2 / (2 * braking) - speed * simulation.engine.time_step / 2


@each_engine
@pytest.mark.parametrize("factor", [0.5, 1.0])
@pytest.mark.parametrize("degrees", DIRECTIONS)
def test_what_slides_is_braked_by_mu_n_against_its_way(engine, degrees, factor):
    # In PyBullet exact to rounding (box: 41%, 44 degrees off).
    simulation, rows = start(engine, BLOCK, plant=Plant(friction=factor)), list[Any]()
    begin, fast = place_of(simulation), 0.6 * math.sqrt(factor)
    throw(simulation, fast * unit(degrees))

    def note():
        force = from_table(simulation)
        slip = velocity(simulation)[:2]
        if np.linalg.norm(slip) > 0.05:
            ratio = np.linalg.norm(force[:2]) / (factor * BLOCK.friction * force[2])
            rows.append((ratio, angle(force[:2], -slip)))

    with around_each_step(simulation, solved=note):
        way = rest(simulation, 5).object_position[0] - begin
    ratios, angles = np.transpose(rows[2:])
    assert len(ratios) > 15
    np.testing.assert_allclose(ratios, 1, atol=0.01)
    assert angles.max() < 1
    stop = way_to_stop(simulation, fast, factor * BLOCK.friction * G)
    assert np.linalg.norm(way[:2]) == pytest.approx(stop, rel=0.015)
    assert angle(way[:2], unit(degrees)[:2]) < 0.1


@each_engine
@pytest.mark.parametrize("factor", [0.5, 1.0])
@pytest.mark.parametrize("degrees", DIRECTIONS)
def test_what_rests_breaks_away_at_mu_n(engine, degrees, factor):
    # In PyBullet 40 um away at 1.02 to 1.03 of mu N, which the growing load needs to get there; at
    # 0.94 to 0.99 along 22.5 degrees (box: up to 1.43).
    simulation = start(engine, BLOCK, places=[UNDER], plant=Plant(friction=factor))
    limit, share, begin = factor * BLOCK.friction * BLOCK.mass * G, 0.0, place_of(simulation)
    gone: list[float] = []

    def pull():
        nonlocal share
        share += 0.002
        push(simulation, share * limit * unit(degrees), 0)

    def note():
        gone.append(math.hypot(*(place_of(simulation) - begin)[:2]))

    with around_each_step(simulation, before=pull, after=note):
        rest(simulation, 75)
    begun = int(np.argmax(np.array(gone) > 40e-6)) + 1
    assert 0.002 * begun == pytest.approx(1, rel=0.08)


@pytest.mark.parametrize("blocks", [1, 2])
def test_what_is_struck_below_the_cup_is_braked_by_mu_n_from_the_second_time_step_on(blocks):
    # By a hand from outside, or by another block; the cup is near, and touches neither.
    gap = (UNDER[0] - BLOCK.width - 0.002, UNDER[1])
    simulation = start("pybullet", *(BLOCK, OTHER)[:blocks], places=(UNDER, gap))
    rows: list[Any] = []

    def strike():
        if not rows and blocks == 1:
            throw(simulation, (0.5, 0, 0))

    def note():
        force = from_table(simulation)
        rows.append((velocity(simulation)[0], force[0], force[2]))

    if blocks == 2:
        throw(simulation, (0.8, 0, 0), body=1)
    with around_each_step(simulation, before=strike, after=note):
        rest(simulation)
    speed, force, normal = np.transpose(rows)
    sliding = np.flatnonzero(speed > 0.05)[1:]
    assert len(sliding) >= 5
    np.testing.assert_allclose(-force[sliding], BLOCK.friction * normal[sliding], rtol=0.01)


@each_engine
@pytest.mark.parametrize("degrees", [0.0, 45.0, 90.0, 202.5])
def test_a_pressing_cup_that_moves_drags_with_mu_n_along_its_way(engine, degrees):
    # Box: moved along y it dragged along x as well, sqrt(2) too hard.
    simulation, rows = start(engine, BLOCK, places=[UNDER]), list[FloatArray]()
    for height in (0.04, 0.03, 0.022, 0.022, 0.022):
        simulation.move(level(height))
    with around_each_step(simulation, solved=lambda: rows.append(from_cup(simulation))):
        for index in range(1, 9):
            simulation.move(level(0.022, 0.001 * index * unit(degrees)[:2]))
    force, slip = np.mean(rows[20:], axis=0), PAPER_TPM.mount.rotate(unit(degrees))
    assert -force[2] == pytest.approx(SPRUNG, rel=0.01)
    expected = CUP.friction * BLOCK.friction * SPRUNG
    assert np.linalg.norm(force[:2]) == pytest.approx(expected, rel=0.03)
    assert angle(force[:2], slip[:2]) < 3


@each_engine
def test_two_objects_slide_their_own_ways_at_once(engine):
    simulation = start(engine, BLOCK, OTHER)
    begin, ways = simulation.read().object_position, [unit(30.0), unit(135.0)]
    for body, way in enumerate(ways):
        throw(simulation, 0.6 * way, body=body)
    gone = rest(simulation, 5).object_position - begin
    for moved, way in zip(gone, ways, strict=True):
        stop = way_to_stop(simulation, 0.6, BLOCK.friction * G)
        assert np.linalg.norm(moved[:2]) == pytest.approx(stop, rel=0.02)
        assert angle(moved[:2], way[:2]) < 1


@each_engine
@pytest.mark.parametrize("spin", [10.0, 30.0, 60.0])  # rad/s
def test_what_spins_on_the_spot_is_braked_at_its_corners_and_does_not_take_off(engine, spin):
    # PyBullet: 0 to 12% too far, for added friction is of the last time step. MuJoCo: 0.01 and
    # 0.02 rad too far, for the load comes onto the corners late.
    simulation, rates = start(engine, BLOCK), list[float]()
    heights: list[float] = []

    def note():
        now = simulation.engine.read()
        rates.append(now.object_angular_velocity[0, 0, 2])
        heights.append(now.object_position[0, 0, 2])

    throw(simulation, (0, 0, 0), spin)
    with around_each_step(simulation, after=note):
        rest(simulation, 4)
    step, corner = simulation.engine.time_step, BLOCK.width / math.sqrt(2)
    braking = BLOCK.friction * G * corner / (BLOCK.width**2 / 6)  # four corners bear the weight
    turned, exact = sum(rates) * step, spin**2 / (2 * braking)
    if engine == "mujoco":
        assert turned == pytest.approx(exact, abs=0.05)
    else:
        assert 0.98 < turned / (exact - spin * step / 2) < 1.14
    assert abs(rates[-1]) < 1e-4
    assert max(heights) < BLOCK.height / 2 + 2e-5


def stacked(engine: str, factor: float = 1.0) -> Alone:
    """A block in the middle of a heavy, flat one, whose friction is as high."""
    simulation = Alone(Scene(objects=(BLOCK, BASE)), engine=engine)
    where = {BLOCK.name: (*AWAY[0], BASE.height + BLOCK.height / 2), BASE.name: (*AWAY[0], 0.010)}
    simulation.reset(PAPER_TPM.inverse(level(0.05)), where, plant=Plant(friction=factor))
    rest(simulation)
    return simulation


@pytest.mark.parametrize("factor", [0.5, 1.0])  # of both objects
@pytest.mark.parametrize("degrees", DIRECTIONS)
@pytest.mark.parametrize(("engine", "off"), [("pybullet", 0.05), ("mujoco", 0.01)])
def test_what_slides_on_another_object_is_braked_against_its_way(engine, off, degrees, factor):
    # PyBullet: 4% too short, for the first time step still has the box (box: 30%, 10 degrees off).
    simulation = stacked(engine, factor)
    begin = place_of(simulation)
    throw(simulation, 0.6 * factor * unit(degrees))
    rest(simulation, 12)
    stop = way_to_stop(simulation, 0.6 * factor, factor**2 * BLOCK.friction * BASE.friction * G)
    way = place_of(simulation) - begin
    assert np.linalg.norm(way[:2]) == pytest.approx(stop, rel=off)
    assert angle(way[:2], unit(degrees)[:2]) < 2


@pytest.mark.parametrize("degrees", DIRECTIONS)
@each_engine
def test_what_lies_on_a_sliding_object_is_dragged_along_its_way(engine, degrees):
    # PyBullet: up to 6% too fast, for the first time step still has the box.
    simulation = stacked(engine)
    throw(simulation, unit(degrees), body=1)
    rest(simulation, 2)
    gained = BLOCK.friction * BASE.friction * G * 2 * CONTROL_PERIOD
    assert np.linalg.norm(velocity(simulation)[:2]) == pytest.approx(gained, rel=0.07)
    assert angle(velocity(simulation)[:2], unit(degrees)[:2]) < 3


@pytest.mark.parametrize(
    ("velocity", "spin"), [((0.3, 0.3, 0.0), 15.0), ((0.5, 0.0, 0.0), 25.0), ((0.3, 0.0, 0.0), 8.0)]
)
def test_what_slides_and_spins_goes_the_same_way_in_both_engines(velocity, spin):
    # With scales alone, PyBullet was up to 3.7 mm and 0.25 rad off.
    ends = []
    for engine in ("pybullet", "mujoco"):
        simulation = start(engine, BLOCK)
        begin = place_of(simulation)
        throw(simulation, velocity, spin)
        quaternion = rest(simulation, 8).object_quaternion[0]
        ends.append((*(place_of(simulation) - begin)[:2], 2 * math.asin(quaternion[2])))
    (x, y, turn), (u, v, exact) = ends
    assert math.hypot(x - u, y - v) < 0.0015
    assert turn == pytest.approx(exact, rel=0.12)


@each_engine
@pytest.mark.parametrize("overlap", [0.006, 0.010])  # m; with less it tips
def test_a_struck_block_slides_and_does_not_take_off(engine, overlap):
    mount, half = PAPER_TPM.mount, BLOCK.height / 2
    x, y, _ = mount.to_world(PAPER_TPM.home)
    begin = np.array([x, y, 2 * half - overlap + CUP.length])
    path = [begin + (0.025 * k, 0.0, 0.0) for k in range(10)]  # at 0.6 m/s
    simulation = Alone(Scene(objects=(BLOCK,)), engine=engine)
    theta = PAPER_TPM.inverse(mount.to_paper(begin))
    simulation.reset(theta, {BLOCK.name: (x + 0.08, y, half)})
    states = [simulation.move(mount.to_paper(point)) for point in path]
    assert states[-1].object_position[0, 0] > x + 0.2
    assert max(state.object_position[0, 2] for state in states) < half + 0.0015


def shoved(engine: str, sideways: Sequence[float]) -> State:
    """State after the lip pushed a block's side by 12 mm, and along it, m, in each period."""
    mount, half = PAPER_TPM.mount, BLOCK.height / 2
    x, y, _ = mount.to_world(PAPER_TPM.home)
    place = np.array([x, y, 2 * half - 0.010 + CUP.length])
    simulation = Alone(Scene(objects=(BLOCK,)), engine=engine)
    theta = PAPER_TPM.inverse(mount.to_paper(place))
    simulation.reset(theta, {BLOCK.name: (x + 0.05, y, half)})
    for along in sideways:
        place = place + (0.012, along, 0.0)
        state = simulation.move(mount.to_paper(place))
    return state


@pytest.mark.parametrize("engine", ["pybullet", "mujoco", "analytic"])
@pytest.mark.parametrize("sideways", [-0.002, 0.002])  # m in a control period
def test_a_side_that_the_lip_pushes_goes_along_with_the_lip(engine, sideways):
    """[The side stayed behind: in a steady push PyBullet's lip had no friction.]"""
    state = shoved(engine, [*[0.0] * 6, sideways, sideways])
    arm = state.platform_position - state.object_position[0] + (CUP.radius, 0.0, 0.0)
    turning = np.cross(state.object_angular_velocity[0], arm)
    side = state.object_velocity[0] + turning
    assert side[1] == pytest.approx(sideways / 0.040, rel=0.1)


@pytest.mark.parametrize("engine", ["pybullet", "mujoco", "analytic"])
def test_a_side_along_which_the_lip_slips_turns_equally_in_all_engines(engine):
    state = shoved(engine, [*[0.0] * 6, -0.008, 0.008, -0.008])
    assert 2 * math.asin(state.object_quaternion[0, 2]) == pytest.approx(0.114, rel=0.12)


@pytest.mark.parametrize("engine", ["pybullet", "mujoco", "analytic"])
def test_a_block_that_another_pushes_goes_along_with_it(engine):
    """[It stayed behind by half, as on ice.]"""
    mount, half = PAPER_TPM.mount, BLOCK.height / 2
    heavy = Block("heavy", width=0.06, mass=0.3)
    x, y, _ = mount.to_world(PAPER_TPM.home)
    place = np.array([x - 0.05, y, 2 * half - 0.010 + CUP.length])
    simulation = Alone(Scene(objects=(BLOCK, heavy)), engine=engine)
    where = {BLOCK.name: (x, y, half), heavy.name: (x + 0.05, y, heavy.height / 2)}
    simulation.reset(PAPER_TPM.inverse(mount.to_paper(place)), where)
    for step in range(9):
        place = place + (0.012, 0.0 if step < 6 else 0.002, 0.0)
        state = simulation.move(mount.to_paper(place))
    touch = state.object_position[0] + (BLOCK.width / 2, 0.0, 0.0)
    arms = touch - state.object_position
    one, other = state.object_velocity + np.cross(state.object_angular_velocity, arms)
    assert one[1] > 0.02
    assert other[1] == pytest.approx(one[1], rel=0.05)


@each_engine
def test_a_resting_block_neither_sinks_nor_moves(engine):
    simulation, heights = start(engine, BLOCK), list[float]()
    rest(simulation, 5)
    begin = place_of(simulation)
    with around_each_step(simulation, after=lambda: heights.append(place_of(simulation)[2])):
        state = rest(simulation, 20)
    np.testing.assert_allclose(heights, BLOCK.height / 2, atol=2e-5)
    np.testing.assert_allclose(state.object_position[0], begin, atol=2e-6)
    assert np.abs(state.object_velocity).max() < 1e-6
    assert np.abs(state.object_axis[0] - (0, 0, 1)).max() < 1e-6
