"""What an environment reports of a state: the observation, and the info with the reward's terms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from tpm_gym.simulation.state import State
from tpm_gym.tasks import rewards
from tpm_gym.tasks.task import Task

__all__ = [
    "Observation",
    "box",
    "goal_free_reward",
    "info",
    "observation",
    "observation_space",
    "reward",
]

Observation = dict[str, Any]  # arrays of float32

_OBSERVATION_BOUND = 10.0
_GOAL_BOUND = 2.0


def observation_space(task: Task) -> spaces.Dict:
    """The space of a task's observations."""
    return spaces.Dict(
        {
            "observation": box(_OBSERVATION_BOUND, task.observation_size),
            "achieved_goal": box(_GOAL_BOUND, 3),
            "desired_goal": box(_GOAL_BOUND, 3),
        }
    )


def box(bound: float, length: int) -> spaces.Box:
    """The cube of that many dimensions from -bound to bound."""
    return spaces.Box(-bound, bound, (length,), np.float32)


def observation(task: Task, state: State, goal: NDArray[np.float64]) -> Observation:
    """The observation of a state; new arrays each time."""
    return {
        "observation": _clip(task.observe(state), _OBSERVATION_BOUND),
        "achieved_goal": _clip(task.achieved(state), _GOAL_BOUND),
        "desired_goal": goal.astype(np.float32),
    }


def info(task: Task, state: State, seen: Observation, penalty_weight: float) -> dict[str, Any]:
    """The info of a state whose observation is ``seen``."""
    gap = rewards.distance(seen["achieved_goal"], seen["desired_goal"])
    passed = state.mode_change is not None
    penalty = 1.0 if passed else float(rewards.singularity_penalty(state.conditioning))
    terms = {
        "goal": float(task.goal_term_at(gap)),
        "singularity": -penalty_weight * penalty,
    }
    terms.update((name, float(value)) for name, value in task.state_terms(state).items())
    return {
        "is_success": bool(task.success_at(gap)),
        "closure_error": float(state.closure_error),
        "conditioning": float(state.conditioning),
        "singularity_penalty": penalty,
        "assembly_mode_changed": state.mode_change == "assembly",
        "working_mode_changed": state.mode_change == "working",
        "reward_terms": terms,
    }


def reward(info: Mapping[str, Any], penalty_weight: float) -> float:
    """The reward of a step, from its info."""
    total: float = info["reward_terms"]["goal"] + goal_free_reward(info, penalty_weight)
    return total


def goal_free_reward(info: Mapping[str, Any], penalty_weight: float) -> float:
    """Sum of the terms in ``info`` that do not depend on the goal; 0 for an empty one."""
    shaped = sum(
        value
        for name, value in info.get("reward_terms", {}).items()
        if name not in ("goal", "singularity")
    )
    return float(shaped - penalty_weight * info.get("singularity_penalty", 0.0))


def _clip(values: NDArray[np.float64], bound: float) -> NDArray[np.float32]:
    clipped: NDArray[np.float32] = np.minimum(np.maximum(values, -bound), bound).astype(np.float32)
    return clipped
