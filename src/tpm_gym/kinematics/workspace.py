"""Regions; and the reachability, assembly modes and conditioning of points.

All points are in the paper's frame, in metres. Each function considers one working mode.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import BoolArray, FloatArray, IntArray, Vector, numbers, vector
from tpm_gym.arrays import points as _points
from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.kinematics.jacobian import conditioning_at as conditioning_at
from tpm_gym.kinematics.jacobian import factors_at
from tpm_gym.kinematics.modes import ELBOWS_OUT, WorkingMode, require_mode
from tpm_gym.kinematics.namespaces import namespace_of
from tpm_gym.kinematics.position import inverse_all


@dataclass(frozen=True)
class Region:
    """An axis-aligned box in the paper's frame.

    Attributes:
        low: Smallest x, y, z, m.
        high: Largest x, y, z, m.

    Raises:
        ConfigurationError: If ``low`` or ``high`` is not three finite numbers, or ``low`` exceeds
            ``high``.
    """

    low: Vector
    high: Vector

    def __post_init__(self) -> None:
        """Reject empty boxes; convert ``low`` and ``high`` to tuples."""
        for name in ("low", "high"):
            object.__setattr__(self, name, vector(name, getattr(self, name), ConfigurationError))
        if not all(low <= high for low, high in zip(self.low, self.high, strict=True)):
            raise ConfigurationError("low", self.low, f"at most high = {self.high} on every axis")

    def contains(self, points: ArrayLike) -> BoolArray:
        """Return whether points (..., 3) are inside, as (...,)."""
        array = _points("points", numbers("points", points))
        inside: BoolArray = np.all((array >= self.low) & (array <= self.high), axis=-1)
        return inside

    def project(self, points: ArrayLike) -> FloatArray:
        """Return the nearest points of the box to points (..., 3)."""
        array = _points("points", numbers("points", points))
        nearest: FloatArray = np.minimum(np.maximum(array, self.low), self.high)
        return nearest

    def corners(self) -> Iterator[Vector]:
        """Yield the eight corners, m."""
        return product(*zip(self.low, self.high, strict=True))  # type: ignore[return-value]


def reachable(
    position: ArrayLike, branch: WorkingMode = ELBOWS_OUT, geometry: Geometry = PAPER
) -> BoolArray:
    """Return whether points (..., 3) m have a posture on ``branch``, as (...,)."""
    require_mode(branch, WorkingMode)
    return inverse_all(position, geometry).valid[..., branch.index]


def assembly_of(
    position: ArrayLike, branch: WorkingMode = ELBOWS_OUT, geometry: Geometry = PAPER
) -> IntArray:
    """Return the index in ASSEMBLY_MODES of the assembly mode at points (..., 3) on ``branch``.

    Returns:
        (...,) index, or -1 where the point is not reachable on ``branch``.
    """
    sin_beta, _, planar, *_ = factors_at(position, branch, geometry)
    slots = 2 * (planar > 0) + 1 * (sin_beta > 0)
    found: IntArray = namespace_of(planar).where(planar == planar, slots, -1)
    return found
