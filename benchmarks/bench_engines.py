"""Compare PyBullet, MuJoCo and theory on the same commands, and policies over engines and drives.

    make bench-engines
    python benchmarks/bench_engines.py --quick
    python benchmarks/bench_engines.py --renew motions expert

Agreement: the actions of five motions are recorded once and replayed in each engine. The table has
the largest loop gap, the largest distance of the platform from the forward kinematics of the
encoders, differences of the torques from the other engine and from closed-form dynamics, and
differences of the final position of the block. Energy: share that is lost in a fall of 0.16 s with
the motors off. Cost: control steps of TPMPickAndPlace-v0 with random actions, in blocks that take
turns.

Matrix: success of the expert and of the published policies in each engine with each drive, with and
without noise on their actions, which makes them drop, throw and shove.

With ``--write``, results go to docs/records/engines.json, and from there to docs/engines.md and
docs/images/engines.png.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import shared
from engine_agreement import PICK, Trace, energy_lost, follow, motions
from engine_matrix import IDS, Cell, cells, run_all
from engine_report import RECORD, lines, publish
from shared import provenance, read_record

ENGINES = ("pybullet", "mujoco")
ROUNDS, BLOCK = 20, 100
"""Rounds of timing, and control steps in a block."""
EPISODES = 1000
"""Episodes of a cell of the matrix."""
REPEATS = 20
"""Episodes of a motion."""


def agreement(engines: Sequence[str], episodes: int) -> list[dict[str, Any]]:
    """Return a row for each motion and engine."""
    rows = []
    for motion in motions(episodes):
        print(f"following: {motion.name}", file=sys.stderr)
        traces = {engine: follow(motion, engine) for engine in engines}
        reference = traces[engines[0]]
        rows += [
            {"motion": motion.name, "engine": engine, **_compare(trace, reference)}
            for engine, trace in traces.items()
        ]
    return rows


def _compare(trace: Trace, reference: Trace) -> dict[str, Any]:
    """Compare a motion in one engine with the first engine and with theory."""
    rms = float(np.sqrt((trace.torque**2).mean()))
    apart = np.linalg.norm(trace.block - reference.block, axis=-1)
    return {
        "gap_max": float(trace.gap.max()),
        "apart_max": float(trace.apart.max()),
        "torque_rms": rms,
        "torque_peak": float(np.abs(trace.torque).max()),
        "off_engine": _off(trace.torque, reference.torque),
        "off_theory": _off(trace.torque, trace.theory) if trace.theory.size else None,
        "block_median": float(np.median(apart)) if apart.size else None,
        "block_max": float(apart.max()) if apart.size else None,
    }


def _off(torque: Any, other: Any) -> float:
    """Return the relative root mean square of a difference of torques."""
    return float(np.sqrt(((torque - other) ** 2).mean() / (other**2).mean()))


def costs(engines: Sequence[str], rounds: int) -> dict[str, list[float]]:
    """Measure the seconds of a control step in each round; engines take turns."""
    spent: dict[str, list[float]] = {engine: [] for engine in engines}
    envs = {engine: gym.make(PICK, engine=engine) for engine in engines}
    rng = np.random.default_rng(0)
    for number in range(rounds):
        actions = rng.uniform(-1.0, 1.0, (BLOCK, 4)).astype(np.float32)
        for engine in engines if number % 2 else reversed(engines):
            env = envs[engine]
            start = time.perf_counter()
            for k, action in enumerate(actions):
                if k % 50 == 0:
                    env.reset(seed=number)
                env.step(action)
            spent[engine].append((time.perf_counter() - start) / BLOCK)
    for env in envs.values():
        env.close()
    return spent


def matrix(todo: list[Cell], jobs: int) -> list[dict[str, Any]]:
    """Evaluate cells and print each result; return the records."""
    done = []
    for record in run_all(todo, jobs):
        success = record["metrics"]["success_at_end"]["mean"]
        shown = ("env_id", "policy", "noise", "engine", "drive")
        print(*(record[key] for key in shown), f"{100 * success:.1f}%", file=sys.stderr)
        done.append(record)
    return done


def renewed(record: dict[str, Any], parts: Sequence[str], jobs: int) -> dict[str, Any]:
    """Return a record of which some parts are measured again."""
    again: dict[str, Any] = {"renewed": shared.describe(sys.argv)}
    if "motions" in parts:
        again["agreement"] = agreement(ENGINES, REPEATS)
    if "cost" in parts:
        again["cost"] = costs(ENGINES, ROUNDS)
    fresh = matrix([cell for cell in cells(ENGINES, EPISODES) if cell.policy in parts], jobs)
    kept = [old for old in record["matrix"] if old["policy"] not in parts]
    return record | again | {"matrix": sorted(kept + fresh, key=_place)}


def _place(cell: dict[str, Any]) -> tuple[Any, ...]:
    """Place of a cell in the table."""
    return cell["env_id"], cell["policy"] != "expert", cell["noise"]


def main() -> None:
    """Parse the options and run."""
    parser = shared.make_parser("Compare engines and theory.", quick="some minutes")
    parser.add_argument("--jobs", type=int, default=1, help="processes for the matrix")
    parts = ("motions", "cost", "expert", *IDS)
    parser.add_argument("--renew", nargs="+", choices=parts, help="measure only these again")
    parser.add_argument("--redraw", action="store_true", help="picture and page from the records")
    options = parser.parse_args()
    if options.redraw:
        publish()
        return
    if options.renew:
        record = renewed(read_record(RECORD), options.renew, options.jobs)
    else:
        quick = options.quick
        record = {
            "machine": shared.describe(sys.argv),
            "agreement": agreement(ENGINES, 3 if quick else REPEATS),
            "energy_lost": {engine: energy_lost(engine) for engine in ENGINES},
            "cost": costs(ENGINES, 4 if quick else ROUNDS),
            "matrix": matrix(cells(ENGINES, 10 if quick else EPISODES), options.jobs),
        }
    print("\n".join(lines(record)))
    if options.write:
        provenance.write_json(RECORD, record)
        publish()


if __name__ == "__main__":
    main()
