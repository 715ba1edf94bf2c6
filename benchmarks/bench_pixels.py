"""Measure the cost of pixel observations: steps per second of CPU time, with and without them.

CPU time counts all threads, and hardly depends on what else a machine does.

python benchmarks/bench_pixels.py
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import gymnasium as gym
import numpy as np

import tpm_gym

ENV_ID = "TPMPickAndPlace-v0"


def steps_per_second(engine: str, size: int | None, seconds: float) -> float:
    """Return the best rate of blocks of five random steps, by CPU time; no pixels for None."""
    options: dict[str, Any] = {}
    if size is not None:
        options = {"observations": "pixels", "pixel_size": size}
    env = gym.make(ENV_ID, engine=engine, **options)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (5, *(env.action_space.shape or ())))
    best, end = np.inf, time.perf_counter() + seconds
    while time.perf_counter() < end:
        env.reset()
        start = time.process_time()
        for action in actions:
            env.step(action)
        best = min(best, time.process_time() - start)
    env.close()
    return len(actions) / best


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--engines", nargs="+", default=["pybullet", "mujoco", "analytic"])
    parser.add_argument("--sizes", nargs="+", type=int, default=[64, 84])
    parser.add_argument("--seconds", type=float, default=3.0, help="for each number")
    asked = parser.parse_args()
    print(
        f"{ENV_ID} of tpm_gym {tpm_gym.__version__}, one environment, steps per second of CPU time"
    )
    print("| engine | state |", " | ".join(f"{size} x {size}" for size in asked.sizes), "|")
    for engine in asked.engines:
        rates = [steps_per_second(engine, size, asked.seconds) for size in (None, *asked.sizes)]
        print(f"| {engine} |", " | ".join(f"{rate:.0f}" for rate in rates), "|")


if __name__ == "__main__":
    main()
