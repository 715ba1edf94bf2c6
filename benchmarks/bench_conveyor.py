"""Picks a minute from a belt: the expert, beside what the supply and the robot's limits allow.

    python benchmarks/bench_conveyor.py

A stream is one episode with nine blocks, which the robot brings from the belt to nine places in
the tray, in the order in which they come. Each row is a time between blocks (headway). The bound of
the limits is the time of the ways at the largest speed along each axis, from each place to the end
of the belt and back, with one control step each to seal and to let go; no controller can be
faster. Results go to docs/records/conveyor.json, and from there to docs/conveyor.md.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike
from shared import ROOT, describe, fill, provenance, read_record, table

from tpm_gym import TPMVectorEnv
from tpm_gym.arrays import FloatArray
from tpm_gym.simulation.state import CONTROL_PERIOD, Block, Scene
from tpm_gym.tasks import Conveyor, Expert
from tpm_gym.tasks.conveyor import EDGE, LATEST

RECORD = ROOT / "docs" / "records" / "conveyor.json"
PAGE = ROOT / "docs" / "conveyor.md"
COLUMNS, LAYERS = 3, 3
COUNT: Final = COLUMNS * LAYERS
PITCH: Final = 0.050
"""Distance of the columns, m."""
SPEEDS: Final = (0.05, 0.12)
"""Slowest and fastest belt, m/s."""
HEADWAYS: Final = (1.0, 1.2, 1.3, 1.4, 1.6, 2.0)
"""Times between blocks, s."""
SPREAD: Final = 0.1
"""Largest deviation of a time between blocks, as a fraction."""
_COLOURS: Final = ((0.83, 0.18, 0.33, 1.0), (0.16, 0.36, 0.80, 1.0), (0.95, 0.60, 0.10, 1.0))


class Stream(Conveyor):
    """Bring nine blocks from a running belt to the tray, one after the other.

    Attributes:
        headway: Mean time between blocks, s.
    """

    headway = 1.8
    blocks = tuple(Block(f"block_{k}", colour=_COLOURS[k // LAYERS]) for k in range(COUNT))
    block = blocks[0]
    scene = Scene(objects=blocks, markers=COUNT, marker_radius=0.005)
    goal_size = 3 * COUNT
    samplings = ("sampled",)
    max_episode_steps = 600
    upstream = 0.30 + SPEEDS[1] * (LATEST + (1 + SPREAD) * max(HEADWAYS) * (COUNT - 1))

    def sample(
        self, rngs: Sequence[np.random.Generator], chosen: Mapping[str, FloatArray]
    ) -> dict[str, FloatArray]:
        """See the base class."""
        speed = np.array([rng.uniform(*SPEEDS, 1) for rng in rngs])
        places = self.places()
        goal = np.tile(places.ravel(), (len(rngs), 1))
        first = super().sample(rngs, {"belt_speed": speed, "goal": goal})
        starts, place = {"belt_speed": speed, "goal": goal}, first["object"]
        for block in self.blocks:
            starts[block.name] = place.copy()
            waits = [self.headway * (1 + SPREAD * rng.uniform(-1, 1)) for rng in rngs]
            place[:, 0] -= waits * speed[:, 0]
            place[:, 1] = super().sample(rngs, {"belt_speed": speed, "goal": goal})["object"][:, 1]
        return starts | dict(chosen)

    def places(self) -> FloatArray:
        """Return the places of the blocks in the tray, (k, 3) m, world."""
        (low, high), height = self._floor, self.block.height
        # The farthest column comes first, so that no block is carried through another.
        along, level = COLUMNS - 1 - np.arange(COUNT) // LAYERS, np.arange(COUNT) % LAYERS
        middle = (self.belt.end + EDGE + high[0]) / 2 + PITCH * (along - (COLUMNS - 1) / 2)
        across = np.full(COUNT, (low[1] + high[1]) / 2)
        return np.stack([middle, across, height / 2 + level * height], axis=1)

    def goals_of(self, block: Block | None) -> list[tuple[FloatArray, FloatArray]]:
        """Return the tray, with all layers."""
        ((low, high),) = super().goals_of(block)
        high[2] = self.reach_of(block)[1][2]
        return [(low, high)]

    def gap(self, achieved: ArrayLike, desired: ArrayLike) -> FloatArray:
        """Return the largest distance of the blocks to their places, (...,) m."""
        ends = (np.reshape(goal, (*np.shape(goal)[:-1], -1, 3)) for goal in (achieved, desired))
        largest: FloatArray = super().gap(*ends).max(axis=-1)
        return largest


def run(headway: float, engine: str, episodes: int) -> dict[str, Any]:
    """Measure the expert at one time between blocks."""
    kind = type("Stream", (Stream,), {"headway": headway})
    with closing(TPMVectorEnv(kind, num_envs=episodes, engine=engine)) as envs:
        task, expert = envs.task, Expert(envs)
        observation, _ = envs.reset(seed=0)
        places = envs.goal.reshape(episodes, COUNT, 3)
        starts = envs.state.object_position.copy()
        done = np.full((episodes, COUNT), np.inf)
        for step in range(1, Stream.max_episode_steps + 1):
            observation, *_ = envs.step(expert.act(observation))
            state = envs.state
            near = np.linalg.norm(state.object_position - places, axis=-1) < task.tolerance
            near &= state.held[:, None] != np.arange(COUNT)
            done = np.where(near, np.minimum(done, step), np.inf)  # none may leave its place
            if near.all():
                break
    bound = np.mean([_bound(task, start) for start in starts])
    complete = np.isfinite(done).all(axis=1)
    ends = done[complete]
    picks = 60 * (COUNT - 1) / (CONTROL_PERIOD * (ends.max(axis=1) - ends.min(axis=1)))
    return {
        "headway": headway,
        "engine": engine,
        "streams": episodes,
        "complete": int(complete.sum()),
        "delivered": int(np.isfinite(done).sum()),
        "steps": int(ends.max()) if complete.any() else None,
        "picks_a_minute": float(picks.mean()) if complete.any() else None,
        "supply": 60 / headway,
        "bound": float(bound),
    }


def _bound(task: Any, starts: FloatArray) -> float:
    """Return the picks a minute of a robot that is limited by speed alone, for lanes (k, 3) m."""
    places, picks = task.places(), starts.copy()
    picks[:, 0], limit = task.belt.end, np.array(task.machine.step_limit)
    there = (np.abs(places - picks) / limit).max(axis=1)
    back = (np.abs(picks[1:] - places[:-1]) / limit).max(axis=1)
    steps = there[1:] + back + 2  # one step each to seal and to let go
    return float(60 / (CONTROL_PERIOD * steps.mean()))


def lines(record: dict[str, Any]) -> Iterator[str]:
    """Yield the table in Markdown."""
    if not record:
        yield "Not measured on this version yet: `make bench-conveyor`."
        return
    machine = record["machine"]
    yield f"`{machine['command']}`, tpm_gym {machine['versions']['tpm_gym']}:"
    yield ""
    yield from table(
        ["engine", "time between blocks", "streams complete", "picks a minute", "supply", "bound"],
        [
            [
                cell["engine"],
                f"{cell['headway']:g} s",
                f"{cell['complete']} of {cell['streams']}",
                "-" if cell["picks_a_minute"] is None else f"{cell['picks_a_minute']:.1f}",
                f"{cell['supply']:.1f}",
                f"{cell['bound']:.0f}",
            ]
            for cell in record["cells"]
        ],
    )


def main() -> None:
    """Parse the options, measure, write the record and fill the page."""
    parser = argparse.ArgumentParser(description="Picks a minute from a belt.")
    parser.add_argument("--streams", type=int, default=50)
    parser.add_argument("--bullet-streams", type=int, default=2)
    options = parser.parse_args()
    cells = []
    for engine, episodes in (("analytic", options.streams), ("pybullet", options.bullet_streams)):
        for headway in HEADWAYS if engine == "analytic" else HEADWAYS[3:4]:
            if episodes:
                cells.append(run(headway, engine, episodes))
                print(cells[-1], file=sys.stderr)
    record = {"machine": describe(sys.argv), "cells": cells}
    print("\n".join(lines(record)))
    provenance.write_json(RECORD, record)
    if PAGE.exists():
        fill(PAGE, "conveyor", lines(read_record(RECORD)))


if __name__ == "__main__":
    main()
