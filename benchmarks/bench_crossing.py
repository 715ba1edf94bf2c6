"""Passages of y = 0 in each engine: the expert, random actions, disturbed encoders and lengths.

    make bench-crossing

With ``--write``, results go to docs/records/crossing.json, and from there to docs/crossing.md.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
from shared import ROOT, describe, make_parser, processor_line, publish, table

from tpm_gym.tasks import Expert

ENV = "TPMCrossing-v0"
RECORD, PAGE = ROOT / "docs" / "records" / "crossing.json", ROOT / "docs" / "crossing.md"
ENGINES = ("analytic", "pybullet", "mujoco")
SEED = 3_000_000
DISTURBED: dict[str, dict[str, Any]] = {
    "encoder noise of 0.1 mrad": {"encoder_noise": 1e-4},
    "encoder bias of 0.1 mrad": {"encoder_bias": 1e-4},
    "encoder bias of 1 mrad": {"encoder_bias": 1e-3},
    "lengths wrong by 0.1 mm": {"length_error": 1e-4},
    "lengths wrong by 0.5 mm": {"length_error": 5e-4},
}
Act = Callable[[dict[str, Any], int], Any]


def episode(env: Any, seed: int, act: Act) -> dict[str, Any]:
    """Play an episode; return success by the truth, torques, passes and wrong sides."""
    bare, axis = env.unwrapped, 1
    observation, _ = env.reset(seed=seed)
    sides, ways, torques, step, done = [1.0], [], [], 0, False
    while not done:
        observation, _, _, done, info = env.step(act(observation, step))
        state, step = bare.state, step + 1
        ways.append(float(bare.machine.mount.to_paper(state.platform_position)[axis]))
        sides.append(float(np.sign(ways[-1])))
        torques.append(float(np.abs(state.torque).max()))
    place = np.array([bare.machine.home[axis], *ways])
    # The side by continuity: the image of P that is nearer to where two steps lead.
    ahead = 2 * place[1:-1] - place[:-2]
    wrong = np.sign(ahead) != np.sign(place[2:])
    return {
        "success": bool(np.linalg.norm(state.platform_position - bare.goal) < bare.task.tolerance),
        "reported": bool(info["is_success"]),
        "passes": int((np.diff(sides) != 0).sum()),
        "torque": max(torques),
        "wrong": int(wrong.sum()),
    }


def measure(engine: str, count: int, player: str = "expert", **options: Any) -> dict[str, Any]:
    """Play ``count`` episodes with the expert or with random actions, and sum up."""
    with closing(gym.make(ENV, engine=engine, **options)) as env:
        expert, rows = Expert(env), []
        for seed in range(SEED, SEED + count):
            rng = np.random.default_rng(seed)

            def wander(_: Any, step: int, rng: np.random.Generator = rng) -> Any:
                drift = 0.6 if step < 12 or step > 30 else -0.6
                return np.clip(rng.uniform(-1, 1, 3) + (0.0, drift, 0.0), -1, 1)

            act: Act = (lambda seen, _: expert.act(seen)) if player == "expert" else wander
            rows.append(episode(env, seed, act))
    return {
        "episodes": count,
        "success": sum(row["success"] for row in rows),
        "reported": sum(row["reported"] for row in rows),
        "passes": sum(row["passes"] for row in rows),
        "torque": [float(np.median([r["torque"] for r in rows])), max(r["torque"] for r in rows)],
        "wrong": sum(row["wrong"] for row in rows),
    }


def lines(record: dict[str, Any]) -> Iterator[str]:
    """Yield the tables of the page."""
    if not record:
        return
    head = ["engine", "expert", "peak torque: median, largest", "passes of random actions"]
    yield from table(
        [*head, "side not found by continuity"],
        [
            [
                engine,
                f"{own['success']:,} of {own['episodes']:,}",
                f"{own['torque'][0]:.0f}, {own['torque'][1]:.0f} N m",
                str(record["random"][engine]["passes"]),
                str(record["random"][engine]["wrong"]),
            ]
            for engine, own in record["expert"].items()
        ],
    )
    yield ""
    yield from table(
        ["the expert with", *next(iter(record["disturbed"].values()))],
        [
            [name, *(f"{one['success']} of {one['episodes']}" for one in own.values())]
            for name, own in record["disturbed"].items()
        ],
    )
    yield ""
    yield f"{processor_line(record['conditions'])}; `{record['conditions']['command']}`."


def main() -> None:
    """Measure, and publish the record."""
    parser = make_parser("Measure passages of y = 0.")
    parser.add_argument("--episodes", type=int, default=1000, help="of the expert in each engine")
    parser.add_argument("--fewer", type=int, default=100, help="episodes of the other rows")
    options = parser.parse_args()
    record: dict[str, Any] = {
        "conditions": describe(sys.argv),
        "expert": {name: measure(name, options.episodes) for name in ENGINES},
        "random": {name: measure(name, options.fewer, "random") for name in ENGINES},
        "disturbed": {
            name: {
                engine: measure(engine, options.fewer, randomisation=own) for engine in ENGINES[:2]
            }
            for name, own in DISTURBED.items()
        },
    }
    publish(record, RECORD, PAGE, "crossing", lines, write=options.write)


if __name__ == "__main__":
    main()
