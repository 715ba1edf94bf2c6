"""Gymnasium environments of an asymmetric 3-translational parallel mechanism.

Importing this package registers the ids in :data:`ENV_IDS`; it imports neither pybullet nor torch.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tpm_gym.envs.registration import ENV_IDS, register
from tpm_gym.errors import TPMError
from tpm_gym.kinematics.geometry import PAPER, WIDE, Geometry

if TYPE_CHECKING:
    from tpm_gym.policy import Policy

__all__ = ["ENV_IDS", "PAPER", "WIDE", "Geometry", "TPMError", "__version__", "load_policy"]

__version__ = "0.1.0"


def load_policy(path: str | Path) -> Policy:
    """The same as :func:`tpm_gym.policy.load_policy`, which imports PyTorch."""
    from tpm_gym import policy

    return policy.load_policy(path)


register()
