"""Measure the time from the start of Python to the end of the first step.

    make bench-first

A new process imports Gymnasium and tpm_gym, makes an environment, resets it and steps once. It runs
with an empty folder for Numba's machine code, and then with what it left there.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence

IDS = ("TPMReach-v0", "TPMPickAndPlace-v0")
FIRST = """
import sys, time
import gymnasium, tpm_gym
imported = time.process_time()
env = gymnasium.make(sys.argv[1], engine=sys.argv[2])
env.reset(seed=0)
env.step(env.action_space.sample())
print(imported, time.process_time())
"""


def first(env_id: str, engine: str, folder: str) -> tuple[float, float]:
    """Return seconds of CPU until tpm_gym is imported, and until the end of the first step."""
    done = subprocess.run(
        [sys.executable, "-c", FIRST, env_id, engine],
        env={**os.environ, "NUMBA_CACHE_DIR": folder},
        capture_output=True,
        text=True,
        check=True,
    )
    imported, stepped = map(float, done.stdout.splitlines()[-1].split())
    return imported, stepped


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--engine", default="pybullet")
    parser.add_argument("--repeats", type=int, default=5, help="with a filled folder; the median")
    options = parser.parse_args(arguments)
    print("CPU seconds            import   first step: empty   filled")
    for env_id in IDS:
        with tempfile.TemporaryDirectory() as folder:
            _, empty = first(env_id, options.engine, folder)
            filled = sorted(first(env_id, options.engine, folder) for _ in range(options.repeats))[
                options.repeats // 2
            ]
        print(f"{env_id:22} {filled[0]:6.2f} {empty:19.2f} {filled[1]:8.2f}")


if __name__ == "__main__":
    main()
