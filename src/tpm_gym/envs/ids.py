"""Ids of the environments in Gymnasium's registry."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator
from inspect import isabstract
from typing import Any

import gymnasium as gym

from tpm_gym import tasks
from tpm_gym.arrays import is_whole
from tpm_gym.errors import ConfigurationError
from tpm_gym.tasks.registry import TASKS, option_name
from tpm_gym.tasks.task import Task

ENTRY_POINT = "tpm_gym.envs.single:TPMEnv"
VECTOR_ENTRY_POINT = "tpm_gym.envs.vector:TPMVectorEnv"


def register_task(
    name: str, task: type[Task], *, version: int = 0, max_episode_steps: int | None = None
) -> tuple[str, ...]:
    """Register a task's ids ``TPM<name>{,Joints}{,Dense}-v<version>``.

    Ids with ``Joints`` are registered if ``task.controls`` has joint control. A second call
    with equal arguments changes nothing.

    ``TPMEnv(task=...)`` accepts ``name`` in snake case. The command line, and worker processes that
    are spawned rather than forked, need ``"module:id"``: importing the module registers the id.

    Args:
        name: Name in CamelCase, e.g. ``"PickAndPlace"``.
        task: The class. A class that was defined again, as in a notebook, replaces the old one.
        version: Version at the end of the ids.
        max_episode_steps: Steps after which episodes are truncated; None for the task's own number.

    Returns:
        The ids.

    Raises:
        ConfigurationError: If an argument is not possible, or the name or an id is taken; nothing
            is registered then.
    """
    option = option_name(name)
    if not (isinstance(task, type) and issubclass(task, Task)) or isabstract(task):
        valid = "a class derived from tpm_gym.tasks.Task, with sample"
        raise ConfigurationError("task", task, valid)
    if max_episode_steps is None:
        max_episode_steps = task.max_episode_steps
    for label, number, least in (
        ("version", version, 0),
        ("max_episode_steps", max_episode_steps, 1),
    ):
        if not is_whole(number, least):
            raise ConfigurationError(label, number, f"a whole number, {least} or more")
    if _path(TASKS.get(option, task)) != _path(task):
        raise ConfigurationError("name", name, f"another name; {TASKS[option]} has this one")
    variants: dict[str, dict[str, Any]] = {
        f"TPM{name}{joints}{dense}-v{version}": {
            "entry_point": ENTRY_POINT,
            "vector_entry_point": VECTOR_ENTRY_POINT,
            "max_episode_steps": int(max_episode_steps),  # for JSON
            "kwargs": {"task": option, "control": control, "reward": reward},
        }
        for control, joints in (("cartesian", ""), ("joints", "Joints"))
        if control in task.controls
        for reward, dense in (("sparse", ""), ("dense", "Dense"))
    }
    for env_id, spec in variants.items():
        other = gym.registry.get(env_id)
        if other is not None and any(getattr(other, key) != spec[key] for key in spec):
            valid = f"another name or version: {env_id} is there already, and is not this"
            raise ConfigurationError("name", name, valid)
    TASKS[option] = task
    for env_id, spec in variants.items():
        if env_id not in gym.registry:
            gym.register(env_id, **spec)
    return tuple(variants)


def env_ids() -> tuple[str, ...]:
    """Return the ids of all environments, including users' tasks."""
    return tuple(env_id for env_id, spec in gym.registry.items() if spec.entry_point == ENTRY_POINT)


def _path(task: type[Task]) -> tuple[str, str]:
    return task.__module__, task.__qualname__


def _built_in() -> Iterator[type[Task]]:
    """Yield the task classes in the files of :mod:`tpm_gym.tasks`."""
    for _, name, _ in pkgutil.iter_modules(tasks.__path__, f"{tasks.__name__}."):
        for value in vars(importlib.import_module(name)).values():
            # The module is compared first, since issubclass would raise on an imported list[int],
            # which isinstance takes for a type in Python 3.10.
            ours = getattr(value, "__module__", None) == name and isinstance(value, type)
            if ours and issubclass(value, Task) and not isabstract(value):
                yield value


for _task in _built_in():
    register_task(_task.__name__, _task)
