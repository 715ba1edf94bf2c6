"""Run the environments for a million steps, and measure memory, loop gaps and speed.

    make soak
    python benchmarks/soak.py --engine mujoco --warm-up 250000

Ids take turns. Each visit has one to three episodes, which depend on (seed, number of the visit)
alone. There are resets with and without seeds, with options, in the middle of an episode and at its
end; uniform, bang-bang and expert actions; states that are saved, left and restored, after which
the episode must repeat itself to the last bit; some pictures; and some environments are closed and
made anew. An exception is recorded and does not end the run: ``--replay VISIT`` raises it again.

Memory is compared with the first sample after the warm-up. By then each id has been opened and has
drawn a picture (each new environment draws one), and caches are full. Before each sample, garbage
is collected and the C library returns free memory; this time does not count. Mesa, which draws for
MuJoCo without a GPU, takes more until some 50 environments were made anew: give it ``--warm-up``.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import shared
from numpy.typing import NDArray
from shared import provenance
from soak_report import judge, print_verdict, save_plot

from tpm_gym import ENV_IDS
from tpm_gym.tasks import Expert

Env = gym.Env[Any, Any]
Make = Callable[..., Env]
Policy = Callable[[dict[str, Any]], NDArray[np.float32]]

REOPEN, RENDER, SAVE, WHOLE = 0.02, 0.01, 0.1, 0.5
"""Shares of visits that reopen, and of episodes that draw another picture, save and restore, and
run to their end. Bullet keeps about 20 kB of each environment that is closed, mostly scratch memory
of its direct solver. So memory grows with the number of openings only."""
POLICIES = {"uniform": 0.7, "bang-bang": 0.15, "expert": 0.15}
PICTURE = {"render_mode": "rgb_array", "width": 32, "height": 24}
MOST_FAILURES = 100


@dataclass
class Window:
    """Sums between two samples; gaps in m."""

    steps: int = 0
    gap_sum: float = 0.0
    gap_max: float = 0.0
    gaps: int = 0
    begun: float = field(default_factory=time.perf_counter)


class Soak:
    """Pool of environments, one of each id, and a record of its events.

    Args:
        seed: Seed of all visits.
        engine: Engine of all environments.
        make: Function that makes an environment from an id.
    """

    def __init__(self, seed: int, engine: str = "pybullet", make: Make = gym.make) -> None:
        """Start with no environment open."""
        self.seed, self.engine, self._make = seed, engine, make
        self._pool: dict[str, Env] = {}
        self.steps = self.visits = 0
        self.events: Counter[str] = Counter()
        self.failures: list[dict[str, Any]] = []
        self.window = Window()
        self._episode = self._step = 0  # within the visit, for the report of a failure
        self.opened: set[str] = set()

    # -- visits -------------------------------------------------------------------------------

    def visit(self) -> None:
        """Run the next visit; after an exception, record it and close the environment."""
        number, self.visits = self.visits, self.visits + 1
        env_id = ENV_IDS[number % len(ENV_IDS)]
        try:
            self.run_visit(number)
        except Exception as error:
            # The run goes on after any exception, and fails at its end.
            self._fail(env_id, number, error)
            env = self._pool.pop(env_id, None)
            with contextlib.suppress(Exception):
                if env is not None:
                    env.close()

    def run_visit(self, number: int) -> None:
        """Run a visit, which depends on its number and the seed alone."""
        rng = np.random.default_rng([self.seed, number])
        self._episode = self._step = 0
        env_id = ENV_IDS[number % len(ENV_IDS)]
        reopen = rng.random() < REOPEN
        if reopen and env_id in self._pool:
            self._pool.pop(env_id).close()
            self.events["closes"] += 1
        fresh = env_id not in self._pool
        if fresh:
            self._pool[env_id] = self._make(env_id, engine=self.engine, **PICTURE)
            self.events["openings"] += 1
            self.opened.add(env_id)
        env = self._pool[env_id]
        for episode in range(int(rng.integers(1, 4))):
            self._episode, self._step = episode, 0
            self._run_episode(env, rng, first=episode == 0, picture=fresh and episode == 0)

    def _run_episode(
        self, env: Env, rng: np.random.Generator, *, first: bool, picture: bool
    ) -> None:
        """Run one reset and the steps after it."""
        observation = self._reset(env, rng, first)
        policy = _policy(env, rng, observation)
        length = 10_000 if rng.random() < WHOLE else int(rng.integers(1, 50))
        save_at = int(rng.integers(0, 40)) if rng.random() < SAVE else -1
        if rng.random() < RENDER or picture:
            self._render(env)
        for index in range(length):
            self._step = index
            if index == save_at:
                if self._check_restore(env, rng):
                    break
                inner: Any = env.unwrapped
                observation = inner.restore_state(inner.save_state())
                policy = _policy(env, rng, observation)  # the expert needs a new plan
            observation, _, terminated, truncated, _ = self._advance(env, policy(observation))
            if terminated or truncated:
                break

    def _reset(self, env: Env, rng: np.random.Generator, first: bool) -> dict[str, Any]:
        """Reset with a seed (always at the start of a visit), without, or with options."""
        kind = "seeded" if first else str(rng.choice(["seeded", "plain", "options"]))
        self.events[f"resets {kind}"] += 1
        seed, options = None, None
        if kind == "seeded":
            seed = int(rng.integers(2**31))
        elif kind == "options":
            unwrapped: Any = env.unwrapped
            starts = unwrapped.task.sample([rng], {})
            options = {name: rows[0] for name, rows in starts.items()}
        observation: dict[str, Any] = env.reset(seed=seed, options=options)[0]
        return observation

    def _advance(self, env: Env, action: NDArray[np.float32]) -> tuple[Any, ...]:
        """Take one step, which counts even if it raises."""
        self.steps += 1
        self.window.steps += 1
        result = env.step(action)
        info = result[4]
        gap = info["closure_error"]
        if not np.isfinite(gap):
            raise RuntimeError(f"closure_error is {gap}")
        if info["assembly_mode_changed"] or info["working_mode_changed"]:
            self.events["mode changes"] += 1
        self.window.gap_sum += gap
        self.window.gap_max = max(self.window.gap_max, gap)
        self.window.gaps += 1
        return result

    def _render(self, env: Env) -> None:
        """Draw a picture and check its size."""
        picture: Any = env.render()
        if picture is None or picture.shape != (PICTURE["height"], PICTURE["width"], 3):
            raise RuntimeError("render() gave no picture of the size asked for")
        self.events["pictures"] += 1

    def _check_restore(self, env: Env, rng: np.random.Generator) -> bool:
        """Save, step, restore, repeat the steps; return whether they ended the episode.

        The steps are taken in the unwrapped environment, which has no time limit.
        """
        inner: Any = env.unwrapped
        actions = _uniform(env, rng, 5)
        snapshot = inner.save_state()
        ways: list[list[NDArray[np.float32]]] = []
        ended = False
        for _ in range(2):
            seen = []
            for action in actions:
                observation, _, _, ended, _ = self._advance(inner, action)
                seen.append(np.concatenate([observation[name] for name in sorted(observation)]))
                if ended:  # a change of mode ends the episode
                    break
            ways.append(seen)
            if len(ways) == 1:
                inner.restore_state(snapshot)
        self.events["restores"] += 1
        if not np.array_equal(ways[0], ways[1]):
            raise RuntimeError("what follows a restored state differs from what followed it first")
        return bool(ended)

    def _fail(self, env_id: str, number: int, error: Exception) -> None:
        """Record an exception with all that its replay needs."""
        last = traceback.extract_tb(error.__traceback__)[-1]
        self.failures.append(
            {
                "env_id": env_id,
                "visit": number,
                "seed": self.seed,
                "total_steps": self.steps,
                "episode": self._episode,
                "step": self._step,
                "error": f"{type(error).__name__}: {error}",
                "where": f"{Path(last.filename).name}:{last.lineno} {last.name}",
            }
        )
        print(f"visit {number}, {env_id}: {self.failures[-1]['error']}", file=sys.stderr)

    # -- samples ------------------------------------------------------------------------------

    def sample(self) -> dict[str, Any]:
        """Return the results of the last window, and the memory in use."""
        window, seconds = self.window, time.perf_counter() - self.window.begun
        shared.give_back_free_memory()
        result = {
            "steps": self.steps,
            "visits": self.visits,
            "all_opened": len(self.opened) == len(ENV_IDS),
            "memory_mb": shared.memory()[0],
            "open_files": shared.open_files(),
            "closure_mean": window.gap_sum / window.gaps if window.gaps else None,
            "closure_max": window.gap_max if window.gaps else None,
            "steps_per_second": window.steps / seconds,
        }
        self.window = Window()
        return result

    def close(self) -> None:
        """Close all environments."""
        while self._pool:
            _, env = self._pool.popitem()
            with contextlib.suppress(Exception):
                env.close()


def _uniform(env: Env, rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """Return uniform actions (count, n)."""
    shape = env.action_space.shape or (0,)
    return rng.uniform(-1.0, 1.0, (count, *shape)).astype(np.float32)


def _policy(env: Env, rng: np.random.Generator, observation: dict[str, Any]) -> Policy:
    """Return the policy of an episode."""
    kind = str(rng.choice(list(POLICIES), p=list(POLICIES.values())))
    if kind == "expert":
        expert = Expert(env)
        expert.reset(observation)
        return expert.act
    if kind == "uniform":
        return lambda _: _uniform(env, rng, 1)[0]
    return lambda _: np.sign(_uniform(env, rng, 1)[0])


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--every", type=int, help="steps between samples; default: a 200th of all")
    parser.add_argument("--warm-up", type=int, help="steps; default: a 20th of all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--engine", default="pybullet")
    parser.add_argument("--limit-mb", type=float, default=10.0, help="of growth after the warm-up")
    parser.add_argument("--json", type=Path, help="written anew at each sample")
    parser.add_argument("--plot", type=Path, help="where to draw the samples")
    parser.add_argument("--replay", type=int, metavar="VISIT", help="run this visit alone")
    options = parser.parse_args(arguments)
    if options.every is None:
        options.every = max(1, options.steps // 200)
    if options.warm_up is None:
        options.warm_up = options.steps // 20
    if min(options.steps, options.every) < 1:
        parser.error("--steps and --every must be 1 or more")
    return options


def main(arguments: Sequence[str] | None = None, make: Make = gym.make) -> int:
    """Run the soak; return the exit status, 0 if the run was finished and passed."""
    options = parse(arguments)
    words = sys.argv if arguments is None else ["benchmarks/soak.py", *arguments]
    soak = Soak(options.seed, options.engine, make)
    if options.replay is not None:
        soak.run_visit(options.replay)
        print(f"visit {options.replay} of seed {options.seed} raised nothing")
        soak.close()
        return 0
    content: dict[str, Any] = shared.describe(words) | {
        "seed": options.seed,
        "engine": options.engine,
        "steps": options.steps,
        "warm_up": options.warm_up,
        "limit_mb": options.limit_mb,
        "memory_kind": shared.memory()[1],
        "memory_before_mb": shared.memory()[0],
        "finished": False,
        "samples": [],
        "failures": soak.failures,
    }
    with contextlib.suppress(KeyboardInterrupt):
        _run(soak, options, content)
    soak.close()
    content["verdict"] = judge(content)
    _write(options, content, soak)
    print_verdict(content)
    if options.plot and content["samples"]:
        save_plot(content, options.plot)
    return 0 if content["verdict"]["passed"] else 1


def _run(soak: Soak, options: argparse.Namespace, content: dict[str, Any]) -> None:
    """Run visits until all steps are done, or too many have failed."""
    due = options.every
    while soak.steps < options.steps and len(soak.failures) < MOST_FAILURES:
        soak.visit()
        if soak.steps >= min(due, options.steps):
            due = soak.steps - soak.steps % options.every + options.every
            content["samples"].append(soak.sample())
            _write(options, content, soak)
            _progress(content["samples"][-1])
    content["finished"] = soak.steps >= options.steps


def _progress(sample: dict[str, Any]) -> None:
    """Print a sample."""
    gap = sample["closure_max"]
    print(
        f"{sample['steps']:>9} steps, {sample['memory_mb']:.1f} MB, largest gap "
        f"{'-' if gap is None else f'{1e6 * gap:.1f} um'}, "
        f"{sample['steps_per_second']:.0f} steps/s",
        flush=True,
    )


def _write(options: argparse.Namespace, content: dict[str, Any], soak: Soak) -> None:
    """Write the results so far, so that an interrupted run keeps its samples."""
    content["events"] = dict(sorted(soak.events.items()))
    if options.json:
        provenance.write_json(options.json, content)


if __name__ == "__main__":
    sys.exit(main())
