"""The robot as data: bodies and joints, machines, mount and cup, and files for other tools."""

from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism.delta.machine import DELTA, Delta
from tpm_gym.mechanism.machine import Machine, find_machine, register_machine
from tpm_gym.mechanism.mount import Mount
from tpm_gym.mechanism.tpm import PAPER_TPM, TPM, WIDE_TPM

__all__ = [
    "DELTA",
    "PAPER_TPM",
    "TPM",
    "WIDE_TPM",
    "Delta",
    "Machine",
    "Mount",
    "Region",
    "find_machine",
    "register_machine",
]
