"""The one place where training, evaluation, demonstrations and films get their environments."""

import importlib
import signal
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, load_env_creator

from tpm_gym.envs.env import TPMEnv
from tpm_gym.envs.registration import env_ids
from tpm_gym.envs.vector import TPMVectorEnv
from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.rollout import GoalEnv


def check_env_id(env_id: str) -> EnvSpec:
    """Make sure that an id is that of an environment of tpm_gym, ours or registered by a user.

    Args:
        env_id: A registered id, or ``module:id``, for which the module is imported first.

    Raises:
        ConfigError: The module cannot be imported, or the id is not registered, or is that of an
            environment without goal, conditioning and loops to evaluate.
    """
    module, _, name = env_id.rpartition(":")
    try:
        if module:
            importlib.import_module(module)
    except Exception as error:  # whatever a user's module may raise
        reason = f"{type(error).__name__}: {error}"
        where = "install it, or say python -m tpm_gym.learning in the folder that holds it"
        raise ConfigError(f"{env_id}: cannot import {module!r} ({reason}); {where}") from error
    try:
        spec = gym.spec(name)
    except gym.error.Error as error:
        there = f"there are {', '.join(env_ids())}, and module:id for those that a module registers"
        raise ConfigError(f"unknown environment {env_id!r}; {there}") from error
    if not _is_ours(spec):
        raise ConfigError(f"{env_id} is no environment of tpm_gym; it makes {spec.entry_point}")
    return spec


def _is_ours(spec: EnvSpec) -> bool:
    """Whether an id makes a ``TPMEnv``, or what derives from it."""
    entry: Any = spec.entry_point
    if isinstance(entry, str):
        try:
            entry = load_env_creator(entry)
        except (ImportError, AttributeError):
            return False
    return isinstance(entry, type) and issubclass(entry, TPMEnv)


def make_env(env: str | EnvSpec, *, in_worker: bool = False, **options: Any) -> GoalEnv:
    """Make an environment, with arguments such as ``goals`` and ``penalty_weight``.

    Args:
        env: An id, or what Gymnasium has registered, which another process may not have.
        in_worker: Whether this runs in a process of its own, which has to outlive the signal that
            a terminal or a batch system sends to all processes, until the main one has saved.
    """
    if in_worker:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
    return gym.make(env, **options)


def make_envs(env: str | EnvSpec, count: int, **options: Any) -> TPMVectorEnv:
    """Make so many environments in closed form; options are as for :func:`make_env`."""
    envs = gym.make_vec(env, num_envs=count, **options)
    assert isinstance(envs, TPMVectorEnv)
    return envs
