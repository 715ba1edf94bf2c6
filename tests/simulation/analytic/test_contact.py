"""Objects, cups and vacuum of the analytic engine: laws of contact, and MuJoCo's results."""

import hashlib
import math
import os
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from alone import Alone
from processes import PYTHON, printed_by

from tpm_gym.arrays import FloatArray
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.mount import GRAVITY
from tpm_gym.mechanism.tpm import WIDE_TPM
from tpm_gym.simulation.analytic.contact import Contact, Reading, Route
from tpm_gym.simulation.engine import spline_weights
from tpm_gym.simulation.state import Block, Scene

STEP, STEPS = 1 / 250, 10
BLOCK = Block()
HEIGHT, WIDTH = BLOCK.height, BLOCK.width
MIDDLE = np.array([0.3, -0.36, HEIGHT / 2])
ON_TOP = MIDDLE + [0.0, 0.0, HEIGHT / 2 + CUP.length]
"""Point P with the lip on a block in the middle."""
AWAY = np.array([0.0, 0.0, 0.5])
UP = np.array([0.0, 0.0, 1.0])


class Run(NamedTuple):
    """Positions (t, k, 3), tilts (t, k), what is held (t,) and forces (t, 3) over time steps."""

    position: FloatArray
    tilt: FloatArray
    held: FloatArray
    force: FloatArray


def spline(commands: Sequence[FloatArray]) -> FloatArray:
    """(2 + t, 3) point P at the time steps, from rest, as the simulation leads it."""
    points = [commands[0]] * 2
    for before, last, new in zip([commands[0], *commands], commands, commands[1:], strict=False):
        points += [u * before + v * last + w * new for u, v, w in spline_weights(STEPS)]
    return np.array(points)


def line(start: FloatArray, end: FloatArray, count: int, wait: int = 0) -> list[FloatArray]:
    """Commands from one point to another, not counting the first."""
    return [start + (end - start) * (i + 1) / count for i in range(count)] + [end] * wait


def tilts(reading: Reading) -> FloatArray:
    """(n, k) rad, by which objects lean from the vertical."""
    x, y = reading.quaternion[..., 0], reading.quaternion[..., 1]
    return np.arccos(np.clip(1 - 2 * (x * x + y * y), -1.0, 1.0))


def on_tables(blocks: int, count: int, edges: tuple[float, float] = (9.0, 9.0)) -> Contact:
    """Tables with blocks; the machine's frame is that of the world."""
    return Contact([BLOCK] * blocks, count, STEP, edges, ((1.0, 1.0, 1.0), (0.0, 0.0, 0.0)))


def upright(places: FloatArray) -> FloatArray:
    """Poses (r, k, 7) of upright blocks at places (r, k, 3)."""
    turn = np.broadcast_to((0.0, 0.0, 0.0, 1.0), (*places.shape[:2], 4))
    return np.concatenate([places, turn], axis=2)


def advance(contact: Contact, rows: Any, path: FloatArray, on: FloatArray) -> Any:
    """Lead the cups along paths (r, 2 + K, 3); the forces (r, K, 3) and the carried masses."""
    steps = path.shape[1] - 2
    route = Route(path[:, 0].copy(), path[:, 1].copy(), path[:, 2:].copy(), np.eye(steps))
    return contact.advance(rows, route, on, steps)


def table(places: Sequence[FloatArray], edges: tuple[float, float] = (9.0, 9.0)) -> Contact:
    """One table with blocks."""
    contact = on_tables(len(places), 1, edges)
    contact.place(np.arange(1), upright(np.array([places])))
    return contact


def lead(contact: Contact, path: FloatArray, on: bool | Sequence[bool] = False) -> Run:
    """Lead the cup of one table along a path (2 + t, 3), time step by time step."""
    seen, switched = [], np.broadcast_to(on, len(path) - 2)
    for k in range(len(path) - 2):
        vacuum = np.array([switched[k]])
        force, _ = advance(contact, np.arange(1), path[None, k : k + 3], vacuum)
        now = contact.read()
        seen.append((now.position[0], tilts(now)[0], now.held[0], force[0, 0]))
    return Run(*(np.array(part) for part in zip(*seen, strict=True)))


def wait(contact: Contact, steps: int) -> Run:
    """Let time pass with the cup far away."""
    return lead(contact, np.tile(AWAY, (steps + 2, 1)))


@cache
def simulation() -> Alone:
    """MuJoCo at 1 ms, with room to move in all directions."""
    scene, physics = Scene(objects=(BLOCK,)), {"time_step": STEP / 4}
    return Alone(scene, engine="mujoco", machine=WIDE_TPM, physics=physics)


def compared(commands: list[FloatArray], on: list[bool]) -> tuple[Run, Run]:
    """One block under a cup that is led by commands: ours, and MuJoCo's."""
    sim, mount = simulation(), WIDE_TPM.mount

    def theta(points):
        return WIDE_TPM.inverse(mount.to_paper(points))

    path, switched = spline(commands), np.repeat(on[: len(commands) - 1], STEPS)
    sim.reset(theta(path[0]), {"object": MIDDLE})
    seen = []
    for k, vacuum in enumerate(switched):
        now, then = path[k + 1], path[k + 2]
        way = [now + (then - now) * part / 4 for part in range(1, 5)]
        joints = theta(way)[None]
        sim.engine.advance(SimpleNamespace(joints=lambda joints=joints: joints), [bool(vacuum)])
        ends = sim.engine.read()
        tilt = 2 * math.asin(min(1.0, math.hypot(*ends.object_quaternion[0, 0, :2])))
        seen.append((ends.object_position[0], [tilt], ends.held[0], np.zeros(3)))
    theirs = Run(*(np.array(part) for part in zip(*seen, strict=True)))
    return lead(table([MIDDLE]), path, switched), theirs


# -- as MuJoCo ----------------------------------------------------------------------------------


def test_a_pick_a_way_and_a_release_are_those_of_mujoco():
    high, low = ON_TOP + [0.003, -0.002, 0.05], ON_TOP + [0.003, -0.002, -0.0006]
    there = low + [0.06, -0.05, 0.0]
    commands = [high, *line(high, low, 5, 3), *line(low, high, 5), *line(high, there, 6, 3)]
    away = line(there, there + [0.0, 0.0, 0.05], 4, 2)
    ours, theirs = compared([*commands, *away], [True] * (len(commands) - 1) + [False] * 6)
    assert (ours.held == theirs.held).mean() > 0.97  # the lip touches within a time step or so
    assert (ours.held == 0).any()
    assert np.abs(ours.position - theirs.position).max() < 4e-3  # m; 0.6 m/s over 6 ms
    assert math.dist(ours.position[-1, 0], theirs.position[-1, 0]) < 1e-4


@pytest.mark.parametrize("speed", [0.3, 0.5, 0.6, 0.75])
def test_what_is_grabbed_in_full_sweep_is_held_or_lost_as_in_mujoco(speed):
    step = speed * STEP * STEPS * np.array([1.0, 0.0, 0.0])
    commands = [ON_TOP + [0.0, 0.0, 0.02] + (k - 6) * step for k in range(14)]
    for k, command in enumerate(commands):
        command[2] = max(ON_TOP[2] + 0.02 - 0.03 * max(0, k - 4), ON_TOP[2] - 0.003)
    ours, theirs = compared(commands, [True] * len(commands))
    assert (ours.held[-1] == 0) == (theirs.held[-1] == 0) == (speed < 0.7)


@pytest.mark.parametrize("way", [(0.03, 0.0, 0.0), (0.0, 0.02, 0.01), (0.015, -0.02, -0.004)])
def test_what_is_thrown_comes_to_rest_where_it_does_in_mujoco(way):
    top = ON_TOP + [0.0, 0.0, 0.06]
    ends = [top + i * np.array(way) for i in range(6)]
    commands = [ON_TOP, *line(ON_TOP, ON_TOP, 4), *line(ON_TOP, top, 5), *ends[1:], *[ends[-1]] * 9]
    ours, theirs = compared(commands, [True] * 12 + [False] * (len(commands) - 13))
    assert math.dist(theirs.position[0, 0], theirs.position[-1, 0]) > 0.05
    assert math.dist(ours.position[-1, 0], theirs.position[-1, 0]) < 2e-3


def test_a_press_without_vacuum_moves_nothing():
    low = ON_TOP + [0.004, 0.0, -0.0025]
    commands = [ON_TOP + [0.004, 0.0, 0.03], *line(ON_TOP + [0.004, 0.0, 0.03], low, 4, 2)]
    commands += line(low, low + [0.008, 0.0, 0.0], 4, 2)
    ours, theirs = compared(commands, [False] * len(commands))
    assert math.dist(ours.position[-1, 0], theirs.position[-1, 0]) < 2e-4
    lift = CUP.preload + CUP.link("platform", (0.0, 0.0, 0.0)).mass * GRAVITY
    assert ours.force[-1, 2] == pytest.approx(lift, abs=0.01)
    assert math.hypot(*ours.force[-1, :2]) < 1.01 * CUP.friction * BLOCK.friction * lift


@pytest.mark.parametrize("way", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0)])
@pytest.mark.parametrize("depth", [0.0025, 0.006])
def test_a_lip_dragged_over_an_edge_tips_it_as_in_mujoco(way, depth):
    high, low = ON_TOP + [0.0, 0.0, 0.01], ON_TOP + [0.0, 0.0, -depth]
    end = low + 0.05 * np.array(way)
    commands = [high, *line(high, low, 3, 2), *line(low, end, 4, 8)]
    ours, theirs = compared(commands, [False] * len(commands))
    assert theirs.tilt[-1] > math.radians(60)  # it leans against the lip
    assert ours.tilt[-1] == pytest.approx(theirs.tilt[-1], abs=0.2)
    assert math.dist(ours.position[-1, 0], theirs.position[-1, 0]) < 2e-3


# -- by the laws --------------------------------------------------------------------------------


def test_what_stands_alone_keeps_its_bits_and_what_falls_comes_to_rest():
    contact = table([np.array([0.0, 0.0, 0.015]), np.array([0.1, 0.0, 0.2])])
    heights = wait(contact, 150).position[:, :, 2]
    assert (heights > 0.0145).all()
    assert heights[-1] == pytest.approx([0.015, 0.015], abs=2e-5)
    before = contact.save()
    wait(contact, 10)
    np.testing.assert_array_equal(contact.save(), before)


@pytest.mark.parametrize(("acceleration", "kept"), [(220.0, True), (235.0, False)])
def test_what_is_pulled_harder_than_the_vacuum_can_comes_off(acceleration, kept):
    # 12 N on 50 g are 230.2 m/s^2 beside the weight
    times = STEP * np.arange(8)
    rise = np.concatenate([np.zeros(62), acceleration * times**2 / 2])
    ours = lead(table([MIDDLE]), ON_TOP + rise[:, None] * UP, True)
    assert (ours.held[-2:] == 0).all() == kept
    if kept:
        total = BLOCK.mass * (GRAVITY + acceleration)
        assert ours.force[-1] == pytest.approx([0.0, 0.0, -total], rel=1e-3)


def test_a_heavier_one_comes_off_and_a_smoother_one_slides_farther():
    contact, every = on_tables(1, 3), np.arange(3)
    contact.place(every, upright(np.tile(MIDDLE, (3, 1, 1))))
    contact.alter(every, np.array([1.0, 1.0, 30.0]), np.array([1.0, 0.5, 1.0]))
    rising = np.minimum(np.maximum(np.arange(-92, 90), 0), 20) * 0.0002
    moving = np.maximum(np.arange(-132, 50), 0) * 0.4 * STEP
    path = np.tile(ON_TOP + rising[:, None] * UP + moving[:, None] * [1.0, 0.0, 0.0], (3, 1, 1))
    for k in range(180):
        _, carried = advance(contact, every, path[:, k : k + 3], np.full(3, k < 148))
        if k == 147:
            assert contact.read().held.tolist() == [0, 0, -1]
            assert carried.tolist() == [BLOCK.mass, BLOCK.mass, 0.0]
            dropped = contact.read().position[:, 0, 0]
    advance(contact, every, np.tile(AWAY, (3, 150, 1)), np.zeros(3, dtype=bool))
    ways = contact.read().position[:, 0, 0] - dropped
    assert 0.005 < ways[0] < ways[1]
    assert ways[2] == 0.0


def test_friction_is_as_strong_in_all_directions():
    speed, slid = 0.5, []
    moving = np.maximum(np.arange(-60, 60), 0) * speed * STEP
    rising = np.minimum(np.maximum(np.arange(-50, 70), 0), 10) * 2e-5
    for angle in np.radians([0.0, 20.0, 45.0]):
        way = np.array([math.cos(angle), math.sin(angle), 0.0])
        path = ON_TOP + rising[:, None] * UP + moving[:, None] * way
        contact = table([MIDDLE])
        run = lead(contact, path, [True] * 70 + [False] * 48)
        released = run.position[np.flatnonzero(run.held == 0)[-1] + 1, 0]
        slid.append(math.dist(released, wait(contact, 60).position[-1, 0]))
    assert slid == pytest.approx([speed**2 / (2 * BLOCK.friction * GRAVITY)] * 3, rel=0.1)
    assert max(slid) < 1.01 * min(slid)


def test_without_friction_the_platform_takes_what_the_block_gains():
    contact = table([MIDDLE])
    contact.alter(np.arange(1), np.ones(1), np.full(1, 1e-9))
    start = ON_TOP + [-0.05, 0.005, -0.001]
    run = lead(contact, spline([start, *line(start, start + [0.08, 0.0, 0.0], 8)]))
    velocity, gained = contact.read().velocity[0, 0], -STEP * run.force.sum(axis=0)
    assert velocity[0] > 0.1
    np.testing.assert_allclose(gained[:2], BLOCK.mass * velocity[:2], rtol=1e-3, atol=1e-9)


def test_beyond_the_table_it_falls_to_the_floor():
    contact = table([np.array([0.29, 0.0, 0.015]), np.array([0.4, 0.0, 0.015])], (0.3, 0.3))
    assert wait(contact, 300).position[-1, :, 2] == pytest.approx([0.015, -0.485], abs=5e-5)


def test_without_objects_there_is_nothing_to_report():
    contact = on_tables(0, 3)
    found = advance(contact, np.arange(3), np.zeros((3, 12, 3)), np.ones(3, dtype=bool))
    assert not any(part.any() for part in found)
    reading = contact.read()
    assert reading.position.shape == (3, 0, 3)
    assert reading.quaternion.shape == (3, 0, 4)
    assert reading.held.tolist() == [-1] * 3


# -- several objects ------------------------------------------------------------------------------


def stacked(offset: float, angle: float = 0.0) -> Contact:
    """Two blocks, the upper one let go off the middle of the lower one."""
    way = np.array([math.cos(angle), math.sin(angle), 0.0])
    return table([MIDDLE, MIDDLE + HEIGHT * UP + offset * way])


@pytest.mark.parametrize(
    ("offset", "angle", "stands"),
    [
        (0.0, 0.0, True),
        (0.017, 0.0, True),
        (0.019, 0.0, False),
        (0.024, math.pi / 4, True),
        (0.027, math.pi / 4, False),
    ],
)
def test_a_stack_stands_as_long_as_the_upper_middle_is_over_the_lower_block(offset, angle, stands):
    run = wait(stacked(offset, angle), 150)
    assert (run.tilt.max() < 0.01) == stands
    if stands:
        assert np.abs(run.position[-1] - run.position[0]).max() < 1e-4
        assert (run.position[-1] == run.position[-2]).all()
    else:
        assert run.position[-1, 1, 2] < 0.02


def test_the_upper_one_is_taken_and_put_back_and_the_lower_one_stays():
    contact, top = stacked(0.004), ON_TOP + HEIGHT * UP
    commands = [top + 0.03 * UP, *line(top + 0.03 * UP, top, 4, 3)]
    up = commands + line(top, top + 0.05 * UP, 4)
    down = line(top + 0.05 * UP, top + [0.003, 0.0, -0.0005], 6, 3)
    path = spline([*up, *down, *line(down[-1], top + 0.05 * UP, 4, 2)])
    run = lead(contact, path, np.arange(len(path) - 2) < STEPS * (len(up) + len(down) - 1))
    assert set(run.held.tolist()) == {-1, 1}
    assert run.position[:, 1, 2].max() > 0.09
    assert run.held[-1] == -1
    assert run.position[-1, 1] == pytest.approx(MIDDLE + [0.007, 0.0, HEIGHT], abs=6e-4)
    assert np.abs(run.position[:, 0] - MIDDLE).max() < 2e-4
    assert run.tilt.max() < 0.02


def test_one_block_shoves_another():
    contact = table([MIDDLE, MIDDLE + [WIDTH + 0.004, 0.0, 0.0]])
    start = ON_TOP + [-0.05, 0.0, -0.002]
    run = lead(contact, spline([start, *line(start, start + [0.06, 0.0, 0.0], 20, 8)]))
    first, second = run.position[-1]
    assert second[0] > MIDDLE[0] + WIDTH + 0.01
    gap = np.abs(run.position[:, 1, 0] - run.position[:, 0, 0]).min() - WIDTH
    assert gap > -2e-4
    assert first[1] == pytest.approx(MIDDLE[1], abs=1e-3)


def test_whatever_the_cup_does_all_stays_finite_and_on_the_table():
    rng, rows, count, held = np.random.default_rng(0), 60, 3, list[int]()
    contact = on_tables(count, rows)
    places = np.zeros((rows, count, 3)) + np.arange(count)[:, None] * [0.0, 0.0, HEIGHT]
    places[..., 2] += HEIGHT / 2
    places[..., :2] += rng.uniform(-0.02, 0.02, (rows, count, 2))
    contact.place(np.arange(rows), upright(places))
    stops = rng.uniform([-0.06, -0.06, 0.03], [0.06, 0.06, 0.14], (25, rows, 3))
    ways = np.stack([spline(list(stops[:, row])) for row in range(rows)])
    for k in range(0, ways.shape[1] - 2, STEPS):
        steps = ways[:, k : k + STEPS + 2]
        force, _ = advance(contact, np.arange(rows), steps, rng.random(rows) < 0.5)
        assert np.isfinite(force).all()
        held += contact.read().held.tolist()
    reading = contact.read()
    assert all(np.isfinite(part).all() for part in reading)
    assert (reading.position[..., 2] > 0.01).all()
    assert np.abs(reading.position).max() < 3.0
    assert (np.array(held) >= 0).any()


# -- in batches -----------------------------------------------------------------------------------


def crowd(count: int, seed: int, periods: int = 8) -> tuple[FloatArray, FloatArray]:
    """Blocks (n, 2, 3), and ways (n, 2 + t, 3) of P that pick, shove, tip, press and throw."""
    rng = np.random.default_rng(seed)
    places = np.zeros((count, 2, 3)) + [[0.0, 0.0, HEIGHT / 2], [WIDTH + 0.002, 0.0, HEIGHT / 2]]
    places[:, 0, :2] += rng.uniform(-0.02, 0.0, (count, 2))
    stops = np.zeros((periods + 1, count, 3))
    stops[..., :2] = 0.5 * rng.uniform(-0.06, 0.06, (periods + 1, count, 2))
    stops[..., 2] = 0.067 + np.maximum(rng.uniform(-0.02, 0.03, (periods + 1, count)), 0.0)
    return places, np.stack([spline(list(stops[:, row])) for row in range(count)])


def history(places: FloatArray, ways: FloatArray, on: FloatArray) -> list[FloatArray]:
    """All that is read, and all forces, after each control period."""
    contact, rows = on_tables(2, len(places)), np.arange(len(places))
    contact.place(rows, upright(places))
    on = np.ascontiguousarray(on)  # strided arrays would be compiled for
    seen: list[FloatArray] = []
    for period, k in enumerate(range(0, ways.shape[1] - 2, STEPS)):
        force, _ = advance(contact, rows, ways[:, k : k + STEPS + 2], on[period])
        seen += [force, *contact.read()]
    return seen


def digest() -> str:
    """Of everything that happens to a crowd."""
    on = np.random.default_rng(3).random((8, 8)) < 0.6
    parts = history(*crowd(8, 2), on)
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


def test_compiled_code_gives_the_bits_that_python_gives():
    here = Path(__file__).parent
    script = "import sys; sys.path[:0] = sys.argv[1:]; import test_contact as t; print(t.digest())"
    folders = here, here.parents[1] / "support"
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    assert printed_by(PYTHON, "-c", script, *folders, env=environment).strip() == digest()


def test_a_row_has_the_same_bits_alone_and_among_others():
    count = 64
    places, ways = crowd(count, seed=0)
    on = np.random.default_rng(1).random((8, count)) < 0.6
    everything = history(places, ways, on)
    lean = np.abs(np.array(everything[2::7])[..., :2]).max(axis=(0, 2, 3))
    assert lean.max() > 0.1
    assert any((held >= 0).any() for held in everything[5::7])
    worst = np.argsort(-lean)
    for rows in (worst[:1], worst[1:2], worst[2:9], np.append(worst[:4], [9, 8, 7])):
        few = history(places[rows], ways[rows], on[:, rows])
        for part, whole in zip(few, everything, strict=True):
            np.testing.assert_array_equal(part, whole[rows])


def test_rows_may_be_advanced_apart_by_any_steps_and_go_on_from_what_was_saved():
    places, ways = crowd(12, seed=3)
    whole = history(places, ways, np.ones((8, 12), dtype=bool))
    made = [on_tables(2, 12) for _ in range(2)]
    every, contact = np.arange(12), made[0]
    contact.place(every, upright(places))
    for k in range(0, ways.shape[1] - 2, STEPS // 2):
        for rows in (every[1::2], every[::2]):
            steps = ways[rows, k : k + STEPS // 2 + 2]
            advance(contact, rows, steps, np.ones(len(rows), dtype=bool))
        if k == 4 * STEPS:
            made[1].restore(contact.save())
            contact = made[1]
    for part, expected in zip(contact.read(), whole[-6:], strict=True):
        np.testing.assert_array_equal(part, expected)
