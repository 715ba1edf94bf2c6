"""Measure steps per second, compared with other packages, raw physics and two processes.

    make bench-speed

Each round runs each contestant once, in random order: the environments of tpm_gym, panda-gym and
gymnasium-robotics as made by ``gymnasium.make``, all with 25 control steps per second of simulated
time. All get the same uniform random actions, cut to their action space, and are reset when an
episode ends. Steps per second include these resets. Ratios are taken within a round, so that they
hold on a computer whose speed varies.

The floor of an environment of tpm_gym is its raw physics: the calls of the engine that its steps
made, replayed from the same starts (raw_physics.py). It is measured with the ``stepSimulation``
calls alone, and with the motor commands between them. Reading encoders and the true state,
kinematics, observations, rewards and wrappers are not in the floor.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import shared
import speed_scaling
from numpy.typing import NDArray
from raw_physics import Floor, Recorder, Tape, record, recording, replay
from shared import provenance, quartiles

from tpm_gym import ENV_IDS
from tpm_gym.simulation.bullet.silence import silence

BASELINE = "PandaPickAndPlace-v3"
PEERS = {
    "PandaReach-v3": "panda_gym",
    BASELINE: "panda_gym",
    "FetchPickAndPlace-v4": "gymnasium_robotics",
}
OURS = "TPMPickAndPlace-v0"
# Unless told otherwise: the ids whose steps differ most in cost.
MEASURED = ("TPMReach-v0", OURS, "TPMPickAndPlaceDense-v0", "TPMPickAndPlaceJoints-v0", *PEERS)
CONTROL_RATE = 25.0  # Hz


@dataclass
class Contestant:
    """Environment and its measurements, one entry for each round.

    Attributes:
        steps: Seconds of the steps.
        resets: Seconds of the resets.
        count: Number of resets.
        floors: Raw physics of the same steps, for environments of tpm_gym only.
    """

    env_id: str
    env: gym.Env[Any, Any]
    steps: list[float] = field(default_factory=list)
    resets: list[float] = field(default_factory=list)
    count: list[int] = field(default_factory=list)
    floors: list[Floor] = field(default_factory=list)
    recorded: gym.Env[Any, Any] | None = None
    recorder: Recorder = field(default_factory=Recorder)

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return int(np.prod(self.env.action_space.shape or (0,)))

    def run(self, actions: NDArray[np.float32], seed: int) -> None:
        """Run one round: all actions, with a reset at the end of each episode."""
        env, clock = self.env, time.perf_counter
        env.reset(seed=seed)
        resets, count = 0.0, 0
        begun = clock()
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                started = clock()
                env.reset()
                resets += clock() - started
                count += 1
        self.steps.append(clock() - begun - resets)
        self.resets.append(resets)
        self.count.append(count)

    def tape(self, actions: NDArray[np.float32], seed: int) -> Tape:
        """Record the calls of the engine in such a round, by a second environment."""
        with recording(self.recorder):
            if self.recorded is None:
                self.recorded = gym.make(self.env_id)
            return record(self.recorded, self.recorder, actions, seed)

    def close(self) -> None:
        """Close the environments."""
        self.env.close()
        if self.recorded is not None:
            self.recorded.close()


def open_contestants(env_ids: Sequence[str]) -> tuple[list[Contestant], dict[str, str]]:
    """Make the environments; return them, and the reasons of those that cannot be made."""
    made, missing = [], {}
    for env_id in env_ids:
        try:
            with silence(), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                if env_id in PEERS:
                    gym.register_envs(import_module(PEERS[env_id]))
                env = gym.make(env_id)
                env.reset(seed=0)
        except Exception as error:
            if env_id not in PEERS:
                raise
            # A peer that cannot run, for any reason, gets a line in the table.
            missing[env_id] = _reason(env_id, error)
            continue
        _check_rate(env_id, env)
        made.append(Contestant(env_id, env))
    return made, missing


def _reason(env_id: str, error: Exception) -> str:
    """Return in one line why a peer is missing."""
    text = f"{type(error).__name__}: {error}".rstrip(": ")
    if PEERS[env_id] == "gymnasium_robotics" and isinstance(error, AssertionError):
        # Since mujoco 3.12 its enumerations do not equal numpy's integers, and an assertion of
        # gymnasium-robotics 1.4.2 compares them.
        text += " (gymnasium-robotics 1.4.2 runs with mujoco below 3.12)"
    return " ".join(text.split())


def _check_rate(env_id: str, env: gym.Env[Any, Any]) -> None:
    """Raise if a control step is not 40 ms, because steps would not be comparable."""
    unwrapped: Any = env.unwrapped
    if env_id in ENV_IDS:
        period = unwrapped.task.control_period
    elif PEERS[env_id] == "panda_gym":
        period = unwrapped.sim.dt
    else:
        period = unwrapped.dt
    if abs(period * CONTROL_RATE - 1) > 1e-9:
        raise RuntimeError(f"{env_id}: a step is {period} s, not {1 / CONTROL_RATE} s")


def race(contestants: Sequence[Contestant], rounds: int, steps: int, seed: int) -> None:
    """Run all rounds, each contestant once a round, after a round that does not count."""
    rng = np.random.default_rng(seed)
    for number in range(-1, rounds):
        actions = rng.uniform(-1.0, 1.0, (steps, 4)).astype(np.float32)
        if number < 0:
            actions = actions[: min(steps, 100)]
        for index in rng.permutation(len(contestants)):
            _turn(contestants[index], actions, seed + number + 1, rng)
            if number < 0:
                contestant = contestants[index]
                for measured in (contestant.steps, contestant.resets, contestant.count):
                    measured.clear()
                contestant.floors.clear()
        print(f"\rround {number + 1} of {rounds}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)


def _turn(
    contestant: Contestant, actions: NDArray[np.float32], seed: int, rng: np.random.Generator
) -> None:
    """Run one contestant of a round: its steps and its floor, in random order."""
    actions = actions[:, : contestant.action_size]
    if contestant.env_id in PEERS:
        contestant.run(actions, seed)
        return
    tape = contestant.tape(actions, seed)
    steps_first = rng.random() < 0.5
    if steps_first:
        contestant.run(actions, seed)
    contestant.floors.append(replay(contestant.env, tape, seed))
    if not steps_first:
        contestant.run(actions, seed)


def summary(contestants: Sequence[Contestant], steps: int) -> dict[str, Any]:
    """Return quartiles of all measurements, by id."""
    totals = {c.env_id: np.add(c.steps, c.resets) for c in contestants}
    result: dict[str, Any] = {}
    for c in contestants:
        entry: dict[str, Any] = {
            "steps_per_second": quartiles(steps / totals[c.env_id]),
            "steps_per_second_without_resets": quartiles(steps / np.array(c.steps)),
            "rounds": (steps / totals[c.env_id]).tolist(),
        }
        if all(c.count):
            entry["reset_milliseconds"] = quartiles(1e3 * np.divide(c.resets, c.count))
        if BASELINE in totals:
            entry["ratio_to_baseline"] = quartiles(totals[BASELINE] / totals[c.env_id])
        if c.floors:
            entry["step_milliseconds"] = quartiles(1e3 * np.array(c.steps) / steps)
            for name in ("physics", "with_motors"):
                floor = np.array([getattr(one, name) for one in c.floors])
                entry[f"{name}_milliseconds"] = quartiles(1e3 * floor / steps)
                entry[f"step_over_{name}"] = quartiles(np.array(c.steps) / floor)
        result[c.env_id] = entry
    return result


def profile(steps: int) -> None:
    """Profile env.step."""
    env = gym.make(OURS)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, 4)).astype(np.float32)
    profiler = cProfile.Profile()
    for action in actions:
        profiler.enable()
        _, _, terminated, truncated, _ = env.step(action)
        profiler.disable()
        if terminated or truncated:
            env.reset()
    env.close()
    print(f"{steps} steps of {OURS}, resets left out")
    pstats.Stats(profiler).strip_dirs().sort_stats("tottime").print_stats(20)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument(
        "--contestants", nargs="+", choices=(*ENV_IDS, *PEERS), default=MEASURED, metavar="ID",
        help=f"default: {', '.join(MEASURED)}",
    )  # fmt: skip
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--steps", type=int, default=1000, help="of a contestant in a round")
    parser.add_argument(
        "--scaling-steps", type=int, default=1000, help="of a process in a round; 0: no scaling"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help="3 rounds of 100 steps")
    parser.add_argument("--json", type=Path, help="where to write the numbers")
    parser.add_argument("--plot", type=Path, help="where to draw them")
    parser.add_argument("--profile", action="store_true", help=f"profile {OURS} instead")
    options = parser.parse_args(arguments)
    if options.quick:
        options.rounds, options.steps = 3, 100
        options.scaling_steps = min(options.scaling_steps, 200)
    if min(options.rounds, options.steps) < 1 or options.scaling_steps < 0:
        parser.error("--rounds and --steps must be 1 or more, --scaling-steps 0 or more")
    return options


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    """Measure and print the tables; return the content of --json."""
    # Imports Matplotlib, which the spawned processes of speed_scaling.py do not need.
    from speed_report import print_report, save_plot

    options = parse(arguments)
    words = sys.argv if arguments is None else ["benchmarks/bench_speed.py", *arguments]
    if options.profile:
        profile(10 * options.steps)
        return {}
    content: dict[str, Any] = shared.describe(words) | {
        "rounds": options.rounds,
        "steps": options.steps,
        "seed": options.seed,
        "baseline": BASELINE,
    }
    contestants, content["unavailable"] = open_contestants(options.contestants)
    try:
        race(contestants, options.rounds, options.steps, options.seed)
    finally:
        with silence():
            for contestant in contestants:
                contestant.close()
    content["contestants"] = summary(contestants, options.steps)
    content["scaling"] = (
        speed_scaling.measure(OURS, options.rounds, options.scaling_steps)
        if options.scaling_steps
        else None
    )
    print_report(content)
    if options.json:
        provenance.write_json(options.json, content)
    if options.plot:
        save_plot(content, options.plot)
    return content


if __name__ == "__main__":
    main()
