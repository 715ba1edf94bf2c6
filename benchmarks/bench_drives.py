"""Compare drives on the same episodes: success, singularities passed, tracking, torques.

    python benchmarks/bench_drives.py --episodes 1000

The table has rows for the expert and for random actions, with ideal drives and with servos of
several stiffnesses and feed-forwards. The damping grows with the root of the stiffness, so that the
damping ratio stays the same. Angles and torques are taken at the end of each control step.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

import tpm_gym  # noqa: F401 - the ids
from tpm_gym.simulation import Servo
from tpm_gym.simulation.drives import FEEDFORWARDS
from tpm_gym.simulation.engine import Path
from tpm_gym.tasks import Expert

FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)


class Row(NamedTuple):
    """Outcomes of a set of episodes."""

    successes: int
    singular: int
    errors: list[float]  # rad
    torques: list[float]  # N m


def drives() -> Iterator[tuple[str, Servo | None]]:
    """Yield all drives with their names."""
    yield "ideal", None
    for feedforward in reversed(FEEDFORWARDS):
        for factor in FACTORS:
            stiffness, damping = Servo.stiffness * factor, Servo.damping * factor**0.5
            yield f"{feedforward}, {stiffness:g} N m/rad", Servo(stiffness, damping, feedforward)


def play(env_id: str, engine: str, drive: Servo | None, scripted: bool, episodes: int) -> Row:
    """Play one episode for each seed from 0 up."""
    env: Any = gym.make(env_id, engine=engine, drive=drive)
    expert = Expert(env) if scripted else None
    simulated, wanted = env.unwrapped.simulation.engine, [np.zeros(3)]
    advance = simulated.advance

    def noted(path: Path, *arguments: Any) -> None:
        wanted[0] = path.joints(1)[0, 0]
        advance(path, *arguments)

    simulated.advance = noted
    row = Row(0, 0, [], [])
    for seed in range(episodes):
        observation, info = env.reset(seed=seed)
        rng = np.random.default_rng(seed)
        if expert is not None:
            expert.reset(observation)
        done = False
        while not done:
            action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
            if expert is not None:
                action = expert.act(observation)
            observation, _, terminated, truncated, info = env.step(action)
            done = terminated or truncated
            now = simulated.read()
            row.errors.extend(np.abs(now.theta[0] - wanted[0]).tolist())
            row.torques.extend(np.abs(now.torque[0]).tolist())
        passed = info["assembly_mode_changed"] or info["working_mode_changed"]
        row = row._replace(
            successes=row.successes + bool(info["is_success"]), singular=row.singular + bool(passed)
        )
    env.close()
    return row


def line(name: str, row: Row) -> str:
    """Return a row of the table, in mrad and N m."""
    numbers = [
        f"{scale * value:.3g}"
        for scale, values in ((1e3, row.errors), (1.0, row.torques))
        for value in (np.sqrt(np.mean(np.square(values))), np.max(values))
    ]
    cells = [name, str(row.successes), str(row.singular), *numbers]
    return f"| {' | '.join(cells)} |"


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Compare drives on the same episodes.")
    parser.add_argument("--env", default="TPMReach-v0")
    parser.add_argument("--engine", default="pybullet")
    parser.add_argument("--episodes", type=int, default=100)
    options = parser.parse_args(argv)
    print(f"{options.env}, {options.engine}, {options.episodes} episodes a row")
    print("| actions and drive | successes | singular | error: RMS | max | torque: RMS | max |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, drive in drives():
        for actor in ("expert", "random"):
            row = play(options.env, options.engine, drive, actor == "expert", options.episodes)
            print(line(f"{actor}, {name}", row), flush=True)


if __name__ == "__main__":
    main()
