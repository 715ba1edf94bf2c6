"""Measure the shield: violations, what margins hold, cost, and success of policies.

    make bench-shield
    python benchmarks/bench_shield.py --part soak --steps 1000000000

Parts:

- soak: steps of random and adversarial actions in the analytic engine. After each step, the
  conditioning is computed at the end of the path and between the nodes of the shield, where it
  does not look, and from the true joint positions.
- engines: the same in PyBullet.
- margins: the same with servo drives and other plants; the smallest true conditioning.
- cost: steps with and without the shield, in turn.
- policies: success of the published policies with and without it.
- training: tests of the runs in ``--runs``, which were trained with ``--goals tempting``.

With ``--write``, results go to docs/records/shield.json, and from there to docs/shield.md.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from shared import ROOT, describe, made_by, make_parser, provenance, publish, read_record, table

from tpm_gym.learning.estimates import wilson
from tpm_gym.learning.policies import load_policy
from tpm_gym.learning.rollout import TEST_SEED, run_episodes
from tpm_gym.mechanism.machine import find_machine
from tpm_gym.simulation.engine import spline_weights

RECORD, PAGE = ROOT / "docs" / "records" / "shield.json", ROOT / "docs" / "shield.md"
IDS = ("TPMReach-v0", "TPMReachJoints-v0")
MACHINES = ("paper", "wide")
PUBLISHED = ("TPMPickAndPlace-v0", "TPMPickAndPlaceJoints-v0", "TPMReach-v0")
MARGINS = (0.15, 0.3, 0.5, 0.7)
"""Parts of the safe conditioning that the shield keeps besides."""
OTHERS: dict[str, dict[str, Any]] = {
    "servo drives": {"drive": "servo"},
    "servo drives, masses 0.8 to 1.25, torques 0.8 to 1, friction to 1 N m, noise 0.1 mrad": {
        "drive": "servo",
        "randomisation": {
            "link_mass": (0.8, 1.25),
            "motor_strength": (0.8, 1.0),
            "joint_friction": (0.0, 1.0),
            "encoder_noise": 1e-4,
        },
    },
    "encoder bias 0.1 mrad": {"randomisation": {"encoder_bias": 1e-4}},
    "encoder bias 1 mrad": {"randomisation": {"encoder_bias": 1e-3}},
    "length errors 0.1 mm": {"randomisation": {"length_error": 1e-4}},
    "length errors 0.5 mm": {"randomisation": {"length_error": 5e-4}},
}


class Hostile:
    """Actions for n environments, a fifth of them of each kind.

    Kinds: uniform; to the corners; corners held for 1 to 20 steps; the steepest descent of the
    conditioning with noise; the descent to the corners, with x and z that turn back and forth.
    """

    def __init__(self, envs: Any, seed: int) -> None:
        """Start with nothing held."""
        self._envs, self._rng = envs, np.random.default_rng(seed)
        self._shape: tuple[int, int] = (envs.num_envs, envs.single_action_space.shape[0])
        self._held, self._left = np.zeros(self._shape), np.zeros(self._shape[0], dtype=int)

    def draw(self, last: NDArray[Any]) -> NDArray[Any]:
        """Return actions (n, k), for the last commands (n, 3) m."""
        rng, kind = self._rng, np.arange(len(last)) % 5
        actions = rng.uniform(-1, 1, self._shape)
        corners = np.sign(actions)
        self._left -= 1
        new = self._left < 0
        self._held[new], self._left[new] = corners[new], rng.integers(1, 20, int(new.sum()))
        actions = np.where(kind[:, None] == 1, corners, actions)
        actions = np.where(kind[:, None] == 2, self._held, actions)
        down = np.flatnonzero(kind >= 3)
        descent = self._descent(last[down])
        noisy = descent + rng.normal(0, 0.3, descent.shape)
        turning = np.sign(descent)
        turning[:, [0, 2]] = self._held[down][:, [0, 2]]
        actions[down, :3] = np.where(kind[down, None] == 3, noisy, turning)
        return np.clip(actions, -1, 1)

    def _descent(self, last: NDArray[Any]) -> NDArray[Any]:
        """Return actions (r, 3) along the steepest descent, the largest entry at its limit."""
        machine, nudge = self._envs.machine, 1e-3 * np.array(self._envs.machine.step_limit)
        beside = np.concatenate([np.zeros((1, 3)), np.diag(nudge)])
        values = machine.conditioning_at(last[:, None] + beside)
        fall = (values[:, :1] - values[:, 1:]) / nudge
        slope = (fall[:, None] @ self._envs.control.rate(last))[:, 0]
        found: NDArray[Any] = slope / np.maximum(np.abs(slope).max(axis=1, keepdims=True), 1e-12)
        return found


class Counted:
    """Shield that counts the commands that it changes."""

    def __init__(self, shield: Any) -> None:
        """Take the shield of an environment."""
        self._shield, self.changed = shield, 0

    def command(self, wanted: NDArray[Any], recent: NDArray[Any]) -> NDArray[Any]:
        """Return the commands of the shield."""
        found: NDArray[Any] = self._shield.command(wanted, recent)
        self.changed += int((found != wanted).any(axis=1).sum())
        return found


def soak(env_id: str, count: int, steps: int, seed: int, **options: Any) -> dict[str, Any]:
    """Step ``count`` environments; return the smallest conditionings and how many were below."""
    options = {"shield": True, "max_episode_steps": 250, **options}
    envs: Any = gym.make_vec(env_id, num_envs=count, **options)
    with closing(envs):
        machine, weights = envs.machine, spline_weights(8)[[0, 2, 4, 6, 7]]
        safe, hostile = machine.safe_conditioning, Hostile(envs, seed)
        for part in envs._parts:
            part.core._shield = Counted(part.core._shield)
        envs.reset(seed=seed)
        lows, below, done = [np.inf, np.inf], 0, 0
        commands = np.repeat(machine.mount.to_paper(envs.state.command)[:, None], 3, axis=1)
        while done < steps:
            before = envs.episode
            envs.step(hostile.draw(commands[:, 2]))
            going = envs.episode == before
            now = machine.mount.to_paper(envs.state.command)
            commands = np.concatenate([commands[:, 1:], now[:, None]], axis=1)
            points = np.tensordot(weights, commands[going], (1, 1))
            path, true = machine.conditioning_at(points).min(axis=0), _true(envs)[going]
            for k, values in enumerate((path, true)):
                lows[k] = min(lows[k], values.min(initial=np.inf))
            below += int((np.minimum(path, true) < safe).sum())
            done += int(going.sum())
            commands[~going] = now[~going, None]
    return {
        "steps": done,
        "path": lows[0],
        "true": lows[1],
        "below": below,
        "changed": sum(part.core._shield.changed for part in envs._parts),
    }


def _true(envs: Any) -> NDArray[Any]:
    """Return the conditioning (n,) of the true machines at their true joint positions."""
    found = []
    for part in envs._parts:
        simulation = part.core.simulation
        built = getattr(simulation.engine, "_built", None)
        theta = simulation.state().theta - simulation._bias - simulation._noise[:, 1]
        conditioning = envs.machine.evaluate(theta, built).conditioning
        left = simulation.mode_left != 0
        found.append(np.where(left | np.isnan(conditioning), 0.0, conditioning))
    return np.concatenate(found)


def soak_all(content: dict[str, Any], options: argparse.Namespace, engine: str) -> Iterator[None]:
    """Soak ids and machines in turn; yield after each."""
    name, count = ("soak", 2000) if engine == "analytic" else ("engines", 20)
    total = options.steps if engine == "analytic" else options.engine_steps
    rows = content[name] = {}
    turn, chunk = 0, min(total // 4, 2_000_000 if engine == "analytic" else 50_000)
    while sum(row["steps"] for row in rows.values()) < total:
        env_id, machine = IDS[turn % 2], MACHINES[turn // 2 % 2]
        found = soak(env_id, count, chunk, turn, engine=engine, machine=machine)
        key = f"{env_id}, {machine}"
        old = rows.setdefault(key, dict.fromkeys(found, 0) | {"path": np.inf, "true": np.inf})
        for entry, value in found.items():
            old[entry] = min(old[entry], value) if entry in ("path", "true") else old[entry] + value
        turn += 1
        yield


def margins(content: dict[str, Any], options: argparse.Namespace) -> Iterator[None]:
    """Soak with drives and plants that do not follow exactly, for each margin."""
    rows = content["margins"] = {}
    for (name, others), machine in product(OTHERS.items(), MACHINES):
        lows = rows[f"{name}, {machine}"] = {}
        for margin in MARGINS:
            least = find_machine(machine).safe_conditioning * (1 + margin)
            own = {"engine": "analytic", "machine": machine, "shield": least, **others}
            found = [soak(env_id, 500, options.other_steps // 2, 0, **own) for env_id in IDS]
            lows[f"{margin:.0%}"] = min(entry["true"] for entry in found)
        yield


def cost(content: dict[str, Any], options: argparse.Namespace) -> Iterator[None]:
    """Time steps with and without the shield, and the shield alone; the least of ten rounds."""
    rows = content["cost"] = {}
    for env_id, engine, count, steps in (
        ("TPMReach-v0", "analytic", 1024, 20),
        ("TPMReachJoints-v0", "analytic", 1024, 20),
        ("TPMPickAndPlace-v0", "analytic", 1024, 20),
        ("TPMReach-v0", "pybullet", 1, 200),
    ):
        pair: list[Any] = [
            gym.make_vec(env_id, num_envs=count, engine=engine, shield=on) for on in (False, True)
        ]
        rng, least = np.random.default_rng(0), [np.inf, np.inf]
        for envs in pair:
            envs.reset(seed=0)
            for _ in range(25):
                envs.step(rng.uniform(-1, 1, envs.action_space.shape))
        for _ in range(10):
            for k, envs in enumerate(pair):
                actions = rng.uniform(-1, 1, (steps, *envs.action_space.shape))
                begun = time.thread_time()
                for own in actions:
                    envs.step(own)
                least[k] = min(least[k], (time.thread_time() - begun) / steps / count)
        rows[f"{env_id}, {engine}, {count}"] = [1e9 * seconds for seconds in least]
        for envs in pair:
            envs.close()
        yield


def policies(content: dict[str, Any], options: argparse.Namespace) -> Iterator[None]:
    """Test published policies with and without the shield, in PyBullet."""
    rows = content["policies"] = {}
    for policy in PUBLISHED:
        for shield in (False, True):
            rows[f"{policy}, {'shield' if shield else 'without'}"] = tested(
                policy, policy, options.episodes, "pybullet", 1, shield=shield
            )
            yield


def training(content: dict[str, Any], options: argparse.Namespace) -> Iterator[None]:
    """Test the policies of training runs on tempting goals, as they were trained."""
    rows = content["training"] = {}
    for file in sorted(options.runs.glob("*/config.json")):
        config = json.loads(file.read_text(encoding="utf-8"))
        shield = bool(config["env_options"].get("shield"))
        key = f"{config['env']}, {'shield' if shield else 'penalty alone'}"
        for engine, count, episodes in (("analytic", 1000, 1000), ("pybullet", 1, 200)):
            found = tested(
                str(file.parent),
                config["env"],
                episodes,
                engine,
                count,
                shield=shield,
                goals="tempting",
            )
            rows.setdefault(key, {}).setdefault(engine, []).append(found)
            yield


def tested(
    policy: str, env_id: str, episodes: int, engine: str, count: int, **options: Any
) -> dict[str, Any]:
    """Return success, and the share of steps below the safe conditioning."""
    envs: Any = gym.make_vec(env_id, num_envs=count, engine=engine, **options)
    with closing(envs):
        records = run_episodes(envs, load_policy(policy, envs), episodes, TEST_SEED)
    return {
        "success": wilson([record.success_at_end for record in records]).as_dict(),
        "penalised": float(np.mean([record.unsafe_share for record in records])),
    }


PARTS: Final[dict[str, Callable[[dict[str, Any], argparse.Namespace], Iterator[None]]]] = {
    "soak": partial(soak_all, engine="analytic"),
    "engines": partial(soak_all, engine="pybullet"),
    "margins": margins,
    "cost": cost,
    "policies": policies,
    "training": training,
}
"""Measurements by name; each adds its rows to a record, and yields after each row."""

# -- record and page ------------------------------------------------------------------------------


def lines(content: dict[str, Any]) -> Iterator[str]:
    """Yield the tables of the page, each with the command that made it."""
    section = partial(_section, content)
    for name, title in (("soak", "analytic engine"), ("engines", "PyBullet")):
        yield from section(
            name,
            [f"{title}, ideal drives", "steps", "changed", "below 0.08", "least conditioning"],
            [
                [
                    key,
                    f"{row['steps']:,}",
                    f"{row['changed'] / row['steps']:.0%}",
                    str(row["below"]),
                    f"{min(row['path'], row['true']):.5f}",
                ]
                for key, row in content.get(name, {}).items()
            ],
        )
    yield from section(
        "margins",
        ["least true conditioning with a margin of", *(f"{margin:.0%}" for margin in MARGINS)],
        [
            [key, *(f"{low:.3f}" for low in lows.values())]
            for key, lows in content.get("margins", {}).items()
        ],
    )
    yield from section(
        "cost",
        ["a step of one environment, ns of CPU", "without", "with the shield"],
        [[key, *(f"{ns:,.0f}" for ns in pair)] for key, pair in content.get("cost", {}).items()],
    )
    yield from section(
        "policies",
        ["published policy, in PyBullet", "success, 95% interval", "steps below 0.08"],
        [
            [key, _share(row), f"{row['penalised']:.2%}"]
            for key, row in content.get("policies", {}).items()
        ],
    )
    yield from section(
        "training",
        ["trained and tested on tempting goals", "success, median (all seeds)", "steps below 0.08"],
        [
            [f"{key}, {engine}", _median(found), f"{_mean_penalised(found):.2%}"]
            for key, engines in content.get("training", {}).items()
            for engine, found in engines.items()
        ],
    )


def _section(
    content: dict[str, Any], part: str, head: Sequence[str], rows: Sequence[Sequence[str]]
) -> Iterator[str]:
    """Yield the lines of a part's table; nothing for a part that was not measured."""
    if rows:
        yield f"{made_by(content[f'{part} made by'])}:"
        yield ""
        yield from table(head, rows)
        yield ""


def _median(found: Sequence[dict[str, Any]]) -> str:
    rates = sorted(row["success"]["mean"] for row in found)
    return f"{np.median(rates):.1%} ({', '.join(f'{rate:.1%}' for rate in rates)})"


def _mean_penalised(found: Sequence[dict[str, Any]]) -> float:
    return float(np.mean([row["penalised"] for row in found]))


def _share(row: dict[str, Any]) -> str:
    mean, low, high = (100 * row["success"][name] for name in ("mean", "low", "high"))
    return f"{mean:.1f}% [{low:.1f}, {high:.1f}]"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run parts and publish the record."""
    parser = make_parser((__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--part", nargs="+", choices=PARTS, default=[*PARTS])
    parser.add_argument("--steps", type=int, default=100_000_000, help="in the analytic engine")
    parser.add_argument("--engine-steps", type=int, default=100_000, help="in PyBullet")
    parser.add_argument("--other-steps", type=int, default=100_000, help="of each margin")
    parser.add_argument("--episodes", type=int, default=200, help="of each published policy")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "shield")
    options = parser.parse_args(arguments)
    words = sys.argv if arguments is None else ["benchmarks/bench_shield.py", *arguments]
    content = read_record(RECORD) if options.write else {}
    for part in options.part:
        content[f"{part} made by"] = describe(words)
        for _ in PARTS[part](content, options):
            if options.write:  # an interrupted run keeps its results
                provenance.write_json(RECORD, content)
    publish(content, RECORD, PAGE, "shield", lines, write=options.write)


if __name__ == "__main__":
    main()
