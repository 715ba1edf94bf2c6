"""TPM that works on both sides of y = 0.

The plane y = 0 is a parallel singularity. Inverse kinematics and dynamics are even functions of y.
So a posture and its mirror image in this plane have equal joint positions, inertia and torques. The
two postures differ in the assembly mode, and so in the sign of y in the forward kinematics.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism.machine import Machine
from tpm_gym.mechanism.tpm.machine import TPM

_AT_PLANE: Final = 0.05
"""Distance from the plane y = 0, as a share of l7, below which the assembly mode is not checked.

Closer to the plane, forward kinematics may have no solution if the joint positions have an error of
1e-4 rad.
"""


@dataclass(frozen=True, kw_only=True)
class BothSides(TPM):
    """TPM that may change to the mirror image of its assembly mode.

    The region is symmetric about y = 0. Forward kinematics, Jacobian and ``home`` belong to
    ``assembly_mode``. Functions of a position use the assembly mode of the side of y = 0 on which
    the position lies.
    """

    mirror_axis: ClassVar[int] = 1

    def mode_left(
        self, theta: ArrayLike, position: ArrayLike, built: FloatArray | None = None
    ) -> NDArray[np.int8]:
        """See :class:`Machine`; the result is 0 next to the plane y = 0."""
        left = super().mode_left(theta, self._own_side(position), built)
        left[np.abs(np.asarray(position)[..., 1]) < _AT_PLANE * self.geometry.l7] = 0
        return left

    def same_side(self, position: ArrayLike) -> BoolArray:
        """See :class:`Machine`; the result is true for all points, on both sides of y = 0."""
        return np.ones(np.shape(position)[:-1], dtype=np.bool_)

    def conditioning_at(self, position: ArrayLike) -> FloatArray:
        """See :class:`Machine`."""
        return super().conditioning_at(self._own_side(position))

    def mirrored(self) -> BothSides:
        """Return the machine with home, goals and assembly mode on the other side of y = 0."""
        (a, b, c), low, high = self.home, self.goal_region.low, self.goal_region.high
        goals = Region((low[0], -high[1], low[2]), (high[0], -low[1], high[2]))
        mode = replace(self.assembly_mode, sin_beta=-self.assembly_mode.sin_beta)
        return replace(self, home=(a, -b, c), goal_region=goals, assembly_mode=mode)

    def _postures(self, points: FloatArray) -> tuple[FloatArray, NDArray[np.int8]]:
        return super()._postures(self._own_side(points))

    def _own_side(self, position: ArrayLike) -> FloatArray:
        """Return points (..., 3) m, or their mirror images, on the side of the assembly mode."""
        points = np.array(position, dtype=np.float64)
        points[..., 1] = np.abs(points[..., 1]) * self.assembly_mode.sin_beta
        return points


def both_sides(machine: Machine) -> BothSides:
    """Return a TPM that works on both sides of y = 0.

    The new region is the smallest box around the region of ``machine`` and its mirror image.

    Raises:
        ConfigurationError: If the machine is no TPM, or if a corner of the region, or a point next
            to y = 0, is beyond a singularity or a motor's stop.
        UnreachableError: If a corner of the region, or a point next to y = 0, cannot be reached.
    """
    if not isinstance(machine, TPM):
        valid = "'paper', 'wide' or another tpm_gym TPM: no singularity divides its region in two"
        raise ConfigurationError("machine", machine.name, valid)
    (x, *ends, z), (x2, *others, z2) = machine.region.low, machine.region.high
    far = max(abs(y) for y in (*ends, *others))
    values = {field.name: getattr(machine, field.name) for field in fields(machine)}
    made = BothSides(**{**values, "region": Region((x, -far, z), (x2, far, z2))})
    # The region has to be in the machine's modes next to the plane too.
    close = machine.assembly_mode.sin_beta * _AT_PLANE * machine.geometry.l7
    made._require_usable("region", [(a, close, b) for a in (x, x2) for b in (z, z2)])
    return made
