"""Many translational parallel mechanisms at a time; see :mod:`tpm_gym.mechanism.batch`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray, IntArray
from tpm_gym.kinematics import equations
from tpm_gym.kinematics.equations import Triple
from tpm_gym.kinematics.geometry import Lengths
from tpm_gym.kinematics.namespaces import NUMPY, Numbers
from tpm_gym.mechanism import dynamics
from tpm_gym.mechanism.batch import Motion, Readings
from tpm_gym.mechanism.inertia import Inertia, Swing, inertia_of

if TYPE_CHECKING:
    from tpm_gym.mechanism.tpm import TPM

_NONE = (0.0, 0.0, 0.0)


class TPMBatch:
    """See :class:`tpm_gym.mechanism.batch.Batch`.

    Args:
        machine: The nominal one.
        count: How many.
    """

    def __init__(self, machine: TPM, count: int) -> None:
        """Build all of them as designed."""
        self._machine, self._count = machine, count
        nominal = machine.dynamics.inertia
        # Numbers while all are as designed: it saves a third of the time.
        self._geometry: Lengths = machine.geometry
        self._inertia = nominal
        self._lengths: FloatArray | None = None
        self._constants: FloatArray | None = None

    def build(
        self,
        rows: IntArray,
        lengths: Sequence[tuple[float, ...]],
        link_masses: Sequence[tuple[float, ...]],
    ) -> None:
        """See the protocol."""
        machine, count = self._machine, self._count
        if self._lengths is None and not any(lengths) and not any(link_masses):
            return
        if self._lengths is None:
            self._lengths = np.repeat(np.array([machine.lengths]).T, count, axis=1)
            self._constants = np.repeat(_flat(machine.dynamics.inertia)[:, None], count, axis=1)
        assert self._constants is not None
        for row, own, masses in zip(rows.tolist(), lengths, link_masses, strict=True):
            built = machine.with_lengths(own) if own else machine
            self._lengths[:, row] = built.lengths
            self._constants[:, row] = _flat(
                inertia_of(built.mechanism, built.geometry, masses)
                if masses
                else built.dynamics.inertia
            )
        self._unpack()

    def _unpack(self) -> None:
        assert self._lengths is not None
        assert self._constants is not None
        self._geometry = Lengths(*self._lengths)
        self._inertia = _inertia(self._constants)

    def take(self, rows: IntArray) -> TPMBatch:
        """See the protocol."""
        if self._lengths is None or self._constants is None:
            return self
        part = TPMBatch(self._machine, len(rows))
        part._lengths, part._constants = self._lengths[:, rows], self._constants[:, rows]
        part._unpack()
        return part

    def inverse(self, point: FloatArray) -> FloatArray:
        """See the protocol."""
        x, y, z = point
        signs = self._machine.working_mode.signs
        with np.errstate(all="ignore"):
            theta, real, _, _ = equations.posture_at((x, y, z), signs, self._geometry, NUMPY)
            return _where(real, theta)

    def forward(self, theta: FloatArray) -> FloatArray:
        """See the protocol."""
        g, branch = self._geometry, self._machine.assembly_mode
        one, two, three = theta
        with np.errstate(all="ignore"):
            cos, sin = equations.arms((one, two, three), g, NUMPY)
            found, real, _ = equations.assembly_at(
                cos, sin, branch.planar, branch.sin_beta, g, NUMPY
            )
            kept = real & (found.cos_beta * self._machine.working_mode.cos_beta > 0)
            return _where(kept, found[:3])

    def evaluate(self, theta: FloatArray) -> Readings:
        """See the protocol."""
        machine = self._machine
        with np.errstate(all="ignore"):
            pose, real = self._pose(theta)
            found = pose.found
            rows = equations.velocity(pose.rods, pose.factors)
            conditioning = equations.conditioning(rows, NUMPY)
            position = _where(real, found[:3])
        working = found.cos_beta * machine.working_mode.cos_beta > 0
        return Readings(position, _matrix(rows, theta.shape), conditioning, working)

    def torque(
        self,
        theta: FloatArray,
        theta_dot: FloatArray,
        theta_ddot: FloatArray,
        push: FloatArray | None = None,
    ) -> FloatArray:
        """See the protocol."""
        with np.errstate(all="ignore"):
            pose, real = self._pose(theta)
            motion = tuple(theta_dot), tuple(theta_ddot)
            fall = self._machine.mount.free_fall
            found = dynamics.torques(pose, *motion, fall, self._inertia)
            if push is not None:
                carried = dynamics.gather(pose, (0.0, 0.0), tuple(push))
                found = tuple(one - other for one, other in zip(found, carried, strict=True))
            return _where(real, found)

    def motion(self, theta: FloatArray, theta_dot: FloatArray) -> Motion:
        """See the protocol."""
        machine, inertia = self._machine, self._inertia
        with np.errstate(all="ignore"):
            pose, real = self._pose(theta)
            found = pose.found
            fall = machine.mount.free_fall
            bias = dynamics.torques(pose, tuple(theta_dot), _NONE, fall, inertia)
            rows = equations.velocity(pose.rods, pose.factors)
            return Motion(
                _where(real, found[:3]),
                _matrix(rows, theta.shape),
                found.cos_beta * machine.working_mode.cos_beta > 0,
                np.array(dynamics.masses(pose, rows, inertia)),
                np.array(bias),
            )

    def assembled_at(self, point: FloatArray) -> BoolArray:
        """See the protocol."""
        side: BoolArray = point[1] * self._machine.assembly_mode.sin_beta > 0
        return side

    def _pose(self, theta: FloatArray) -> tuple[dynamics.Pose, Numbers]:
        one, two, three = theta
        branch = self._machine.assembly_mode
        return dynamics.pose_at((one, two, three), branch, self._geometry, NUMPY)


def _where(real: BoolArray, columns: Sequence[FloatArray]) -> FloatArray:
    """Columns (..., n) as one array, NaN where they are not real."""
    array = np.array(columns)  # np.stack costs three times as much
    return array if real.all() else np.where(real, array, np.nan)


def _matrix(rows: tuple[Triple, Triple, Triple], shape: tuple[int, ...]) -> FloatArray:
    """Rows of numbers, and of columns (..., n), as one array (3, 3, ..., n)."""
    matrix = np.empty((3, *shape))
    for row, columns in zip(rows, matrix, strict=True):
        for value, column in zip(row, columns, strict=True):
            column[:] = value
    return matrix


def _flat(inertia: Inertia) -> FloatArray:
    """All constants, (16,)."""
    motors, weights, couples, link3, link7, platform, swing1, swing3 = inertia
    return np.array(
        [*motors, *weights, *couples, link3, link7, platform, *swing1, *swing3], dtype=np.float64
    )


def _inertia(table: FloatArray) -> Inertia:
    """From constants (16, n)."""
    a, b, c, d, e, f, g, h, i, link3, link7, platform, *swings = table
    one, two, three, four = swings
    legs = (a, b, c), (d, e, f), (g, h, i)
    return Inertia(*legs, link3, link7, platform, Swing(one, two), Swing(three, four))
