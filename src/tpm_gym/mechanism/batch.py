"""Many machines of one kind at a time: what a :class:`Machine` answers, for columns of arrays.

An array's first axis holds the components (x, y, z or the three motors), its last one the machines,
one column each; between them may be others, such as moments. Where there is no answer it is NaN.
Each column is computed by itself: it has the same bits alone as among thousands.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from tpm_gym.arrays import BoolArray, FloatArray, IntArray

__all__ = ["Batch", "Motion", "Readings"]


class Readings(NamedTuple):
    """What follows from joint positions.

    Attributes:
        position: Point P (3, ..., n) m; NaN where the machine cannot be assembled.
        jacobian: Rows of J (3, 3, ..., n) with v = J theta_dot, m/rad.
        conditioning: 1/cond(J), (..., n).
        working: (..., n) whether the machine is in its working mode.
    """

    position: FloatArray
    jacobian: FloatArray
    conditioning: FloatArray
    working: BoolArray


class Motion(NamedTuple):
    """Where machines are, and what moves them: torque = mass theta_ddot + bias.

    Attributes:
        position: Point P (3, ..., n) m; NaN where the machine cannot be assembled.
        jacobian: See :class:`Readings`.
        working: See there.
        mass: The inertia that the motors feel, kg m^2: its upper triangle by rows, (6, ..., n).
        bias: What weight and rates take, (3, ..., n) N m.
    """

    position: FloatArray
    jacobian: FloatArray
    working: BoolArray
    mass: FloatArray
    bias: FloatArray


class Batch(Protocol):
    """n machines of one kind, each as it was built. Machine's frame, SI units."""

    def build(
        self,
        rows: IntArray,
        lengths: Sequence[tuple[float, ...]],
        link_masses: Sequence[tuple[float, ...]],
    ) -> None:
        """Build some machines anew.

        Args:
            rows: Which.
            lengths: Their lengths, m, in the order of the machine's; empty for the nominal ones.
            link_masses: Factors of their links' mass and inertia; empty if all are one.
        """

    def take(self, rows: IntArray) -> Batch:
        """Some of the machines, as they are now."""

    def inverse(self, point: FloatArray) -> FloatArray:
        """Joint positions (3, ..., n) for points P (3, ..., n), on the machine's working mode."""

    def forward(self, theta: FloatArray) -> FloatArray:
        """Point P (3, ..., n) m at joint positions; NaN where not in the machine's modes."""

    def evaluate(self, theta: FloatArray) -> Readings:
        """What follows from joint positions (3, ..., n), on the machine's assembly mode."""

    def torque(
        self,
        theta: FloatArray,
        theta_dot: FloatArray,
        theta_ddot: FloatArray,
        push: FloatArray | None = None,
    ) -> FloatArray:
        """Torques (3, ..., n) N m of the motors for a motion against a force on P (3, ..., n) N."""

    def motion(self, theta: FloatArray, theta_dot: FloatArray) -> Motion:
        """What joint positions and rates (3, ..., n) do to what comes next."""

    def assembled_at(self, point: FloatArray) -> BoolArray:
        """Whether P at ``point`` (3, ..., n) m is of the machine's assembly mode, not beyond it."""
