"""Closed-form kinematics of the mechanism; see :mod:`tpm_gym.kinematics.position`.

The second operation mode is in :mod:`tpm_gym.kinematics.rotated`.
"""

from tpm_gym.kinematics.modes import (
    ASSEMBLY_MODES,
    DEFAULT_ASSEMBLY,
    ELBOWS_OUT,
    ROTATED_MODES,
    WORKING_MODES,
    AssemblyMode,
    ForwardSolutions,
    InverseSolutions,
    RotatedMode,
    WorkingMode,
)
from tpm_gym.kinematics.position import forward, forward_all, inverse, inverse_all
from tpm_gym.kinematics.rotated import RotatedPostures, forward_rotated, inverse_rotated

__all__ = [
    "ASSEMBLY_MODES",
    "DEFAULT_ASSEMBLY",
    "ELBOWS_OUT",
    "ROTATED_MODES",
    "WORKING_MODES",
    "AssemblyMode",
    "ForwardSolutions",
    "InverseSolutions",
    "RotatedMode",
    "RotatedPostures",
    "WorkingMode",
    "forward",
    "forward_all",
    "forward_rotated",
    "inverse",
    "inverse_all",
    "inverse_rotated",
]
