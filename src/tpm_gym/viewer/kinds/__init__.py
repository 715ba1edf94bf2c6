"""Kinds of machines: modes, postures and layers in the viewer, in one file for each mechanism."""

from __future__ import annotations

from typing import Any, Final

from tpm_gym.mechanism import Delta, Machine
from tpm_gym.mechanism.machine import find_machine
from tpm_gym.mechanism.tpm import TPM
from tpm_gym.viewer.kinds.delta import DeltaKind
from tpm_gym.viewer.kinds.kind import Kind, Posture
from tpm_gym.viewer.kinds.tpm import TPMKind

__all__ = ["KINDS", "Kind", "Posture", "find_kind"]

KINDS: Final[dict[Any, type[Kind]]] = {Machine: Kind, TPM: TPMKind, Delta: DeltaKind}
"""Kinds by class of machine. A machine has the kind of its nearest base class in this table."""


def find_kind(machine: Any) -> Kind:
    """Return the kind (modes, postures and layers) of a machine, given as an object or by name.

    Raises:
        ConfigurationError: If no machine has this name, or the value is no machine.
    """
    found = find_machine(machine)
    return next(KINDS[base] for base in type(found).__mro__ if base in KINDS)(found)
