"""Measure the cost of tpm-gym evaluate beyond the steps of its environment.

    make bench-evaluate

Each round runs the command ``tpm-gym evaluate`` on a policy, with start-up, statistics and JSON.
Then it steps the bare environment through the same episodes, with the same resets and the recorded
actions of the policy. The ratio is taken within a round.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
from shared import describe, processor_line, quartiles

from tpm_gym.learning.policies import load_policy, trained_in
from tpm_gym.learning.rollout import TEST_SEED
from tpm_gym.resources import POLICIES

Episode = list[Any]
"""Actions of an episode."""


def record(env_id: str, policy_name: str, episodes: int) -> list[Episode]:
    """Record the actions of a policy."""
    env = gym.make(env_id)
    policy = load_policy(policy_name, env)
    tape: list[Episode] = []
    for seed in range(TEST_SEED, TEST_SEED + episodes):
        observation, _ = env.reset(seed=seed)
        policy.reset(observation, [seed])
        actions: Episode = []
        done = False
        while not done:
            actions.append(policy.act(observation))
            observation, _, terminated, truncated, _ = env.step(actions[-1])
            done = terminated or truncated
        tape.append(actions)
    env.close()
    return tape


def bare(env_id: str, tape: list[Episode]) -> float:
    """Measure the seconds of stepping the environment through recorded episodes."""
    env = gym.make(env_id)
    started = time.perf_counter()
    for seed, actions in enumerate(tape, TEST_SEED):
        env.reset(seed=seed)
        for action in actions:
            env.step(action)
    seconds = time.perf_counter() - started
    env.close()
    return seconds


def evaluated(env_id: str, policy_name: str, episodes: int) -> float:
    """Measure the seconds of the command tpm-gym evaluate."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "tpm_gym.learning", "evaluate", "--policy", policy_name]
        command += ["--env", env_id, "--episodes", str(episodes)]
        command += ["--json", str(Path(folder, "evaluation.json"))]
        started = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        return time.perf_counter() - started


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Measure; print and return the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    published = POLICIES / "TPMPickAndPlace-v0.json"
    parser.add_argument("--policy", default=str(published), help="an exported policy")
    parser.add_argument("--episodes", type=int, default=1000, help="episodes a round")
    parser.add_argument("--rounds", type=int, default=3, help="rounds")
    parser.add_argument("--json", type=Path, help="write the measurements here as well")
    options = parser.parse_args(arguments)
    content = describe(sys.argv if arguments is None else ["bench_evaluate.py", *arguments])
    trained = trained_in(options.policy)
    if trained is None:
        parser.error(f"--policy {options.policy}: give a trained policy")
    env_id, _ = trained
    tape = record(env_id, options.policy, options.episodes)
    rows = []
    for _ in range(options.rounds):
        whole = evaluated(env_id, options.policy, options.episodes)
        rows.append({"evaluate_s": whole, "bare_s": bare(env_id, tape)})
    ratio = quartiles([row["evaluate_s"] / row["bare_s"] for row in rows])
    content |= {"env": env_id, "episodes": options.episodes, "rounds": rows, "ratio": ratio}
    print(processor_line(content))
    for row in rows:
        print(f"tpm-gym evaluate {row['evaluate_s']:6.1f} s   bare {row['bare_s']:6.1f} s")
    low, median, high = ratio
    print(f"{env_id}, {options.episodes} episodes: {median:.2f} [{low:.2f}, {high:.2f}]")
    if options.json is not None:
        options.json.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return content


if __name__ == "__main__":
    main()
