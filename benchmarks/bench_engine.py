"""Measure the speed of the analytic engine, and its differences from PyBullet.

    make bench-engine
    python benchmarks/bench_engine.py --quick

Speed: environment steps per second with uniform random actions, resets included. Contestants take
turns: the analytic engine with several numbers of environments, with the torques of no, the last or
every time step, and with servo drives; PyBullet; panda-gym. Ratios compare blocks of one round.

Threads: the analytic engine with one and with two threads, in turns.

Torques: both engines get the same actions with nothing to touch, at several time steps. Torques,
observations and conditioning are compared.

Success: actions are recorded in PyBullet and replayed in the analytic engine from the same resets.
The table has the share of episodes with the same success at the end. Policies are the expert and
the published ones, with and without noise, which makes them drop, throw and shove. The same
policies also act on the observations of each engine.

Results go to docs/records/analytic.json, and from there to docs/speed.md and
docs/images/analytic.png.
"""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import Any

import analytic_report
import gymnasium as gym
import numpy as np
import shared
import torch
from engine_matrix import NOISE
from numpy.typing import NDArray

from tpm_gym.learning.policies import NoisyPolicy, load_policy
from tpm_gym.learning.rollout import TEST_SEED

PICK, JOINTS, REACH = "TPMPickAndPlace-v0", "TPMPickAndPlaceJoints-v0", "TPMReach-v0"
PEER = "PandaPickAndPlace-v3"
COUNTS = (1, 16, 256, 1024, 4096)
THREADED = {"ideal": (4096, 16384, 65536, 262144), "servo": (4096, 16384)}
"""Numbers of environments that two threads step, by drive."""
ROUNDS, SINGLE, STEPS = 7, 300, 50
"""Rounds of timing, control steps of a block of one environment, steps of an episode."""

Actions = NDArray[np.float32]


# -- speed ----------------------------------------------------------------------------------------


def speeds(rounds: int, counts: Sequence[int]) -> dict[str, dict[str, Any]]:
    """Measure steps per second in each round, by contestant."""
    importlib.import_module("panda_gym")
    blocks: dict[str, Callable[[int], float]] = {PEER: _single(PEER)}
    for env_id in (PICK, JOINTS, REACH):
        blocks[f"{env_id}, pybullet"] = _single(env_id, engine="pybullet")
        for torques in ("none", "last", "every"):
            blocks[f"{env_id}, analytic, {torques}, 1024"] = _many(env_id, 1024, torques)
    for count in counts:
        blocks.setdefault(f"{PICK}, analytic, none, {count}", _many(PICK, count, "none"))
    servo = f"{PICK} with servo drives"
    blocks[f"{servo}, pybullet"] = _single(PICK, engine="pybullet", drive="servo")
    for count in (1, 1024):
        blocks[f"{servo}, analytic, last, {count}"] = _many(PICK, count, "last", drive="servo")
    found: dict[str, list[float]] = {name: [] for name in blocks}
    for number in range(-1, rounds):  # the first is not counted
        for name in blocks if number % 2 else reversed(blocks):
            rate = blocks[name](number + 1)
            if number >= 0:
                found[name].append(rate)
        print(f"round {number + 1} of {rounds}", file=sys.stderr)
    return {name: {"rates": rates, "ratio": _ratio(name, found)} for name, rates in found.items()}


def threads(rounds: int) -> list[dict[str, Any]]:
    """Measure steps per second with one and with two threads, in turns."""
    rows = []
    for drive, counts in THREADED.items():
        for count in counts:
            print(f"threads: {drive}, {count}", file=sys.stderr)
            found: dict[str, list[float]] = {"one": [], "two": []}
            torques = "none" if drive == "ideal" else "last"
            one, two = (
                _many(PICK, count, torques, drive=drive, num_threads=number) for number in (1, 2)
            )
            for number in range(-1, rounds):  # the first is not counted
                rates = one(number + 1), two(number + 1)
                if number >= 0:
                    found["one"].append(rates[0])
                    found["two"].append(rates[1])
            rows.append({"drive": drive, "count": count, **found})
    return rows


def _ratio(name: str, found: dict[str, list[float]]) -> list[float] | None:
    """Return the ratios to the PyBullet environment of the same id, round by round."""
    base = found.get(f"{name.split(', ')[0]}, pybullet")
    return [one / other for one, other in zip(found[name], base, strict=True)] if base else None


def _single(env_id: str, **options: Any) -> Callable[[int], float]:
    """Return a function that measures steps per second of one environment, resets included."""
    env = gym.make(env_id, **options)

    def block(seed: int) -> float:
        actions = _random(seed, (SINGLE, *(env.action_space.shape or ())))
        env.reset(seed=seed)
        start = time.perf_counter()
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return SINGLE / (time.perf_counter() - start)

    return block


def _many(env_id: str, count: int, torques: str, **others: Any) -> Callable[[int], float]:
    """Return a function that measures steps per second of a vector environment.

    The environments are out of phase, so that resets are spread evenly.
    """
    options = {"engine": "analytic", "stagger": True, "physics": {"torques": torques}, **others}
    envs = gym.make_vec(env_id, num_envs=count, **options)

    def block(seed: int) -> float:
        actions = _random(seed, (STEPS, *(envs.action_space.shape or ())))
        envs.reset(seed=1000 * seed)
        start = time.perf_counter()
        for action in actions:
            envs.step(action)
        return STEPS * count / (time.perf_counter() - start)

    return block


def _random(seed: int, shape: tuple[int, ...]) -> Actions:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, shape).astype(np.float32)


# -- agreement ------------------------------------------------------------------------------------


def torques(episodes: int, rates: Sequence[int]) -> list[dict[str, Any]]:
    """Compare both engines on the same actions with nothing to touch, for each time step."""
    rows = []
    for rate in rates:
        for policy in ("expert", "random"):
            print(f"torques: {policy}, {rate} Hz", file=sys.stderr)
            rows.append({"policy": policy, "rate": rate, **_compared(policy, rate, episodes)})
    return rows


def _compared(policy: str, rate: int, episodes: int) -> dict[str, float]:
    physics = {"time_step": 1 / rate}
    seen: list[list[Any]] = [[], []]
    with closing(gym.make(REACH, physics=physics)) as env:
        other = gym.make(REACH, engine="analytic", physics=physics)
        acting = load_policy(policy, env)
        for seed in range(TEST_SEED, TEST_SEED + episodes):
            observation, _ = env.reset(seed=seed)
            other.reset(seed=seed)
            acting.reset(observation, [seed])
            for _ in range(STEPS):
                action = acting.act(observation)
                for each, rows in zip((env, other), seen, strict=True):
                    inner: Any = each.unwrapped
                    observation, *_ = each.step(action)
                    state = inner.state
                    rows.append((*state.torque, state.conditioning, *observation["observation"]))
    one, two = (np.array(rows) for rows in seen)
    off = one - two
    return {
        "torque": float(np.sqrt((off[:, :3] ** 2).sum() / (one[:, :3] ** 2).sum())),
        "conditioning": float(np.abs(off[:, 3]).max()),
        "observation": float(np.abs(off[:, 4:]).max()),
    }


def success(episodes: int) -> list[dict[str, Any]]:
    """Compare success of the same actions, and of the same policies, in both engines."""
    rows = []
    for env_id in (PICK, JOINTS):
        for policy in ("expert", env_id):
            for noise in (0.0, NOISE):
                print(f"success: {env_id}, {policy}, noise {noise}", file=sys.stderr)
                names = {"env_id": env_id, "policy": policy, "noise": noise}
                rows.append({**names, **_success(env_id, policy, noise, episodes)})
    return rows


def _success(env_id: str, policy: str, noise: float, episodes: int) -> dict[str, Any]:
    recorded, ended = _run(env_id, policy, noise, episodes, "pybullet")
    _, own = _run(env_id, policy, noise, episodes, "analytic")
    envs = gym.make_vec(env_id, num_envs=episodes, engine="analytic")
    envs.reset(seed=TEST_SEED)
    for actions in recorded.swapaxes(0, 1):
        *_, infos = envs.step(actions)
    return {
        "episodes": episodes,
        "pybullet": float(ended.mean()),
        "analytic": float(own.mean()),
        "equal": float((infos["is_success"] == ended).mean()),
    }


def _run(
    env_id: str, policy: str, noise: float, episodes: int, engine: str
) -> tuple[Actions, NDArray[np.bool_]]:
    """Run episodes; return actions (episodes, steps, size) and success at the end (episodes,)."""
    taken, ended = [], []
    with closing(gym.make(env_id, engine=engine)) as env:
        acting = NoisyPolicy(load_policy(policy, env), noise)
        for seed in range(TEST_SEED, TEST_SEED + episodes):
            observation, _ = env.reset(seed=seed)
            acting.reset(observation, [seed])
            actions = []
            for _ in range(STEPS):
                actions.append(acting.act(observation))
                observation, *_, info = env.step(actions[-1])
            taken.append(actions)
            ended.append(info["is_success"])
    return np.array(taken), np.array(ended)


def evaluation() -> float:
    """Measure the seconds of 1000 episodes of the published policy, with their statistics."""
    import tpm_gym
    from tpm_gym.learning.environments import make_envs
    from tpm_gym.learning.policies import TrainedPolicy
    from tpm_gym.learning.rollout import run_episodes, summarise

    envs, policy = make_envs(PICK, 1000, engine="analytic"), tpm_gym.load_policy(PICK)
    start = time.perf_counter()
    summarise(run_episodes(envs, TrainedPolicy(policy), 1000, TEST_SEED))
    return time.perf_counter() - start


def main() -> None:
    """Parse the options and run."""
    parser = shared.make_parser(
        "Speed and accuracy of the analytic engine.", quick="a minute or two"
    )
    parser.add_argument("--episodes", type=int, default=1000, help="of each row of success")
    parser.add_argument(
        "--part", choices=("speed", "threads", "torques", "success"), help="only this one"
    )
    parser.add_argument("--redraw", action="store_true", help="picture and page from the record")
    options = parser.parse_args()
    if options.redraw:
        analytic_report.publish()
        return
    torch.set_num_threads(1)
    quick = options.quick
    parts: dict[str, Callable[[], Any]] = {
        "speed": lambda: {
            "rates": speeds(2 if quick else ROUNDS, COUNTS[3:4] if quick else COUNTS),
            "evaluation": [evaluation() for _ in range(2 if quick else ROUNDS)],
        },
        "threads": lambda: threads(2 if quick else ROUNDS),
        "torques": lambda: torques(2 if quick else 20, (250,) if quick else (250, 500, 1000, 2000)),
        "success": lambda: success(10 if quick else options.episodes),
    }
    chosen = [options.part] if options.part else list(parts)
    record = {
        name: {"machine": shared.describe(sys.argv), "rows": parts[name]()} for name in chosen
    }
    print("\n".join(analytic_report.lines(record)))
    if options.write:
        analytic_report.write(record)
        analytic_report.publish()


if __name__ == "__main__":
    main()
