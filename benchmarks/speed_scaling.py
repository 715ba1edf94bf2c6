"""Steps per second of two processes, and of Gymnasium's vector environments.

Two processes have an environment each and run the same loop. One runs alone while the other sleeps,
or both start together at a barrier. Both cases take turns, so that noise of the computer affects
them alike.
"""

from __future__ import annotations

import multiprocessing
import time
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Barrier
from typing import Any

import gymnasium as gym
import numpy as np
from shared import quartiles

import tpm_gym  # noqa: F401  (registers the ids, in the processes too)

__all__ = ["measure"]

_WARM_UP = 100  # steps
_PATIENCE = 120.0  # longest wait for a process, s


def worker(env_id: str, seed: int, pipe: Connection, barrier: Barrier) -> None:
    """Run steps on request, alone or from the barrier on, and send the seconds.

    Args:
        env_id: Environment.
        seed: Seed of the actions and the first reset.
        pipe: Receives (steps, together), or None to end; sends seconds.
        barrier: Barrier of all processes.
    """
    env = gym.make(env_id)
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    _run(env, rng, _WARM_UP)
    pipe.send(0.0)
    while (order := pipe.recv()) is not None:
        steps, together = order
        if together:
            barrier.wait(_PATIENCE)
        pipe.send(_run(env, rng, steps))
    env.close()


def _run(env: gym.Env[Any, Any], rng: np.random.Generator, steps: int) -> float:
    """Measure the seconds of random steps, with a reset at the end of each episode."""
    shape = env.action_space.shape or (0,)
    actions = rng.uniform(-1.0, 1.0, (steps, *shape)).astype(np.float32)
    begun = time.perf_counter()
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
    return time.perf_counter() - begun


class _Pair:
    """Two processes with an environment each."""

    def __init__(self, env_id: str) -> None:
        """Start both processes and wait until they have warmed up."""
        context = multiprocessing.get_context("spawn")
        barrier = context.Barrier(2)
        self._pipes, self._processes = [], []
        for seed in range(2):
            ours, theirs = context.Pipe()
            process = context.Process(
                target=worker, args=(env_id, seed, theirs, barrier), daemon=True
            )
            process.start()
            theirs.close()  # so that the pipe ends when the process dies
            self._pipes.append(ours)
            self._processes.append(process)
        for pipe in self._pipes:
            _answer(pipe)

    def alone(self, which: int, steps: int) -> float:
        """Measure steps per second of one process while the other sleeps."""
        self._pipes[which].send((steps, False))
        return steps / _answer(self._pipes[which])

    def together(self, steps: int) -> float:
        """Measure steps per second of both processes, by the slower one."""
        for pipe in self._pipes:
            pipe.send((steps, True))
        return 2 * steps / max(_answer(pipe) for pipe in self._pipes)

    def close(self) -> None:
        """End both processes."""
        for pipe, process in zip(self._pipes, self._processes, strict=True):
            if process.is_alive():
                pipe.send(None)
            process.join(10.0)
            if process.is_alive():
                process.terminate()


def _answer(pipe: Connection) -> float:
    """Return the answer of a process.

    Raises:
        RuntimeError: The process does not answer, or has died.
    """
    if not pipe.poll(_PATIENCE):
        raise RuntimeError(f"a process has not answered for {_PATIENCE:.0f} s")
    try:
        return float(pipe.recv())
    except EOFError as error:
        raise RuntimeError("a process has died; its error is printed above") from error


def measure(env_id: str, rounds: int, steps: int) -> dict[str, Any]:
    """Run the rounds and return quartiles of rates and ratios.

    Args:
        env_id: Environment.
        rounds: Rounds of one process, two processes, and both kinds of vector environment.
        steps: Steps of each process in a round.
    """
    alone, together = _processes(env_id, rounds, steps)
    synchronous, asynchronous = _vectors(env_id, rounds, steps)
    return {
        "env_id": env_id,
        "rounds": rounds,
        "steps": steps,
        "one_process": quartiles(alone),
        "two_processes": quartiles(together),
        "two_over_one": quartiles(np.divide(together, alone)),
        "sync_vector_env": quartiles(synchronous),
        "async_vector_env": quartiles(asynchronous),
        "async_over_sync": quartiles(np.divide(asynchronous, synchronous)),
    }


def _processes(env_id: str, rounds: int, steps: int) -> tuple[list[float], list[float]]:
    """Measure steps per second of one process and of two in each round, in changing order."""
    alone, together = [], []
    pair = _Pair(env_id)
    try:
        for number in range(rounds):
            if number % 2:
                together.append(pair.together(steps))
            alone.append(pair.alone(number // 2 % 2, steps))
            if not number % 2:
                together.append(pair.together(steps))
    finally:
        pair.close()
    return alone, together


def _vectors(env_id: str, rounds: int, steps: int) -> tuple[list[float], list[float]]:
    """Measure steps per second of SyncVectorEnv and AsyncVectorEnv with two environments."""
    both = [
        gym.make_vec(env_id, num_envs=2, vectorization_mode="sync"),
        gym.make_vec(
            env_id, num_envs=2, vectorization_mode="async", vector_kwargs={"context": "spawn"}
        ),
    ]
    rates: tuple[list[float], list[float]] = ([], [])
    rng, shape = np.random.default_rng(0), both[0].action_space.shape or (2, 0)
    try:
        for number in range(-1, rounds):
            actions = rng.uniform(-1, 1, (steps, *shape)).astype(np.float32)
            for index in (0, 1) if number % 2 else (1, 0):
                if number < 0:
                    both[index].reset(seed=0)
                begun = time.perf_counter()
                for action in actions[: _WARM_UP if number < 0 else None]:
                    both[index].step(action)
                if number >= 0:
                    rates[index].append(2 * steps / (time.perf_counter() - begun))
    finally:
        for vector in both:
            vector.close()
    return rates
