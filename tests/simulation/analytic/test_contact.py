"""Objects, cups and vacuum in batches: the laws of contact, and PyBullet's results."""

from __future__ import annotations

import hashlib
import math
import os
import subprocess
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.mount import GRAVITY
from tpm_gym.mechanism.tpm import WIDE_TPM
from tpm_gym.simulation.analytic.contact import Contact, Reading
from tpm_gym.simulation.drives import Reference
from tpm_gym.simulation.simulation import Simulation, spline_weights
from tpm_gym.simulation.state import Block, Scene

STEP, STEPS = 1 / 250, 10
BLOCK = Block()
ONE = np.arange(1)
MIDDLE = np.array([0.3, -0.36, BLOCK.height / 2])
ON_TOP = MIDDLE + [0.0, 0.0, BLOCK.height / 2 + CUP.length]
"""Point P with the lip on a block in the middle."""


class Run(NamedTuple):
    """Positions (k, 3), tilts (k,), what is held (k,) and forces (k, 3) after each time step."""

    position: FloatArray
    tilt: FloatArray
    held: FloatArray
    force: FloatArray


def spline(commands: Sequence[FloatArray]) -> FloatArray:
    """(2 + k, 3) point P at the time steps, from rest, as the simulation leads it."""
    points = [commands[0]] * 2
    for before, last, new in zip([commands[0], *commands], commands, commands[1:], strict=False):
        points += [u * before + v * last + w * new for u, v, w in spline_weights(STEPS)]
    return np.array(points)


def tilts(reading: Reading) -> FloatArray:
    """(n, k) rad, by which objects lean from the vertical."""
    x, y = reading.quaternion[..., 0], reading.quaternion[..., 1]
    return np.arccos(np.clip(1 - 2 * (x * x + y * y), -1.0, 1.0))


def line(start: FloatArray, end: FloatArray, count: int, wait: int = 0) -> list[FloatArray]:
    """Commands from one point to another, not counting the first."""
    return [start + (end - start) * (i + 1) / count for i in range(count)] + [end] * wait


def analytic(path: FloatArray, on: Sequence[bool], block: FloatArray, batch: int = STEPS) -> Run:
    """Lead one cup along a path."""
    contact = Contact([BLOCK], 1, STEP, WIDE_TPM.table)
    contact.place(ONE, block[None, None])
    seen = []
    for k in range(0, len(path) - 2, batch):
        steps = np.ascontiguousarray(path[None, k : k + batch + 2])
        force = contact.advance(ONE, steps, np.array([on[k // STEPS]]))
        now = contact.read()
        seen.append((now.position[0, 0], tilts(now)[0, 0], now.held[0], force[0, -1]))
    return Run(*(np.array(part) for part in zip(*seen, strict=True)))


@cache
def simulation() -> Simulation:
    """PyBullet, with room to move in all directions."""
    return Simulation(Scene(objects=(BLOCK,)), machine=WIDE_TPM)


def bullet(path: FloatArray, on: Sequence[bool], block: FloatArray) -> tuple[FloatArray, Run]:
    """The same in PyBullet; and where its platform has really been."""
    sim, mount = simulation(), WIDE_TPM.mount

    def theta(point: FloatArray) -> Vector:
        x, y, z = mount.to_paper(point).tolist()
        return WIDE_TPM.inverse((x, y, z))

    sim.reset(theta(path[0]), {"object": block})
    seen, been = [], [path[0], path[1]]
    for k, point in enumerate(path[2:]):
        sim.engine.advance([Reference(theta(point))], on[k // STEPS])
        been.append(np.array(sim.engine.truth().position))
        (((place, turn), _),) = sim.engine.objects()
        tilt = 2 * math.asin(min(1.0, math.hypot(*turn[:2])))
        seen.append((place, tilt, sim.engine.hold().which, np.zeros(3)))
    return np.array(been), Run(*(np.array(part) for part in zip(*seen, strict=True)))


def compared(commands: list[FloatArray], on: list[bool], block: FloatArray) -> tuple[Run, Run]:
    """Ours, time step by time step, and PyBullet's."""
    path, theirs = bullet(spline(commands), on, block)
    return analytic(path, on, block, batch=1), theirs


# -- as PyBullet --------------------------------------------------------------------------------


def test_a_pick_a_way_and_a_release_are_those_of_pybullet() -> None:
    high, low = ON_TOP + [0.003, -0.002, 0.05], ON_TOP + [0.003, -0.002, -0.0006]
    there = low + [0.06, -0.05, 0.0]
    commands = [high, *line(high, low, 5, 3), *line(low, high, 5), *line(high, there, 6, 3)]
    away = line(there, there + [0.0, 0.0, 0.05], 4, 2)
    on = [True] * (len(commands) - 1) + [False] * len(away)
    ours, theirs = compared([*commands, *away], on, MIDDLE)
    np.testing.assert_array_equal(ours.held, theirs.held)
    assert (ours.held == 0).any()
    # But for what stands exactly on the table at first, which PyBullet lets sink a little
    assert np.abs(ours.position - theirs.position).max() < 2e-4
    assert math.dist(ours.position[-1], theirs.position[-1]) < 2e-5


@pytest.mark.parametrize(
    ("way", "speed", "holds"),
    [
        ((1.0, 0.0, 0.0), 0.50, True),
        ((1.0, 0.0, 0.0), 0.65, True),  # at the second try
        ((-1.0, 0.0, 0.0), 0.75, False),
        ((0.8, 0.6, 0.0), 0.50, True),
        ((0.8, 0.6, 0.0), 0.60, False),
        ((0.8, 0.6, 0.0), 0.70, False),
        ((0.05, -1.0, 0.0), 0.75, False),
    ],
)
def test_what_is_grabbed_in_full_sweep_is_held_or_lost_as_in_pybullet(
    way: Vector, speed: float, holds: bool
) -> None:
    step = speed * STEP * STEPS * np.array(way) / math.hypot(*way)
    commands = [ON_TOP + [0.0, 0.0, 0.02] + (k - 6) * step for k in range(12)]
    for k, command in enumerate(commands):
        command[2] = max(ON_TOP[2] + 0.02 - 0.03 * max(0, k - 4), ON_TOP[2] - 0.003)
    ours, theirs = compared(commands, [True] * len(commands), MIDDLE)
    np.testing.assert_array_equal(ours.held, theirs.held)
    assert (theirs.held == 0).any()
    assert (theirs.held[-1] == 0) == holds
    if holds:
        assert math.dist(ours.position[-1], theirs.position[-1]) < 1e-3


@pytest.mark.parametrize("way", [(0.03, 0.0, 0.0), (0.0, 0.02, 0.01), (0.015, -0.02, -0.004)])
def test_what_is_thrown_comes_to_rest_where_it_does_in_pybullet(way: Vector) -> None:
    top = ON_TOP + [0.0, 0.0, 0.06]
    ends = [top + i * np.array(way) for i in range(6)]
    commands = [ON_TOP, *line(ON_TOP, ON_TOP, 4), *line(ON_TOP, top, 5), *ends[1:], *[ends[-1]] * 9]
    on = [True] * 12 + [False] * (len(commands) - 13)
    ours, theirs = compared(commands, on, MIDDLE)
    np.testing.assert_array_equal(ours.held, theirs.held)
    assert math.dist(theirs.position[0], theirs.position[-1]) > 0.05
    assert math.dist(ours.position[-1], theirs.position[-1]) < 2e-4


@pytest.mark.parametrize(("offset", "steps"), [(0.0, 6), (0.008, 12), (0.016, 20), (0.022, 12)])
@pytest.mark.parametrize("depth", [0.0003, 0.0015])
def test_a_shove_ends_where_it_does_in_pybullet(offset: float, steps: int, depth: float) -> None:
    start = ON_TOP + [-0.05, offset, -depth]
    commands = [start, *line(start, start + [0.08, 0.0, 0.0], steps, 6)]
    ours, theirs = compared(commands, [False] * len(commands), MIDDLE)
    assert math.dist(theirs.position[0], theirs.position[-1]) > 0.005
    assert math.dist(ours.position[-1], theirs.position[-1]) < 2e-3
    assert max(ours.tilt.max(), theirs.tilt.max()) < math.radians(0.5)


@pytest.mark.parametrize("steps", [5, 8, 12])
def test_a_low_shove_tips_it_as_far_as_in_pybullet(steps: int) -> None:
    start = ON_TOP + [-0.05, 0.0, -0.0029]
    commands = [start, *line(start, start + [0.08, 0.0, 0.0], steps, 8)]
    ours, theirs = compared(commands, [False] * len(commands), MIDDLE)
    assert theirs.tilt.max() > math.radians(0.5)
    assert ours.tilt.max() == pytest.approx(theirs.tilt.max(), rel=0.42)
    assert math.dist(ours.position[-1], theirs.position[-1]) < 2e-3


def test_a_press_without_vacuum_moves_nothing() -> None:
    low = ON_TOP + [0.004, 0.0, -0.0025]
    commands = [ON_TOP + [0.004, 0.0, 0.03], *line(ON_TOP + [0.004, 0.0, 0.03], low, 4, 2)]
    commands += line(low, low + [0.008, 0.0, 0.0], 4, 2)
    ours, theirs = compared(commands, [False] * len(commands), MIDDLE)
    assert math.dist(ours.position[-1], theirs.position[-1]) < 2e-5
    lift = CUP.preload + CUP.link("platform", (0.0, 0.0, 0.0)).mass * GRAVITY
    assert ours.force[-1] == pytest.approx([0.0, 0.0, lift])


@pytest.mark.parametrize("way", [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)])
@pytest.mark.parametrize("depth", [0.0025, 0.006])
def test_a_lip_dragged_over_an_edge_tips_it_as_in_pybullet(way: Vector, depth: float) -> None:
    high, low = ON_TOP + [0.0, 0.0, 0.01], ON_TOP + [0.0, 0.0, -depth]
    end = low + 0.05 * np.array(way)
    commands = [high, *line(high, low, 3, 2), *line(low, end, 4, 8)]
    ours, theirs = compared(commands, [False] * len(commands), MIDDLE)
    assert theirs.tilt.max() > math.radians(20)
    assert ours.tilt.max() == pytest.approx(theirs.tilt.max(), rel=0.15)
    assert math.dist(ours.position[-1], theirs.position[-1]) < 3e-3
    assert max(ours.tilt[-1], theirs.tilt[-1]) < 1e-3


# -- by the laws --------------------------------------------------------------------------------


def straight(height: FloatArray) -> FloatArray:
    """A path (k, 3) over the middle, by the height of the lip."""
    return MIDDLE * [1.0, 1.0, 0.0] + np.array([0.0, 0.0, 1.0]) * (height[:, None] + CUP.length)


def test_what_stands_alone_keeps_its_bits_and_what_falls_comes_to_rest() -> None:
    blocks = Blocks(BLOCK, 2, STEP)
    blocks.place(ALL, np.array([[0.0, 0.0, 0.015], [0.1, 0.0, 0.2]]))
    path = np.zeros((STEPS + 2, 3, 2)) + np.array([0.0, 0.0, 0.5])[:, None]
    for _ in range(15):
        blocks.advance(ALL, path, np.zeros(2, dtype=bool))
    before = blocks.report()
    assert before["object_position"][:, 0, 2] == pytest.approx([0.015, 0.015], abs=2e-5)
    blocks.advance(ALL, path, np.zeros(2, dtype=bool))
    for name, value in blocks.report().items():
        np.testing.assert_array_equal(value, before[name])


@pytest.mark.parametrize(("acceleration", "kept"), [(220.0, True), (235.0, False)])
def test_what_is_pulled_harder_than_the_vacuum_can_comes_off(
    acceleration: float, kept: bool
) -> None:
    # 12 N on 50 g are 230.2 m/s^2 beside the weight
    times = STEP * np.arange(8)
    path = straight(BLOCK.height + np.concatenate([np.zeros(62), acceleration * times**2 / 2]))
    ours = analytic(path, [True] * 7, MIDDLE, batch=1)
    assert (ours.held[-2:] == 0).all() == kept
    if kept:
        total = BLOCK.mass * (GRAVITY + acceleration)
        assert ours.force[-1] == pytest.approx([0.0, 0.0, -total], rel=1e-3)


def test_a_heavier_one_comes_off_and_a_smoother_one_slides_farther() -> None:
    blocks = Blocks(BLOCK, 3, STEP)
    blocks.place(ALL, np.tile(MIDDLE, (3, 1)))
    blocks.alter(ALL, np.array([1.0, 1.0, 30.0]), np.array([1.0, 0.5, 1.0]))
    rising = np.minimum(np.maximum(np.arange(-92, 90), 0), 20) * 0.0002
    moving = np.maximum(np.arange(-132, 50), 0) * 0.4 * STEP
    path = straight(BLOCK.height + rising) + moving[:, None] * [1.0, 0.0, 0.0]
    path = np.repeat(path[:, :, None], 3, axis=2)
    for k in range(180):
        if k == 148:
            assert blocks.report()["held"].tolist() == [0, 0, -1]
            dropped = blocks.report()["object_position"][:, 0, 0]
        blocks.advance(ALL, path[k : k + 3], np.full(3, k < 148))
    assert blocks.report()["held"].tolist() == [-1] * 3
    still = path[-1:].repeat(3, axis=0) + np.array([0.0, 0.0, 0.2])[:, None]
    for _ in range(150):
        blocks.advance(ALL, still, np.zeros(3, dtype=bool))
    ways = blocks.report()["object_position"][:, 0, 0] - dropped
    assert 0.005 < ways[0] < ways[1]
    assert ways[2] == 0.0


def test_without_friction_the_platform_takes_what_the_block_gains() -> None:
    blocks = Blocks(BLOCK, 1, STEP)
    blocks.place(ALL, MIDDLE[None])
    blocks.alter(ALL, np.ones(1), np.full(1, 1e-9))
    start = ON_TOP + [-0.05, 0.005, -0.001]
    path = spline([start, *line(start, start + [0.08, 0.0, 0.0], 8)])
    gained = np.zeros(3)
    for k in range(len(path) - 2):
        force = blocks.advance(ALL, path[k : k + 3, :, None], np.zeros(1, dtype=bool))
        gained -= STEP * force[0, :, 0]
    velocity = blocks.report()["object_velocity"][0, 0]
    assert velocity[0] > 0.1
    np.testing.assert_allclose(gained[:2], BLOCK.mass * velocity[:2], rtol=1e-6, atol=1e-9)


def test_a_fast_low_shove_lays_it_on_its_side_where_the_cup_cannot_hold_it() -> None:
    start = ON_TOP + [-0.05, 0.0, -0.0029]
    commands = [start, *line(start, start + [0.08, 0.0, 0.0], 2, 14)]
    ours = analytic(spline(commands), [False] * 16, MIDDLE)
    assert ours.tilt[-1] == pytest.approx(math.pi / 2, abs=0.02)
    assert ours.position[-1, 2] == pytest.approx(BLOCK.width / 2, abs=2e-4)


def test_beyond_the_table_it_falls_to_the_floor() -> None:
    blocks = Blocks(BLOCK, 2, STEP, table=(0.3, 0.3))
    blocks.place(ALL, np.array([[0.29, 0.0, 0.015], [0.31, 0.0, 0.015]]))
    path = np.zeros((STEPS + 2, 3, 2)) + np.array([0.0, 0.0, 0.5])[:, None]
    for _ in range(30):
        blocks.advance(ALL, path, np.zeros(2, dtype=bool))
    assert blocks.report()["object_position"][:, 0, 2] == pytest.approx([0.015, -0.485], abs=2e-5)


def test_without_objects_there_is_nothing_to_report() -> None:
    blocks = Blocks(None, 3, STEP)
    assert not blocks.advance(ALL, np.zeros((12, 3, 3)), np.ones(3, dtype=bool)).any()
    report = blocks.report()
    assert report["object_position"].shape == (3, 0, 3)
    assert report["object_quaternion"].shape == (3, 0, 4)
    assert report["held"].tolist() == [-1] * 3
    assert not report["vacuum"].any()


# -- in batches -----------------------------------------------------------------------------------


def crowd(count: int, seed: int, periods: int = 8) -> tuple[FloatArray, FloatArray]:
    """Blocks (n, 3), and ways (2 + k, 3, n) of P that pick, shove, tip, press and throw."""
    rng = np.random.default_rng(seed)
    blocks = np.concatenate([rng.uniform(-0.02, 0.02, (count, 2)), np.full((count, 1), 0.015)], 1)
    stops = np.zeros((periods + 1, count, 3))
    stops[..., :2] = 0.5 * rng.uniform(-0.06, 0.06, (periods + 1, count, 2))
    stops[..., 2] = 0.067 + np.maximum(rng.uniform(-0.02, 0.03, (periods + 1, count)), 0.0)
    ways = [spline(list(stops[:, row])) for row in range(count)]
    return blocks, np.stack(ways, axis=2)


def history(blocks: FloatArray, ways: FloatArray, on: FloatArray) -> list[FloatArray]:
    """All that is reported, and all forces, after each control period."""
    batch = Blocks(BLOCK, len(blocks), STEP)
    batch.place(ALL, blocks)
    seen = []
    for period, k in enumerate(range(0, len(ways) - 2, STEPS)):
        seen.append(batch.advance(ALL, ways[k : k + STEPS + 2], on[period]).T)
        seen += batch.report().values()
    return seen


def digest() -> str:
    """Of everything that happens to a crowd."""
    on = np.random.default_rng(3).random((8, 48)) < 0.6
    return hashlib.sha256(
        b"".join(part.tobytes() for part in history(*crowd(48, 2), on))
    ).hexdigest()


def test_compiled_code_gives_the_bits_that_python_gives() -> None:
    script = (
        "import sys; sys.path.insert(0, sys.argv[1]); import test_blocks as t; print(t.digest())"
    )
    plain = subprocess.run(
        [sys.executable, "-c", script, Path(__file__).parent],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"},
        check=True,
        capture_output=True,
        text=True,
    )
    assert plain.stdout.strip() == digest()


def test_a_row_has_the_same_bits_alone_and_among_others() -> None:
    count = 1024
    blocks, ways = crowd(count, seed=0)
    on = np.random.default_rng(1).random((8, count)) < 0.6
    everything = history(blocks, ways, on)
    axis = everything[4]
    assert axis.shape == (count, 1, 3)
    tilted = np.concatenate([part[:, 0, 2] < 0.99 for part in everything[4::8]])
    assert tilted.any()
    assert any((part == 0).any() for part in everything[6::8])
    # Those that have tilted, and some others
    worst = np.argsort(np.min([part[:, 0, 2] for part in everything[4::8]], axis=0))
    for rows in (worst[:1], worst[1:2], np.array([5]), worst[2:9], np.append(worst[:4], [9, 8, 7])):
        few = history(blocks[rows], np.ascontiguousarray(ways[:, :, rows]), on[:, rows])
        for part, whole in zip(few, everything, strict=True):
            np.testing.assert_array_equal(part, whole[rows])


def test_rows_may_be_advanced_apart_and_go_on_from_what_was_saved() -> None:
    blocks, ways = crowd(12, seed=3)
    on = np.ones((8, 12), dtype=bool)
    whole = history(blocks, ways, on)
    batch, other = Blocks(BLOCK, 12, STEP), Blocks(BLOCK, 12, STEP)
    batch.place(ALL, blocks)
    odd, even = np.arange(1, 12, 2), np.arange(0, 12, 2)
    for period, k in enumerate(range(0, len(ways) - 2, STEPS)):
        steps = ways[k : k + STEPS + 2]
        for rows in (odd, even):
            batch.advance(rows, np.ascontiguousarray(steps[:, :, rows]), on[period, rows])
        if period == 4:  # and go on in another one
            other.restore(ALL, batch.save(ALL))
            batch = other
    for part, expected in zip(batch.report().values(), whole[-7:], strict=True):
        np.testing.assert_array_equal(part, expected)


def test_time_steps_one_by_one_or_ten_at_once_are_the_same() -> None:
    high, low = ON_TOP + [0.0, 0.0, 0.05], ON_TOP + [0.0, 0.0, -0.0006]
    commands = [high, *line(high, low, 5, 3), *line(low, high + [0.05, 0.0, 0.0], 6, 2)]
    path = spline(commands)
    on = [True] * 12 + [False] * 5
    one, ten = analytic(path, on, MIDDLE, batch=1), analytic(path, on, MIDDLE)
    np.testing.assert_allclose(one.position[9::10], ten.position, atol=1e-12)
    np.testing.assert_allclose(one.force[9::10], ten.force, atol=1e-6)
