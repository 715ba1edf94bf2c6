"""Registry of tasks, and their names in options."""

from __future__ import annotations

import re
from typing import Any

from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.machine import Machine, find_machine
from tpm_gym.tasks.task import Task

TASKS: dict[str, type[Task]] = {}
"""Classes of the registered tasks by name; :func:`tpm_gym.register_task` fills it."""


def option_name(name: str) -> str:
    """Convert ``"PickAndPlace"`` to the name in options, ``"pick_and_place"``.

    Raises:
        ConfigurationError: If ``name`` is not in CamelCase.
    """
    if not isinstance(name, str) or not re.fullmatch(r"([A-Z][a-z0-9]*)+", name, re.ASCII):
        raise ConfigurationError("name", name, "a name in CamelCase, such as 'PickAndPlace'")
    return "_".join(re.findall(r"[A-Z][a-z0-9]*", name)).lower()


def make_task(task: Any, machine: str | Machine | None = None, **options: Any) -> Task:
    """Make a task from its name or class, or return the task itself.

    Args:
        machine: Machine or its name; None for the paper's machine.
        options: Options of :class:`Task`; None keeps a default.

    Raises:
        ConfigurationError: If there is no such task, an option is out of range, or options are
            given with an instance of a task.
    """
    options = {"machine": machine, **options}
    given = {name: value for name, value in options.items() if value is not None}
    if isinstance(task, Task):
        for name, value in given.items():
            raise ConfigurationError(name, value, "left out: a task that is made has its own")
        return task
    kind = TASKS.get(task) if isinstance(task, str) else task
    if not (isinstance(kind, type) and issubclass(kind, Task)):
        raise ConfigurationError("task", task, f"{', '.join(map(repr, TASKS))}, or a Task")
    return kind(find_machine(given.pop("machine", "paper")), **given)
