"""Gymnasium environments of an asymmetric 3-translational parallel mechanism.

Importing this package registers the ids in :data:`ENV_IDS`; it imports neither pybullet nor torch.
"""

from tpm_gym.errors import TPMError
from tpm_gym.geometry import PAPER, WIDE, Geometry
from tpm_gym.registration import ENV_IDS, register

__all__ = ["ENV_IDS", "PAPER", "WIDE", "Geometry", "TPMError", "__version__"]

__version__ = "0.1.0"

register()
