"""Functions that contact compiles; see :mod:`tpm_gym.compiling`."""

from __future__ import annotations

from typing import Final

from tpm_gym.arrays import rotate
from tpm_gym.compiling import compilable, compiled, kept
from tpm_gym.mechanism.cup import sealed
from tpm_gym.simulation.vacuum import hold_after, holds, pressure_after

__all__ = ["SOURCES", "compiled", "kept"]

compilable(rotate, sealed, pressure_after, holds, hold_after)

SOURCES: Final = ""
"""Value of the last argument of kept functions, which no longer need one."""
