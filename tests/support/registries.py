"""Registries of tasks and environments that tests change."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import gymnasium as gym

from tpm_gym.tasks.registry import TASKS


@contextmanager
def registries_put_back(*modules: str) -> Iterator[None]:
    """Forget at the end what was registered inside: other tests count tasks and ids.

    Args:
        modules: Names of modules that register when they are imported; another test may have
            imported them before, so they are imported anew inside.
    """
    for module in modules:
        sys.modules.pop(module, None)
    with patch.dict(gym.registry), patch.dict(TASKS):
        yield


def register_like(like: str, name: str, *, steps: int, kwargs: dict[str, Any]) -> None:
    """Register an id whose environments are of the classes of ``like``, with other arguments."""
    spec = gym.spec(like)
    gym.register(
        name,
        entry_point=spec.entry_point,
        vector_entry_point=spec.vector_entry_point,
        max_episode_steps=steps,
        kwargs=kwargs,
    )
