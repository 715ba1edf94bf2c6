"""Goals that tempt towards the singularity: to reach them carelessly, one passes too near to it.

In point P a straight line between two safe points stays safe (the safe set shows no dent; a test
draws pairs), so with Cartesian actions the temptation lies at the ends: the goal, and a puck's
start, lie just within the threshold, and nearly half of what counts as reaching the goal lies
beyond it. With joint actions it also lies on the way: the straight line in the joint angles from
the start to the goal leads through the unsafe region, often all the way.

Both are asked for of every pair, so that all ids meet the same goals. ``tempting/<id>`` is ``<id>``
with such goals; train.py and evaluate.py make it with ``--goals tempting``.
"""

from __future__ import annotations

from typing import Any, Final

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

import tpm_gym
from tpm_gym import kinematics
from tpm_gym.kinematics import jacobian, workspace
from tpm_gym.kinematics.workspace import Region
from tpm_gym.learning.rollout import Action, Observation
from tpm_gym.mechanism.tree import CUP_LENGTH, DEFAULT_MOUNT
from tpm_gym.tasks import rewards
from tpm_gym.tasks import task as tasks
from tpm_gym.tasks.rewards import SAFE_CONDITIONING

GOALS: Final = ("sampled", "tempting")
"""What ``--goals`` may be; the first is the environments' own sampling."""
BAND: Final = 0.004
"""How far above the threshold the conditioning of a tempting end may be: less than 1 mm of y."""

_NAMESPACE: Final = "tempting"
_SALT: Final = 0x7E3970  # sets the pairs' generator apart from the environment's, seeded alike
_BATCH: Final = 256
_FRACTIONS: Final = np.linspace(0.0, 1.0, 33)

FloatArray = NDArray[np.float64]


class TemptingGoals(gym.Wrapper[Observation, Action, Observation, Action]):
    """Starts every episode with a pair drawn by :func:`draw_pair`.

    Equal seeds give equal pairs. A reset without a seed draws from the environment's generator, so
    that an episode can be repeated from that generator's state. ``options`` overrule the pair.

    Args:
        env: An environment of tpm_gym.
    """

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; see the class."""
        env: Any = self.unwrapped
        rng = env.np_random if seed is None else np.random.default_rng([_SALT, seed])
        return self.env.reset(seed=seed, options={**draw_pair(rng, env.task), **(options or {})})


def draw_pair(rng: np.random.Generator, task: tasks.Task) -> dict[str, FloatArray]:
    """Draw a goal, and where the task has a puck its start, that tempt.

    Args:
        rng: Source of randomness.
        task: The task of the environment.

    Returns:
        Options for a reset: ``goal`` and, with a puck, ``object``, each (3,) m in the world frame.
    """
    offset = _tool_offset(task)
    puck = task.scene.puck
    while True:
        goals = _at_the_threshold(rng, _goal_region(rng, task))  # (n, 3), P in the paper frame
        starts = (
            np.tile(task.home, (len(goals), 1))
            if puck is None
            else _at_the_threshold(rng, _level(_table_level(puck.height)))
        )
        for start, goal in zip(starts, goals, strict=False):
            apart = rewards.distance(start, goal) >= tasks.MIN_SEPARATION
            if apart and (line_in_joints(start, goal) < SAFE_CONDITIONING).any():
                ends = {"goal": goal} if puck is None else {"goal": goal, "object": start}
                return {name: DEFAULT_MOUNT.to_world(end) - offset for name, end in ends.items()}


def line_in_space(start: ArrayLike, end: ArrayLike) -> FloatArray:
    """Conditioning at 33 points of the straight line of P from ``start`` to ``end``.

    Args:
        start: (..., 3) m, paper frame; reachable.
        end: (..., 3) m, paper frame; reachable.

    Returns:
        (33, ...) 1/cond(J), from ``start`` to ``end``.
    """
    first, last = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    return workspace.conditioning_at(_between(first, last))


def line_in_joints(start: ArrayLike, end: ArrayLike) -> FloatArray:
    """The same for the straight line of the joint angles; 0 where they cannot be assembled.

    Args:
        start: (..., 3) m, paper frame; reachable.
        end: (..., 3) m, paper frame; reachable.

    Returns:
        (33, ...) 1/cond(J), from ``start`` to ``end``.
    """
    theta = _between(kinematics.inverse(start), kinematics.inverse(end))
    slot = kinematics.DEFAULT_ASSEMBLY.index
    assembled = kinematics.forward_all(theta).valid[..., slot]
    result = np.zeros(theta.shape[:-1])
    result[assembled] = jacobian.conditioning(theta[assembled], kinematics.DEFAULT_ASSEMBLY)
    return result


def env_id_for(env_id: str, goals: str) -> str:
    """Return the id under which an environment with such goals is registered."""
    return env_id if goals == GOALS[0] else f"{_NAMESPACE}/{env_id}"


def _between(first: FloatArray, last: FloatArray) -> FloatArray:
    """Points (33, ..., 3) of a straight line."""
    fractions = _FRACTIONS.reshape(-1, *(1,) * first.ndim)
    line: FloatArray = first + fractions * (last - first)
    return line


def _at_the_threshold(rng: np.random.Generator, region: Region) -> FloatArray:
    """The points of a batch drawn from ``region`` that are safe, but only just, (n, 3)."""
    points = rng.uniform(region.low, region.high, (_BATCH, 3))
    conditioning = workspace.conditioning_at(points)
    just = (conditioning >= SAFE_CONDITIONING) & (conditioning < SAFE_CONDITIONING + BAND)
    chosen: FloatArray = points[just]
    return chosen


def _goal_region(rng: np.random.Generator, task: tasks.Task) -> Region:
    """Where P has to go: as the task samples it, with a puck half on the table, half above it."""
    puck = task.scene.puck
    if puck is None:
        return tasks.GOAL_REGION
    level = _table_level(puck.height)
    if rng.random() < 0.5:
        return _level(level)
    low, high = tasks.GOAL_REGION.low, tasks.GOAL_REGION.high
    return Region(low, (high[0], high[1], level - tasks.MIN_SEPARATION))


def _level(level: float) -> Region:
    """The part of the goal region at one height, paper frame."""
    low, high = tasks.GOAL_REGION.low, tasks.GOAL_REGION.high
    return Region((low[0], low[1], level), (high[0], high[1], level))


def _table_level(height: float) -> float:
    """Height of P, paper frame, when the cup touches a puck of that height on the table, m."""
    return float(DEFAULT_MOUNT.to_paper(np.array([0.0, 0.0, height + CUP_LENGTH]))[2])


def _tool_offset(task: tasks.Task) -> FloatArray:
    """From what has to be at the goal to point P, world, m."""
    puck = task.scene.puck
    return np.array([0.0, 0.0, 0.0 if puck is None else puck.height / 2 + CUP_LENGTH])


def _make(**options: Any) -> TemptingGoals:
    """Make an environment with tempting goals; what the registry calls."""
    from tpm_gym.envs.env import TPMEnv  # starts the engine's library, which prints a line

    return TemptingGoals(TPMEnv(**options))


for _id in tpm_gym.ENV_IDS:
    _spec = gym.spec(_id)
    gym.register(
        id=env_id_for(_id, "tempting"),
        entry_point=_make,
        kwargs=_spec.kwargs,
        max_episode_steps=_spec.max_episode_steps,
    )
