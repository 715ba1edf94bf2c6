"""Checks: a task can start, and computes the same for a state alone as for it in a batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tpm_gym.arrays import brief, finite
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.state import Scene, State
from tpm_gym.tasks.task import Task

_EXAMPLES = 7
"""Number of states with which a task is checked.

No other axis has a length of 7, so that an axis of states cannot be confused with another axis.
"""
_OWN_ROW = (
    "equal results for equal states: from the robot's own row (reduce by axis=-1), and in every "
    "call (store nothing in the task)"
)


def check(task: Task, taken: Sequence[str] = ()) -> None:
    """Check that a task can start, and that a state has equal results alone and in a batch.

    A task cannot start if the machine has no room for it, or has no tempting goals (just above the
    threshold of safe conditioning) although ``goals`` is ``"tempting"``. A method that reduces over
    the robots (``np.linalg.norm(x)`` without ``axis=-1``), or confuses the axis of the robots with
    another axis, gives wrong rewards in vector environments without an error.

    Args:
        taken: Names that no event may have.

    Raises:
        ConfigurationError: If the task cannot start, an attribute is not valid, an event's name is
            taken, or a result is wrong; the error names the attribute or the method.
    """
    known = list(taken)
    for event in task.events:
        if event in known:
            raise ConfigurationError("events", event, f"names other than {', '.join(known)}")
        if event.startswith("_"):
            raise ConfigurationError("events", event, "names that do not begin with _")
        if not callable(getattr(task, event, None)):
            raise ConfigurationError("events", event, "names of methods of the task")
        known.append(event)
    task.start([np.random.default_rng(0)])
    several = _example_states(task.machine, task.scene)
    _check_shapes(task, several)
    together = _results(task, several)
    for row in (0, _EXAMPLES - 1):
        alone = _results(task, several.take([row]))
        for name, values in together.items():
            shape, single = np.shape(values), alone.get(name, ())
            if shape[:1] != (_EXAMPLES,) or np.shape(single) != (1, *shape[1:]):
                raise _wrong_rows(name, values, "(n, ...)")
            if not np.allclose(values[row], single[0], equal_nan=True):
                found = f"{brief(values[row])} among {_EXAMPLES} robots, {brief(single[0])} alone"
                raise ConfigurationError(name, found, _OWN_ROW)


def _results(task: Task, state: State) -> dict[str, Any]:
    """Call every method of a task that reads a state; return the results by name."""
    achieved = task.achieved(state)
    return {
        "achieved()": achieved,
        "observe()": task.observe(state),
        **{f"shaping()[{name!r}]": values for name, values in task.shaping(state).items()},
        **{f"{event}()": getattr(task, event)(state) for event in task.events},
        "gap()": task.gap(achieved, np.zeros((len(state.held), task.goal_size))),
    }


def _check_shapes(task: Task, state: State) -> None:
    """Refuse methods whose results have the wrong shape or type."""
    achieved = np.shape(task.achieved(state))
    if achieved != (_EXAMPLES, task.goal_size):
        valid = f"of shape (n, {task.goal_size}), as goal_size says"
        raise ConfigurationError("achieved()", f"of shape {achieved} for {_EXAMPLES}", valid)
    shaping: object = task.shaping(state)
    if not isinstance(shaping, Mapping):
        raise ConfigurationError("shaping()", shaping, "a dictionary of terms; {} for none")
    for name, values in shaping.items():
        if name in ("goal", "singularity"):
            raise ConfigurationError("shaping()", name, "names other than goal, singularity")
        if not isinstance(name, str) or name.startswith("_"):  # infos have a mask _name
            raise ConfigurationError("shaping()", name, "names that do not begin with _")
        finite(f"shaping()[{name!r}]", values, (_EXAMPLES,), ConfigurationError)
        if not isinstance(values, np.ndarray):
            raise ConfigurationError(f"shaping()[{name!r}]", type(values), "an array (n,)")
    for event in task.events:
        values = np.asarray(getattr(task, event)(state))
        if (kind := values.dtype) != np.bool_:
            raise ConfigurationError(f"{event}()", f"of type {kind}", "(n,) bool")
        _require_shape(f"{event}()", values, ())
    for entry in task.entries:  # before observe(), whose compiled loops do not check lengths
        seen = np.asarray(entry.source(state))
        if seen.ndim == 2 and entry.columns is not None:
            seen = seen[:, slice(*entry.columns)]
        _require_shape(f"observed(), {entry.name!r}", seen, (len(entry.scale),))
    gap = task.gap(task.achieved(state), np.zeros((_EXAMPLES, task.goal_size)))
    _require_shape("gap()", gap, ())


def _require_shape(name: str, values: Any, shape: tuple[int, ...]) -> None:
    """Refuse values that are not of this shape for each robot."""
    if np.shape(values) != (_EXAMPLES, *shape):
        raise _wrong_rows(name, values, f"(n, {shape[0]})" if shape else "(n,)")


def _wrong_rows(name: str, values: Any, wanted: str) -> ConfigurationError:
    valid = f"values {wanted} for n robots, each from its own row; reduce by axis=-1"
    return ConfigurationError(name, f"of shape {np.shape(values)} for {_EXAMPLES}", valid)


def _example_states(machine: Machine, scene: Scene) -> State:
    """Return different states that a machine could be in, with a scene's objects."""
    rng, objects, count = np.random.default_rng(0), len(scene.objects), _EXAMPLES
    shape = (count, 3 + objects, 3)
    inside = machine.mount.to_world(rng.uniform(machine.region.low, machine.region.high, shape))
    turn = rng.normal(size=(count, objects, 4)) * (0.1, 0.1, 1.0, 1.0)
    turn /= np.linalg.norm(turn, axis=2, keepdims=True)
    x, y, z, w = np.moveaxis(turn, 2, 0)
    axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=2)
    never = np.zeros(count, dtype=np.bool_)
    return State(
        theta=rng.normal(size=(count, 3)), theta_dot=rng.normal(size=(count, 3)),
        torque=rng.normal(size=(count, 3)), fk_position=inside[:, 0].copy(),
        fk_velocity=rng.normal(size=(count, 3)), conditioning=rng.uniform(0.05, 0.2, count),
        platform_position=inside[:, 1], platform_tilt=rng.random(count),
        closure_error=rng.random(count),
        assembly_mode_changed=never, working_mode_changed=never, command=inside[:, 2].copy(),
        held=np.arange(count) % 2 - 1, vacuum=rng.uniform(0.0, CUP.vacuum, count),
        object_position=inside[:, 3:], object_quaternion=turn, object_axis=axis,
        object_velocity=rng.normal(size=(count, objects, 3)),
        object_angular_velocity=rng.normal(size=(count, objects, 3)),
        belt_speed=rng.normal(size=count),
    )  # fmt: skip
