"""Environments of training, evaluation, demonstrations and films."""

import importlib
import os
import signal
import sys
from collections.abc import Mapping
from contextlib import suppress
from hashlib import sha256
from typing import Any, Final

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, load_env_creator

from tpm_gym.envs.ids import VECTOR_ENTRY_POINT, env_ids
from tpm_gym.envs.single import TPMEnv
from tpm_gym.envs.vector import TPMVectorEnv
from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.rollout import GoalEnv
from tpm_gym.mechanism.machine import Machine, find_machine, machine_names

USUAL: Final[Mapping[str, Any]] = {
    "machine": "paper",
    "engine": "pybullet",
    "drive": "ideal",
    "shield": False,
}
"""Machine, engine, drive and shield of an id whose registration does not set them."""


def import_module_of(env_id: str) -> None:
    """Import the module of an id ``module:id`` that the user has typed; do nothing for other ids.

    The module may be a file of the working folder. Do not call this function with an id that was
    read from a file: importing a module runs its code.
    """
    module = env_id.rpartition(":")[0]
    if not module:
        return
    if (folder := os.getcwd()) not in sys.path:
        # Workers import the module too, and they take over sys.path. The folder is the last entry,
        # so that its files hide no installed module.
        sys.path.append(folder)
    try:
        importlib.import_module(module)
    except Exception as error:  # whatever a user's module may raise
        reason = f"{type(error).__name__}: {error}"
        where = "run the command in the folder that holds it, or install it"
        raise ConfigError(f"{env_id}: cannot import {module!r} ({reason}); {where}") from error


def check_env_id(env_id: str) -> EnvSpec:
    """Return the registration of an environment id.

    The module of ``module:id`` is not imported here; it must already be imported.

    Raises:
        ConfigError: The module is not imported, the id is not registered, its environment is not
            derived from ``TPMEnv``, its vector environment is not derived from ``TPMVectorEnv``, or
            its registration has no ``max_episode_steps``, or has wrappers.
    """
    module, _, name = env_id.rpartition(":")
    if module and module not in sys.modules:
        raise ConfigError(
            f"{env_id} comes from a file and names the module {module!r}, which would run when it "
            f"is imported; if you trust the module, give --env {env_id}"
        )
    try:
        spec = gym.spec(name if module else env_id)
    except (gym.error.Error, ValueError) as error:  # ValueError: ":" with no module before it
        there = f"there are {', '.join(env_ids())}, and module:id for those that a module registers"
        if module:
            file = getattr(sys.modules[module], "__file__", None) or "a part of Python"
            there = f"the module is {file}; if you mean another file, give it another name"
        raise ConfigError(f"unknown environment {env_id!r}; {there}") from error
    if not _derives(spec.entry_point, TPMEnv):
        raise ConfigError(f"{env_id} is no environment of tpm_gym; it makes {spec.entry_point}")
    if not (_derives(spec.vector_entry_point, TPMVectorEnv) and spec.max_episode_steps):
        raise ConfigError(
            f"{env_id} is registered without vector_entry_point or max_episode_steps; register it "
            f"with vector_entry_point={VECTOR_ENTRY_POINT!r} and the steps of an episode"
        )
    if spec.additional_wrappers:
        names = ", ".join(wrapper.name for wrapper in spec.additional_wrappers)
        raise ConfigError(
            f"{env_id} is registered with the wrappers {names}, which vector environments do not "
            "have; register it without additional_wrappers"
        )
    return spec


def set_by(env_id: str) -> dict[str, Any] | None:
    """Return the options that the registration of an id sets, as in ``{"machine": "wide"}``.

    Nothing is imported. The result is None if no id of this name is registered.
    """
    spec = gym.registry.get(env_id.rpartition(":")[2])
    if spec is None:
        return None
    return {name: value for name, value in spec.kwargs.items() if value is not None}


def conditions_set_by(env_id: str) -> dict[str, Any]:
    """Return machine, engine, drive and shield that an id's registration sets, as plain data.

    A machine is written as its name. If a different machine is registered under this name, a suffix
    is appended, so that the name never stands for the wrong machine.
    """
    options = set_by(env_id) or {}
    found = {name: options[name] for name in USUAL if name in options}
    if isinstance(machine := found.get("machine"), Machine):
        found["machine"] = machine.name
        if machine.name in machine_names() and find_machine(machine.name) != machine:
            found["machine"] += f" ({sha256(repr(machine).encode()).hexdigest()[:8]})"
    return {
        name: value if isinstance(value, bool | float) else _printable(str(value))
        for name, value in found.items()
    }


def _printable(text: str) -> str:
    """Convert a text to at most 100 printable characters of ASCII, for policy files."""
    return text.encode("unicode_escape").decode()[:100]


def _derives(entry: Any, kind: type) -> bool:
    """Return whether the entry point of a registration is a class derived from ``kind``."""
    if isinstance(entry, str):
        with suppress(ImportError, AttributeError):
            entry = load_env_creator(entry)
    return isinstance(entry, type) and issubclass(entry, kind)


def make_env(env: str | EnvSpec, *, in_worker: bool = False, **options: Any) -> GoalEnv:
    """Make an environment, with arguments such as ``goals`` and ``penalty_weight``.

    Args:
        env: An id, or the registration of an id. A registration also works in a process where the
            id is not registered.
        in_worker: Whether this is a worker process. Ctrl-C reaches all processes of a terminal. A
            worker ignores it, so that the main process can still save.
    """
    if in_worker:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
    return gym.make(env, **options)


def make_envs(env: str | EnvSpec, count: int, **options: Any) -> TPMVectorEnv:
    """Make a vector of environments; options as for :func:`make_env`."""
    envs = gym.make_vec(env, num_envs=count, **options)
    assert isinstance(envs, TPMVectorEnv)
    return envs
