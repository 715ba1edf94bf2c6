"""Closed-form kinematics of the mechanism; see :mod:`tpm_gym.kinematics.position`."""

from tpm_gym.kinematics.modes import (
    ASSEMBLY_MODES,
    DEFAULT_ASSEMBLY,
    ELBOWS_OUT,
    WORKING_MODES,
    AssemblyMode,
    ForwardSolutions,
    InverseSolutions,
    PassiveAngles,
    WorkingMode,
)
from tpm_gym.kinematics.position import (
    forward,
    forward_all,
    inverse,
    inverse_all,
    passive_angles,
)

__all__ = [
    "ASSEMBLY_MODES",
    "DEFAULT_ASSEMBLY",
    "ELBOWS_OUT",
    "WORKING_MODES",
    "AssemblyMode",
    "ForwardSolutions",
    "InverseSolutions",
    "PassiveAngles",
    "WorkingMode",
    "forward",
    "forward_all",
    "inverse",
    "inverse_all",
    "passive_angles",
]
