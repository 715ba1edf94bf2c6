"""Gymnasium environments of an asymmetric 3-translational parallel mechanism.

Importing this package registers the ids in ``ENV_IDS``; it imports no engine and no torch.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from tpm_gym.envs.ids import env_ids, register_task
from tpm_gym.envs.single import TPMEnv
from tpm_gym.envs.vector import TPMVectorEnv
from tpm_gym.errors import TPMError
from tpm_gym.kinematics.geometry import PAPER, WIDE, Geometry
from tpm_gym.mechanism.machine import Machine, register_machine
from tpm_gym.mechanism.tpm import PAPER_TPM, TPM, WIDE_TPM
from tpm_gym.simulation.engine import register_engine

if TYPE_CHECKING:
    from tpm_gym.policy import Policy

    ENV_IDS: tuple[str, ...]

__all__ = [
    "ENV_IDS",
    "PAPER",
    "PAPER_TPM",
    "TPM",
    "WIDE",
    "WIDE_TPM",
    "Geometry",
    "Machine",
    "TPMEnv",
    "TPMError",
    "TPMVectorEnv",
    "__version__",
    "load_policy",
    "register_engine",
    "register_machine",
    "register_task",
]

__version__ = "0.2.0"


def load_policy(path: str | Path) -> Policy:
    """Load a policy with :func:`tpm_gym.policy.load_policy`."""
    from tpm_gym import policy

    return policy.load_policy(path)


def __getattr__(name: str) -> Any:
    """Return ``ENV_IDS``: all ids that are registered by now, in order."""
    if name == "ENV_IDS":
        return env_ids()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
