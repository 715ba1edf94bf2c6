"""Contact of the analytic engine against MuJoCo's and PyBullet's, and against itself.

    python benchmarks/contact_agreement.py [--cases 100]

Two blocks are let go on each other, pushed over, pushed side by side, dragged and put down. Rest
poses are compared with those of MuJoCo at 0.5 ms, and MuJoCo's own with those at 0.25 ms. A block
of 40 mm is struck by the lip at full speed, higher each time, until it topples, and off its middle.

How often a policy succeeds in each engine is measured by ``engine_limits.py``.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from contextlib import closing
from typing import NamedTuple

import numpy as np

from tpm_gym.arrays import FloatArray
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.tpm import WIDE_TPM
from tpm_gym.simulation.simulation import Simulation
from tpm_gym.simulation.state import Block, Scene

BLOCKS = Block("lower"), Block("upper")
TALL = Block("tall", height=0.040)
WIDTH, HEIGHT = BLOCKS[0].width, BLOCKS[0].height
MIDDLE = np.array([0.3, -0.36, 0.0])
KINDS = ("rest", "over", "side", "drag", "put")
HEIGHTS = (0.027, 0.0275, 0.028, 0.0285, 0.029, 0.0295, 0.030, 0.0305, 0.031, 0.032, 0.033, 0.034)
LOW, ASIDE = 0.012, 0.008
"""Height of the lip that strikes a block off its middle, and how far off, m."""
TOPPLED = math.radians(45)


class Case(NamedTuple):
    """Centres of k blocks (k, 3) m, commands (t, 3) m for point P, and the vacuum (t,)."""

    places: FloatArray
    commands: FloatArray
    vacuum: Sequence[bool]


class Outcome(NamedTuple):
    """Centres (k, 3) m at the end, and the largest tilt (k,) rad of the blocks."""

    places: FloatArray
    tilt: FloatArray

    @property
    def toppled(self) -> bool:
        """Whether a block has toppled."""
        return bool((self.tilt > TOPPLED).any())


def line(start: FloatArray, end: FloatArray, count: int) -> list[FloatArray]:
    """Return points from one to another without the first."""
    return [start + (end - start) * (k + 1) / count for k in range(count)]


def draw(kind: str, rng: np.random.Generator) -> Case:
    """Draw a case of a kind."""
    draw_one, turn = rng.uniform, rng.uniform(0.0, 2 * math.pi)
    if kind == "side":
        turn = 0.5 * math.pi * rng.integers(4)
    way = np.array([math.cos(turn), math.sin(turn), 0.0])
    side, up = np.array([-way[1], way[0], 0.0]), np.array([0.0, 0.0, 1.0])
    off = rng.uniform(0.0, 2 * math.pi)
    offset = np.array([math.cos(off), math.sin(off), 0.0])
    lower, count = MIDDLE + 0.5 * HEIGHT * up, int(rng.integers(4, 16))
    lip = MIDDLE + CUP.length * up  # point P with the lip on the table
    if kind == "rest":
        commands = [lip + 0.1 * up] * 18
        return Case(
            np.array([lower, lower + HEIGHT * up + draw_one(0.0, 0.024) * offset]),
            np.array(commands),
            [False] * 18,
        )
    if kind in ("over", "side"):
        if kind == "over":
            upper = lower + HEIGHT * up + draw_one(0.0, 0.012) * offset
            height, end = draw_one(HEIGHT + 0.002, 2 * HEIGHT - 0.002), draw_one(-0.024, 0.01)
        else:
            upper = lower + draw_one(WIDTH, WIDTH + 0.01) * way + draw_one(-0.015, 0.015) * side
            height, end = HEIGHT - draw_one(0.0005, 0.0029), draw_one(-0.005, 0.03)
        start = lip - 0.045 * way + draw_one(-0.014, 0.014) * side + height * up
        stop = start + (end + 0.045) * way
        commands = [start] * 2 + line(start, stop, count) + [stop] * 2 + line(stop, start, 6)
        commands += [start] * 10
        return Case(np.array([lower, upper]), np.array(commands), [False] * len(commands))
    if kind == "drag":
        upper = lower + HEIGHT * up + draw_one(0.0, 0.01) * offset
        top = lip + upper - lower + draw_one(-0.006, 0.006) * way
        top = top + (HEIGHT - draw_one(0.0, 0.002)) * up
        stop = top + draw_one(0.01, 0.05) * way
        commands = [top + 0.03 * up, *line(top + 0.03 * up, top, 3), *[top] * 3]
        commands += [*line(top, stop, count), *[stop] * 2]
        on = len(commands)
        commands += [*[stop] * 2, *line(stop, stop + 0.03 * up, 4), *[stop + 0.03 * up] * 8]
    else:
        upper = lower + 0.08 * way
        top = lip + 0.08 * way + (HEIGHT - 0.0005) * up
        over = lip + draw_one(0.0, 0.026) * offset + (2 * HEIGHT + 0.02) * up
        down = over - draw_one(0.019, 0.022) * up
        commands = [top + 0.05 * up, *line(top + 0.05 * up, top, 4), *[top] * 3]
        commands += [*line(top, top + 0.05 * up, 4), *line(top + 0.05 * up, over, 8), over]
        commands += [*line(over, down, 5), *[down] * 2]
        on = len(commands)
        commands += [*[down] * 2, *line(down, down + 0.04 * up, 4), *[down + 0.04 * up] * 10]
    vacuum = [True] * on + [False] * (len(commands) - on)
    return Case(np.array([lower, upper]), np.array(commands), vacuum)


def cases(count: int) -> list[Case]:
    """Draw cases, all kinds in turn."""
    kinds = [KINDS[k % len(KINDS)] for k in range(count)]
    return [draw(kind, np.random.default_rng([3, k])) for k, kind in enumerate(kinds)]


def strike(height: float, aside: float = 0.0) -> Case:
    """Return a case in which the lip, ``height`` m above the table, hits a block at full speed.

    The block's middle is ``aside`` m beside the lip's way.
    """
    start = MIDDLE + np.array([-0.09, 0.0, height + CUP.length])
    stop = start + np.array([0.12, 0.0, 0.0])
    commands = [start, *line(start, stop, 4), *[stop] * 10]
    place = MIDDLE + np.array([0.0, aside, TALL.height / 2])
    return Case(place[None], np.array(commands), [False] * len(commands))


def play(
    some: Sequence[Case], engine: str, time_step: float, blocks: Sequence[Block] = BLOCKS
) -> list[Outcome]:
    """Run cases in an engine."""
    scene, mount, outcomes = Scene(objects=tuple(blocks)), WIDE_TPM.mount, []
    physics = {"time_step": time_step}
    with closing(Simulation(scene, engine=engine, machine=WIDE_TPM, physics=physics)) as sim:
        for places, commands, vacuum in some:
            points, tilt = mount.to_paper(commands), np.zeros(len(blocks))
            start = {block.name: place[None] for block, place in zip(blocks, places, strict=True)}
            sim.reset(np.array([0]), WIDE_TPM.inverse(points[0]), start)
            for point, on in zip(points[1:], vacuum[1:], strict=True):
                sim.move(point[None], np.array([on]))
                axis = sim.state().object_axis[0]
                tilt = np.maximum(tilt, np.arccos(np.clip(axis[:, 2], -1.0, 1.0)))
            outcomes.append(Outcome(sim.state().object_position[0], tilt))
    return outcomes


def agreement(ours: Sequence[Outcome], theirs: Sequence[Outcome]) -> dict[str, float]:
    """Compare outcomes.

    Returns:
        ``toppled``, share of cases that topple in both or in neither; of those that topple in
        neither ``standing``, their number, ``near``, the share within 2 mm, and ``median``, m.
    """
    pairs = list(zip(ours, theirs, strict=True))
    standing = [(a, b) for a, b in pairs if not (a.toppled or b.toppled)]
    apart = np.array([np.linalg.norm(a.places - b.places, axis=1).max() for a, b in standing])
    return {
        "toppled": float(np.mean([a.toppled == b.toppled for a, b in pairs])),
        "standing": len(standing),
        "near": float((apart < 0.002).mean()),
        "median": float(np.median(apart)),
    }


def main() -> None:
    """Parse the options, run and print."""
    parser = argparse.ArgumentParser(description="Contact of the analytic engine against others.")
    parser.add_argument("--cases", type=int, default=100, help="with two blocks")
    some = cases(parser.parse_args().cases)
    reference = play(some, "mujoco", 0.0005)
    for engine, step in (
        ("mujoco", 0.00025),
        ("mujoco", 0.004),
        ("pybullet", 0.004),
        ("pybullet", 0.001),
        ("analytic", 0.004),
        ("analytic", 0.001),
    ):
        print(engine, step, agreement(play(some, engine, step), reference))
        struck = play([strike(height) for height in HEIGHTS], engine, step, [TALL])
        lowest = next(h for h, found in zip(HEIGHTS, struck, strict=True) if found.toppled)
        print(f"  a struck block topples from {1000 * lowest:.1f} mm on")
        (low,) = play([strike(LOW, ASIDE)], engine, step, [TALL])
        sideways = low.places[0, 1] - MIDDLE[1] - ASIDE
        print(
            f"  hit {1000 * ASIDE:.0f} mm off its middle it moves {1000 * sideways:.1f} mm sideways"
        )


if __name__ == "__main__":
    main()
