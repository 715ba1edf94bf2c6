"""Picks a minute from a belt: the expert, beside what the supply and the robot's limits allow.

    python benchmarks/bench_conveyor.py
    python benchmarks/bench_conveyor.py --policies runs/study/TPMConveyorDense-v0-ppo-analytic-s?

A stream is one episode with nine blocks, which the robot brings from the belt to nine places in
the tray, in the order in which they come. Each row is a time between blocks (headway). The bound of
the limits is the time of the ways at the largest speed along each axis, from each place to the end
of the belt and back, with one control step each to seal and to let go; no controller can be
faster.

A learned policy knows one block, and places on the table. It plays a stream of three blocks, and is
shown the first one that is not in its place. It never learned to let go, as its task does not ask
for that: at the place, this script lets go and lifts the cup.

With ``--write``, results go to docs/records/conveyor.json, and from there to docs/conveyor.md. A
run without ``--policies`` keeps the rows of policies, and those of the expert in their streams.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, ClassVar, Final, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from shared import ROOT, describe, made_by, make_parser, publish, read_record, table

from tpm_gym import TPMVectorEnv, load_policy
from tpm_gym.arrays import FloatArray
from tpm_gym.simulation.state import CONTROL_PERIOD, Block, Scene
from tpm_gym.tasks import Conveyor, Expert
from tpm_gym.tasks.conveyor import EDGE, LATEST

RECORD = ROOT / "docs" / "records" / "conveyor.json"
PAGE = ROOT / "docs" / "conveyor.md"
COLUMNS: Final = 3
LAYERS: Final = 3
"""Blocks upon each other in each column; 1 for a learned policy."""
PITCH: Final = 0.050
"""Distance of the columns, m."""
SPEEDS: Final = (0.05, 0.12)
"""Slowest and fastest belt, m/s."""
HEADWAYS: Final = (0.9, 1.0, 1.1, 1.2, 1.4, 2.0)
"""Times between blocks, s."""
OTHER_HEADWAYS: Final = (1.1, 1.2)
"""Times between blocks in PyBullet and MuJoCo, s."""
SPREAD: Final = 0.1
"""Largest deviation of a time between blocks, as a fraction."""
LIFTING: Final = 3
"""Control steps in which the cup leaves a block that a learned policy has brought."""
_COLOURS: Final = ((0.83, 0.18, 0.33, 1.0), (0.16, 0.36, 0.80, 1.0), (0.95, 0.60, 0.10, 1.0))


class Stream(Conveyor):
    """Bring blocks from a running belt to the tray, one after the other; see :func:`stream`.

    Attributes:
        headway: Mean time between blocks, s.
        layers: Number of blocks upon each other.
    """

    headway: ClassVar[float]
    layers: ClassVar[int]
    samplings = ("sampled",)
    max_episode_steps = 600
    upstream = 0.30 + SPEEDS[1] * (LATEST + (1 + SPREAD) * max(HEADWAYS) * (COLUMNS * LAYERS - 1))

    def sample(
        self, rngs: Sequence[np.random.Generator], chosen: Mapping[str, FloatArray]
    ) -> dict[str, FloatArray]:
        """See the base class."""
        speed = np.array([rng.uniform(*SPEEDS, 1) for rng in rngs])
        places = self.places()
        goal = np.tile(places.ravel(), (len(rngs), 1))
        first = super().sample(rngs, {"belt_speed": speed, "goal": goal})
        starts, place = {"belt_speed": speed, "goal": goal}, first["object"]
        for block in self.scene.objects:
            starts[block.name] = place.copy()
            waits = [self.headway * (1 + SPREAD * rng.uniform(-1, 1)) for rng in rngs]
            place[:, 0] -= waits * speed[:, 0]
            place[:, 1] = super().sample(rngs, {"belt_speed": speed, "goal": goal})["object"][:, 1]
        return starts | dict(chosen)

    def places(self) -> FloatArray:
        """Return the places of the blocks in the tray, (k, 3) m, world."""
        (low, high), height = self._floor, self.block.height
        # The farthest column comes first, so that no block is carried through another.
        order = np.arange(COLUMNS * self.layers)
        along, level = COLUMNS - 1 - order // self.layers, order % self.layers
        middle = (self.belt.end + EDGE + high[0]) / 2 + PITCH * (along - (COLUMNS - 1) / 2)
        across = np.full(len(order), (low[1] + high[1]) / 2)
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


def stream(headway: float, layers: int) -> type[Stream]:
    """Return the task with ``layers`` blocks upon each other in each column."""
    count = COLUMNS * layers
    blocks = [Block(f"block_{k}", colour=_COLOURS[k // layers]) for k in range(count)]
    scene = Scene(objects=tuple(blocks), markers=count, marker_radius=0.005)
    own = {"block": blocks[0], "scene": scene, "goal_size": 3 * count}
    return type("Stream", (Stream,), {"headway": headway, "layers": layers, **own})


class OneByOne:
    """Policy for one block that plays a stream, each time with the first block not in its place."""

    def __init__(self, path: Path, task: Any, count: int) -> None:
        """Load an exported policy for ``count`` streams."""
        self._policy, self._task, self._alone = load_policy(path), task, Conveyor(task.machine)
        self._index, self._lifting = np.zeros((2, count), np.intp)

    def act(self, observation: Mapping[str, Any]) -> NDArray[Any]:
        """Return the actions (n, 4)."""
        seen = self._task.decode(observation["observation"])
        rows, names = np.arange(len(seen["position"])), [b.name for b in self._task.scene.objects]
        places = np.stack([seen[f"{name}_position"] for name in names], axis=1)
        held = np.stack([seen[f"{name}_held"][:, 0] > 0.5 for name in names], axis=1)
        goals = observation["desired_goal"].reshape(places.shape)
        now = self._index
        there = np.linalg.norm(places - goals, axis=-1)[rows, now] < self._task.tolerance
        free = there & ~held[rows, now]
        self._lifting = np.where(free, LIFTING, np.maximum(self._lifting - 1, 0))
        self._index = now = np.minimum(now + free, len(names) - 1)

        def value(entry: str) -> FloatArray:
            if entry in seen:
                return seen[entry]
            own = entry.removeprefix(self._alone.block.name)
            chosen: FloatArray = np.stack([seen[name + own] for name in names], axis=1)[rows, now]
            return chosen

        shown = [
            (value(e.name) - np.array(e.centre)) / np.array(e.scale) for e in self._alone.entries
        ]
        actions = self._policy.act(
            {
                "observation": np.concatenate(shown, axis=1).astype(np.float32),
                "achieved_goal": places[rows, now].astype(np.float32),
                "desired_goal": goals[rows, now].astype(np.float32),
            }
        )
        actions[there & ~free] = (0.0, 0.0, 0.0, -1.0)
        actions[self._lifting > 0] = (0.0, 0.0, -1.0, -1.0)  # paper z points down
        return actions


def run(
    headway: float, engine: str, episodes: int, layers: int = LAYERS, folder: Path | None = None
) -> dict[str, Any]:
    """Measure the expert, or the best policy of a run folder, at one time between blocks."""
    kind, count = stream(headway, layers), COLUMNS * layers
    with closing(TPMVectorEnv(kind, num_envs=episodes, engine=engine)) as envs:
        task, player = envs.task, cast("Any", Expert(envs))
        if folder is not None:
            player = OneByOne(folder / "best.json", task, episodes)
        observation, _ = envs.reset(seed=0)
        places = envs.goal.reshape(episodes, count, 3)
        starts = envs.state.object_position.copy()
        done = np.full((episodes, count), np.inf)
        for step in range(1, Stream.max_episode_steps + 1):
            observation, *_ = envs.step(player.act(observation))
            state = envs.state
            near = np.linalg.norm(state.object_position - places, axis=-1) < task.tolerance
            near &= state.held[:, None] != np.arange(count)
            done = np.where(near, np.minimum(done, step), np.inf)  # none may leave its place
            if near.all():
                break
    bound = np.mean([_bound(task, start) for start in starts])
    complete = np.isfinite(done).all(axis=1)
    ends = done[complete]
    picks = 60 * (count - 1) / (CONTROL_PERIOD * (ends.max(axis=1) - ends.min(axis=1)))
    return {
        "player": "expert" if folder is None else f"policy, seed {folder.name.rpartition('-s')[2]}",
        "blocks": count,
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
    yield f"{made_by(record['machine'])}:"
    if "policies_machine" in record:
        yield f"three blocks by {made_by(record['policies_machine'])}."
    yield ""
    head = ["player", "engine", "blocks", "time between blocks", "streams complete"]
    yield from table(
        [*head, "picks a minute", "supply", "bound"],
        [
            [
                cell["player"],
                cell["engine"],
                str(cell["blocks"]),
                f"{cell['headway']:g} s",
                f"{cell['complete']} of {cell['streams']}",
                "-" if cell["picks_a_minute"] is None else f"{cell['picks_a_minute']:.1f}",
                f"{cell['supply']:.1f}",
                f"{cell['bound']:.0f}",
            ]
            for cell in record["cells"]
        ],
    )


def merged(
    old: dict[str, Any], machine: dict[str, Any], cells: list[dict[str, Any]]
) -> dict[str, Any]:
    """Return the record of new rows; where they have no policies, rows for these stay."""
    if any(cell["blocks"] == COLUMNS for cell in cells):
        return {"machine": machine, "cells": cells}
    kept = [cell for cell in old.get("cells", []) if cell["blocks"] == COLUMNS]
    made_by = {"policies_machine": old.get("policies_machine", old["machine"])} if kept else {}
    return {"machine": machine, **made_by, "cells": [*cells, *kept]}


def measure(streams: int, fewer: int, policies: Sequence[Path]) -> Iterator[dict[str, Any]]:
    """Yield all rows: nine blocks, and three blocks where a policy plays too."""
    for headway in HEADWAYS:
        yield run(headway, "analytic", streams)
    for engine in ("pybullet", "mujoco"):
        for headway in OTHER_HEADWAYS:
            yield run(headway, engine, fewer)
    for player in (None, *policies) if policies else ():
        yield run(OTHER_HEADWAYS[-1], "analytic", streams, 1, player)
        yield run(OTHER_HEADWAYS[-1], "pybullet", fewer, 1, player)


def main() -> None:
    """Parse the options, measure and publish the record."""
    parser = make_parser("Picks a minute from a belt.")
    parser.add_argument("--streams", type=int, default=50, help="in the analytic engine")
    parser.add_argument("--fewer", type=int, default=10, help="in PyBullet and MuJoCo")
    parser.add_argument(
        "--policies", nargs="+", type=Path, default=(), help="run folders to measure too"
    )
    options = parser.parse_args()
    cells = []
    for cell in measure(options.streams, options.fewer, options.policies):
        cells.append(cell)
        print(cell, file=sys.stderr)
    record = merged(read_record(RECORD), describe(sys.argv), cells)
    publish(record, RECORD, PAGE, "conveyor", lines, write=options.write)


if __name__ == "__main__":
    main()
