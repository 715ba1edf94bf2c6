"""What an environment says of a state: the same for one and for many."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.arrays import FloatArray, numbers
from tpm_gym.errors import ConfigurationError, InputError
from tpm_gym.simulation.state import State
from tpm_gym.tasks.task import Task

__all__ = ["GOAL_BOUND", "OBSERVATION_BOUND", "Observation", "compute_reward", "observe", "report"]

OBSERVATION_BOUND = 10.0
GOAL_BOUND = 2.0

Observation = dict[str, Any]  # arrays of float32


def observe(task: Task, state: State, goal: FloatArray) -> Observation:
    """The observation, for any leading batch shape."""
    return {
        "observation": _clip(task.observe(state), OBSERVATION_BOUND),
        "achieved_goal": _clip(task.achieved(state), GOAL_BOUND),
        "desired_goal": goal.astype(np.float32),
    }


def report(
    task: Task, state: State, goal: FloatArray
) -> tuple[Observation, FloatArray, dict[str, Any]]:
    """Observation, reward (...,) and info, whose values are numbers or arrays (...,) too.

    Raises:
        ConfigurationError: If the task makes something of the state that is no number.
    """
    observation = observe(task, state, goal)
    achieved, desired = observation["achieved_goal"], observation["desired_goal"]
    gap, penalty = task.gap(achieved, desired), task.penalty(state)
    terms = task.reward_terms(state, gap, penalty)
    reward = terms["goal"] + _goal_free(terms)
    if not math.isfinite(_total(observation["observation"], achieved, reward)):
        raise _not_finite(task, state, achieved, terms)
    return (
        observation,
        reward,
        {
            "is_success": task.success(gap),
            "closure_error": state.closure_error,
            "vacuum": state.vacuum,
            "conditioning": state.conditioning,
            "singularity_penalty": penalty,
            "assembly_mode_changed": state.assembly_mode_changed,
            "working_mode_changed": state.working_mode_changed,
            "object_lost": task.lost(state),
            "reward_terms": terms,
        },
    )


def _total(observed: FloatArray, achieved: FloatArray, reward: FloatArray) -> float:
    """A number that is finite where all of these are, in the cheapest way for one and for many."""
    if observed.ndim == 1:
        return float(sum(observed.tolist()) + sum(achieved.tolist()) + reward)
    squares = np.vdot(observed, observed) + np.vdot(achieved, achieved)
    return float(squares + np.add.reduce(reward, axis=None))


def _goal_free(terms: Mapping[str, Any]) -> Any:
    """Sum of the reward's terms that do not depend on the goal; 0 where there is none."""
    total: Any = np.float64(0.0)  # whatever precision a task's own terms have
    for name, value in terms.items():
        if name != "goal":
            total = total + value
    return total


def compute_reward(task: Task, achieved: ArrayLike, desired: ArrayLike, info: Any) -> Any:
    """The reward of transitions for any goals; see :meth:`tpm_gym.TPMEnv.compute_reward`.

    Raises:
        InputError: If the goals are no real numbers of these shapes, or ``info`` is neither.
    """
    _require_goals(task.goal_size, achieved, desired)
    goal_term = np.asarray(task.goal_term(task.gap(achieved, desired)))
    try:
        if isinstance(info, Mapping):
            other: Any = _goal_free_in(info)
        else:
            other = np.array([_goal_free_in(entry) for entry in info]).reshape(goal_term.shape)
    except (AttributeError, TypeError, ValueError) as error:
        valid = f"a step's info, or one for each of the {goal_term.size} transitions"
        raise InputError("info", type(info), valid) from error
    total = goal_term + other
    return float(total) if np.ndim(total) == 0 else total


def _require_goals(size: int, achieved: ArrayLike, desired: ArrayLike) -> None:
    """Refuse what is no batch of goals; what is not finite is no success, but may be asked for."""
    shapes = [numbers("achieved_goal", achieved).shape, numbers("desired_goal", desired).shape]
    try:
        np.broadcast_shapes(*shapes)
        fit = all(shape[-1:] == (size,) for shape in shapes)
    except ValueError:
        fit = False
    if not fit:
        valid = f"of shapes (..., {size}) that go together, by shape"
        raise InputError("achieved_goal, desired_goal", shapes, valid)


def _goal_free_in(info: Mapping[str, Any]) -> float:
    """Sum of the reward's terms in ``info`` that do not depend on the goal; 0 for an empty one."""
    return float(_goal_free(info.get("reward_terms", {})))


def _not_finite(
    task: Task, state: State, achieved: FloatArray, terms: Mapping[str, Any]
) -> ConfigurationError:
    """Which of the values that a task made of a state is at fault for one that is not finite."""
    values = {
        **{f"observed(), {entry.name!r}": entry.source(state) for entry in task.entries},
        "achieved()": achieved,
        **{f"reward_terms()[{name!r}]": value for name, value in terms.items()},
    }
    name, value = next(item for item in values.items() if not np.isfinite(item[1]).all())
    return ConfigurationError(name, np.asarray(value).tolist(), "finite numbers from the task")


def _clip(values: FloatArray, bound: float) -> NDArray[np.float32]:
    return np.minimum(np.maximum(values, -bound), bound).astype(np.float32, order="C")
