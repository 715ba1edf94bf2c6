"""Cycle times, torques and success of the expert of Cycle, in each engine, with each payload.

    make bench-cycle
    python benchmarks/bench_cycle.py --policy runs/cycle/best.json

A cycle is the way there and the way back, with servo drives, at the depth y in the middle of the
goals. A way ends when P is within 2 mm of the end for good, by the truth of the simulation, 4 ms
apart. The RMS of the torques is over both ways without a pause between them. With ``--write``,
results go to docs/records/cycle.json, and from there to docs/cycle.md. A run with ``--policy``
measures the policy alone; a run without it keeps the policy's rows.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from shared import ROOT, describe, make_parser, processor_line, publish, read_record, table

from tpm_gym import PAPER_TPM, load_policy
from tpm_gym.arrays import FloatArray
from tpm_gym.tasks import Expert
from tpm_gym.tasks.control import USABLE
from tpm_gym.tasks.cycle import CONTINUOUS, Cycle
from tpm_gym.tasks.timing import timed

ENV = "TPMCycle-v0"
RECORD, PAGE = ROOT / "docs" / "records" / "cycle.json", ROOT / "docs" / "cycle.md"
PAYLOADS = (0.1, 1.0, 3.0)
EPISODES = {"analytic": 1000, "pybullet": 1000, "mujoco": 1000}
SEED = 3_000_000

Act = Callable[[dict[str, Any]], Any]


def one_way(env: Any, goal: FloatArray, act: Act) -> dict[str, Any]:
    """Play an episode; return its time, and torques, conditioning and depth until then."""
    observation, _ = env.reset(seed=0, options={"goal": goal})
    distances, torques, conditioning, gate, done = [], [], [], [], False
    while not done:
        observation, _, _, done, info = env.step(act(observation))
        state = env.unwrapped.state
        distances.append(float(np.linalg.norm(state.platform_position - goal)))
        torques.append(state.torque)
        conditioning.append(info["conditioning"])
        gate.append(info["reward_terms"]["gate"])
    task: Cycle = env.unwrapped.task
    outside = np.flatnonzero(np.array(distances) >= task.tolerance)
    steps = int(outside[-1]) + 2
    return {
        "seconds": task.control_period * steps if steps <= len(distances) else None,
        "torques": np.array(torques)[:steps],
        "conditioning": min(conditioning),
        "gate": min(gate),
    }


def cycle(engine: str, payload: float, make: Callable[[Any], Act]) -> dict[str, Any]:
    """Play both ways, and return the figures of the cycle."""
    machine = replace(PAPER_TPM, payload=payload)
    with closing(gym.make(ENV, engine=engine, drive="servo", machine=machine)) as env:
        boxes = env.unwrapped.task.goals_of(None)  # type: ignore[attr-defined]
        act = make(env)
        ways = [one_way(env, (low + high) / 2, act) for low, high in reversed(boxes)]
    torques = np.concatenate([way["torques"] for way in ways])
    seconds = [way["seconds"] for way in ways]
    return {
        "engine": engine,
        "payload": payload,
        "seconds": None if None in seconds else round(sum(seconds), 4),
        "rms": np.sqrt((torques**2).mean(axis=0)).round(2).tolist(),
        "peak": np.abs(torques).max(axis=0).round(2).tolist(),
        "conditioning": round(min(way["conditioning"] for way in ways), 4),
        "gate": round(min(way["gate"] for way in ways), 3),
    }


def planned(payload: float) -> dict[str, Any]:
    """Return what the expert plans for both ways: time, torques, and the motion of P."""
    task = Cycle(replace(PAPER_TPM, payload=payload))
    peak = np.array([motor.effort for motor in task.machine.mechanism.motors])
    low, high = task.machine.goal_region.low[1], task.machine.goal_region.high[1]
    weight = np.array(task.machine.mount.free_fall)
    seconds, heat, speeds, changes, forces, torques = 0.0, np.zeros(3), [], [], [], []
    for backwards in (False, True):
        path = task.gate((low + high) / 2, backwards)
        times, needed = timed(task.machine, path, CONTINUOUS * peak, USABLE * peak)
        spans = np.diff(times)[:, None]
        rates = np.diff(path, axis=0) / spans
        change = np.diff(rates, axis=0) / ((spans[1:] + spans[:-1]) / 2)
        seconds, heat = seconds + times[-1], heat + spans[:, 0] @ needed**2
        speeds.append(np.linalg.norm(rates, axis=1).max())
        changes.append(np.linalg.norm(change, axis=1).max())
        forces.append(payload * np.linalg.norm(change - weight, axis=1).max())
        torques.append(np.abs(needed).max())
    return {
        "payload": payload,
        "seconds": round(seconds, 4),
        "rms": np.sqrt(heat / seconds).round(2).tolist(),
        "peak": round(float(max(torques)), 1),
        "speed": round(float(max(speeds)), 2),
        "acceleration": round(float(max(changes)), 1),
        "force": round(float(max(forces)), 1),
    }


def success(engine: str, episodes: int) -> dict[str, Any]:
    """Play the expert in episodes with goals of its task, with servo drives."""
    good = 0
    with closing(gym.make(ENV, engine=engine, drive="servo")) as env:
        expert = Expert(env)
        for seed in range(SEED, SEED + episodes):
            (observation, info), done = env.reset(seed=seed), False
            while not done:
                observation, _, _, done, info = env.step(expert.act(observation))
            good += info["is_success"]
    return {"engine": engine, "episodes": episodes, "successes": good}


def lines(record: dict[str, Any]) -> Iterator[str]:
    """Yield the tables of the page."""
    head = ["payload", "planned", *(row["engine"] for row in record["cycles"][: len(EPISODES)])]
    head += ["RMS", "peak", "1/cond(J)", "speed", "acceleration", "force"]
    rows = []
    for plan in record["plans"]:
        own = [row for row in record["cycles"] if row["payload"] == plan["payload"]]
        rows.append(
            [
                f"{plan['payload']:g} kg",
                f"{plan['seconds']:.3f} s",
                *(f"{row['seconds']:.3f} s" for row in own),
                f"{max(max(row['rms']) for row in own):.1f} N m",
                f"{max(max(row['peak']) for row in own):.0f} N m",
                f"{min(row['conditioning'] for row in own):.3f}",
                f"{plan['speed']:.1f} m/s",
                f"{plan['acceleration']:.0f} m/s^2",
                f"{plan['force']:.0f} N",
            ]
        )
    yield from table(head, rows)
    yield ""
    counts = [(row["successes"], row["episodes"], row["engine"]) for row in record["success"]]
    told = (f"{good} of {count} in {engine}" for good, count, engine in counts)
    yield f"Success of the expert with goals of the task: {', '.join(told)}."
    if record.get("policy"):
        yield ""
        yield from table(
            ["policy", "seconds", "beside the expert", "RMS", "peak"],
            [
                [
                    f"{row['engine']}, {row['payload']:g} kg",
                    "not there" if row["seconds"] is None else f"{row['seconds']:.3f} s",
                    "" if row["seconds"] is None else f"{100 * row['slower']:+.0f}%",
                    f"{max(row['rms']):.1f} N m",
                    f"{max(row['peak']):.0f} N m",
                ]
                for row in record["policy"]
            ],
        )
    yield ""
    yield f"{processor_line(record['conditions'])}; `{record['conditions']['command']}`."


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, and publish the record."""
    parser = make_parser("Measure the expert of Cycle.")
    parser.add_argument("--episodes", type=int, help="episodes of each engine (default: 1,000)")
    parser.add_argument("--policy", help="an exported policy to measure too, at 0.1 kg")
    options = parser.parse_args(argv)
    record = read_record(RECORD)
    if options.policy is None:
        record["conditions"] = describe(sys.argv)
        record["plans"] = [planned(load) for load in PAYLOADS]
        cases = [(engine, load) for load in PAYLOADS for engine in EPISODES]
        record["cycles"] = [cycle(*case, _expert) for case in cases]
        record["success"] = [
            success(engine, options.episodes or count) for engine, count in EPISODES.items()
        ]
    else:
        policy = load_policy(options.policy)
        record["policy"] = [cycle(engine, PAYLOADS[0], lambda _: policy.act) for engine in EPISODES]
    for row, own in zip(record.get("policy", []), record["cycles"], strict=False):
        if row["seconds"] is not None:
            row["slower"] = round(row["seconds"] / own["seconds"] - 1, 4)
    publish(record, RECORD, PAGE, "cycle", lines, write=options.write)


def _expert(env: Any) -> Act:
    return Expert(env).act


if __name__ == "__main__":
    main()
