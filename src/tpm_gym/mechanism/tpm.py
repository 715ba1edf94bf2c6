"""The translational parallel mechanism as a machine, with the paper's lengths or others."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.arrays import BoolArray, FloatArray, Vector
from tpm_gym.errors import ConfigurationError, InputError, SingularityError, UnreachableError
from tpm_gym.kinematics import jacobian, workspace
from tpm_gym.kinematics.equations import no_posture
from tpm_gym.kinematics.geometry import PAPER, WIDE, Geometry
from tpm_gym.kinematics.modes import DEFAULT_ASSEMBLY, ELBOWS_OUT, AssemblyMode, WorkingMode
from tpm_gym.kinematics.position import inverse
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism import tree
from tpm_gym.mechanism.bodies import Mechanism
from tpm_gym.mechanism.dynamics import Dynamics
from tpm_gym.mechanism.inertia import flat, inertia_of
from tpm_gym.mechanism.machine import SAME_PLACE, Machine, Motion, Reading, register_machine
from tpm_gym.mechanism.mount import Mount

ASSEMBLY_LIMIT = 0.010
"""Largest distance between platform and forward kinematics in the same assembly mode, m."""


@dataclass(frozen=True, kw_only=True)
class TPM(Machine):
    """Mechanism of the paper, with any lengths.

    For other lengths, use ``dataclasses.replace(PAPER_TPM, name=..., geometry=...)``. If they
    differ much, change ``mount``, ``region``, ``goal_region``, ``home``, ``step_limit`` and
    ``table`` too.

    Attributes:
        geometry: Link lengths.
        working_mode: Branch of the inverse kinematics: how the arms are bent.
        assembly_mode: Branch of the forward kinematics: how link 3' and platform are assembled.
    """

    geometry: Geometry
    working_mode: WorkingMode = ELBOWS_OUT
    assembly_mode: AssemblyMode = DEFAULT_ASSEMBLY

    def __post_init__(self) -> None:
        """See :class:`Machine`."""
        if not isinstance(self.geometry, Geometry):
            raise ConfigurationError("geometry", self.geometry, "a tpm_gym.Geometry")
        super().__post_init__()

    # -- kinematics -------------------------------------------------------------------------

    def inverse(self, position: ArrayLike, built: FloatArray | None = None) -> FloatArray:
        """See :class:`Machine`."""
        points = _rows(position)
        theta = np.empty(points.shape)
        of = self._own if built is None else self._others(built, points)
        _loops().inverse(points.reshape(-1, 3), *of, theta.reshape(-1, 3))
        return theta

    def forward(self, theta: ArrayLike, built: FloatArray | None = None) -> FloatArray:
        """See :class:`Machine`."""
        angles = _rows(theta)
        position = np.empty(angles.shape)
        of = self._own if built is None else self._others(built, angles)
        _loops().forward(angles.reshape(-1, 3), *of, position.reshape(-1, 3))
        return position

    def evaluate(self, theta: ArrayLike, built: FloatArray | None = None) -> Reading:
        """See :class:`Machine`."""
        angles = _rows(theta)
        flat, empty = angles.reshape(-1, 3), np.empty
        of = self._own if built is None else self._others(built, angles)
        count = len(flat)
        position, jacobian = empty((count, 3)), empty((count, 3, 3))
        found = Reading(position, jacobian, empty(count), empty(count, np.bool_))
        _loops().evaluate(flat, *of, *found)
        return found if angles.ndim == 2 else Reading(*_shaped(found, angles))

    def conditioning_at(self, position: ArrayLike) -> FloatArray:
        """See :class:`Machine`."""
        points = _rows(position)
        found = np.empty(points.shape[:-1])
        _loops().conditioning_at(points.reshape(-1, 3), SAME_PLACE, *self._own, found.reshape(-1))
        return found

    def mode_left(
        self, theta: ArrayLike, position: ArrayLike, built: FloatArray | None = None
    ) -> NDArray[np.int8]:
        """See :class:`Machine`."""
        angles, points = _rows(theta), _rows(position)
        if points.shape != angles.shape:
            raise InputError("position", points.shape, f"of shape {angles.shape}, like theta")
        left = np.empty(angles.shape[:-1], np.int8)
        of = self._own if built is None else self._others(built, angles)
        _loops().mode_left(
            angles.reshape(-1, 3), points.reshape(-1, 3), ASSEMBLY_LIMIT, *of, left.reshape(-1)
        )
        return left

    def same_side(self, position: ArrayLike) -> BoolArray:
        """See :class:`Machine`."""
        side: BoolArray = np.asarray(position)[..., 1] * self.assembly_mode.sin_beta > 0
        return side

    def unreachable(self, position: Vector) -> UnreachableError:
        """See :class:`Machine`."""
        return no_posture(position, self.working_mode, self.geometry)

    def unassembled(self, theta: Vector) -> UnreachableError | SingularityError:
        """See :class:`Machine`."""
        try:
            found = jacobian.factors(theta, self.assembly_mode, self.geometry)
            jacobian.require_regular(found.parallel, self.geometry)
        except (UnreachableError, SingularityError) as error:
            return error
        hint = "choose joint angles on the machine's side of y = l7"
        return UnreachableError(theta, "working mode (cos(beta))", 0.0, hint)

    def _postures(self, points: FloatArray) -> tuple[FloatArray, NDArray[np.int8]]:
        # By numpy: machines are made when the package is imported, which must not import Numba.
        theta = inverse(points, self.working_mode, self.geometry)
        slots = workspace.assembly_of(points, self.working_mode, self.geometry)
        return theta, (slots != self.assembly_mode.index).astype(np.int8)

    def built(
        self, lengths: tuple[float, ...] = (), link_masses: tuple[float, ...] = ()
    ) -> FloatArray:
        """Return l1 to l7 (m) and the constants of the dynamics, (23,); see :class:`Machine`."""
        machine = self.with_lengths(lengths) if lengths else self
        geometry = machine.geometry
        inertia = inertia_of(machine.mechanism, geometry, link_masses)
        return np.array([*geometry.lengths, *flat(inertia)])

    @cached_property
    def _nominal(self) -> FloatArray:
        """Parameters of the nominal machine, (1, 23)."""
        return self.built()[None]

    @cached_property
    def _constants(self) -> FloatArray:
        """Signs of the modes, and gravity, (9,); see :mod:`tpm_gym.mechanism.tpm_rows`."""
        signs = *self.assembly_mode.signs, *self.working_mode.signs
        return np.array([*signs, *self.mount.free_fall])

    @cached_property
    def _own(self) -> tuple[FloatArray, FloatArray]:
        """The parameters of the nominal machine, and the constants."""
        return self._nominal, self._constants

    def _others(self, built: FloatArray, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the parameters of machines as built, and the constants that they share."""
        rows, count = inputs.size // 3, len(built)
        if not count or rows % count:
            valid = f"parameters of b machines, with b a divisor of {rows} rows"
            raise InputError("built", built.shape, valid)
        return _rows(built, self._nominal.shape[1], "built"), self._constants

    # -- bodies -----------------------------------------------------------------------------

    @cached_property
    def mechanism(self) -> Mechanism:
        """See :class:`Machine`."""
        return tree.build(self.geometry)

    def joint_positions(self, theta: Vector) -> dict[str, float]:
        """See :class:`Machine`."""
        return tree.joint_angles(theta, self.assembly_mode, self.geometry)

    @cached_property
    def dynamics(self) -> Dynamics:
        """Torques, mass matrix and energy of the nominal machine with an empty cup."""
        return Dynamics(
            geometry=self.geometry, branch=self.assembly_mode, free_fall=self.mount.free_fall
        )

    def torque(
        self,
        theta: ArrayLike,
        theta_dot: ArrayLike,
        theta_ddot: ArrayLike,
        force: ArrayLike | None = None,
        built: FloatArray | None = None,
    ) -> FloatArray:
        """See :class:`Machine`."""
        angles = _rows(theta)
        others = (theta_dot, theta_ddot, *(() if force is None else (force,)))
        inputs = [angles, *(_rows(np.broadcast_to(values, angles.shape)) for values in others)]
        if force is None:
            inputs.append(np.empty((0, 3)))
        torques = np.empty(angles.shape)
        of = self._own if built is None else self._others(built, angles)
        flat = (values.reshape(-1, 3) for values in inputs)
        _loops().torque(*flat, *of, torques.reshape(-1, 3))
        return torques

    def motion(
        self, theta: ArrayLike, theta_dot: ArrayLike, built: FloatArray | None = None
    ) -> Motion:
        """See :class:`Machine`."""
        angles = _rows(theta)
        rates = _rows(np.broadcast_to(theta_dot, angles.shape))
        flat, empty = angles.reshape(-1, 3), np.empty
        of = self._own if built is None else self._others(built, angles)
        count = len(flat)
        place = empty((count, 3)), empty((count, 3, 3)), empty(count, np.bool_)
        found = Motion(*place, empty((count, 3, 3)), empty((count, 3)))
        _loops().motion(flat, rates.reshape(-1, 3), *of, *found)
        return found if angles.ndim == 2 else Motion(*_shaped(found, angles))

    @property
    def lengths(self) -> tuple[float, ...]:
        """l1 to l7, m."""
        return self.geometry.lengths

    def with_lengths(self, lengths: tuple[float, ...]) -> TPM:
        """Return the machine with these l1 to l7, m."""
        return replace(self, geometry=Geometry(*lengths))


@cache
def _loops() -> ModuleType:
    """Import the compiled loops, and with them Numba."""
    from tpm_gym.mechanism import tpm_rows

    return tpm_rows


def _rows(values: ArrayLike, length: int = 3, name: str = "vectors") -> FloatArray:
    """Convert vectors (..., length) to the type of array for which the loops are compiled."""
    array = np.ascontiguousarray(values, np.float64)
    if array.shape[-1] != length:
        raise InputError(name, array.shape, f"an array of shape (..., {length}), by shape")
    return array if array.flags.writeable else array.copy()


def _shaped(arrays: Iterable[Any], like: FloatArray) -> Iterator[Any]:
    """Reshape arrays (m, ...) to the leading shape of an array (..., 3)."""
    return (array.reshape(like.shape[:-1] + array.shape[1:]) for array in arrays)


PAPER_TPM = TPM(
    name="paper",
    geometry=PAPER,
    # The cup touches the table at z = 0.93 m of the paper frame, well inside the reach.
    mount=Mount(height=0.97),
    # The slab 0 < y < l7, less a margin to the parallel singularity y = 0 and to the edge y = l7.
    # Nearer to y = 0, when a random policy reverses x or z at full speed, the motors' torque cannot
    # hold y, and the platform passes the singularity. Farther from the base, a tilted block would
    # push the cup back beyond its stroke.
    region=Region(low=(-0.24, 0.012, 0.66), high=(0.12, 0.046, 0.903)),
    goal_region=Region(low=(-0.20, 0.016, 0.70), high=(0.10, 0.042, 0.90)),
    home=(-0.04, 0.028, 0.80),
    step_limit=(0.030, 0.005, 0.030),
    joint_limit=0.08,
    # At 0.08, a joint error of 1 mrad moves the platform by 3 mm at most. Towards y = 0, that
    # motion grows without bound and the conditioning falls with y. A sixth of the region is below.
    safe_conditioning=0.08,
)
"""Machine with the lengths of the paper's case study, upside down over a table."""

WIDE_TPM = TPM(
    name="wide",
    geometry=WIDE,
    mount=Mount(height=0.95),
    # The largest box of WIDE whose conditioning is at least 0.1 (analysis.aspects), less a margin,
    # and extended towards y = 0, where the penalty begins.
    region=Region(low=(0.12, 0.10, 0.58), high=(0.48, 0.50, 0.883)),
    goal_region=Region(low=(0.14, 0.12, 0.62), high=(0.46, 0.48, 0.88)),
    home=(0.30, 0.36, 0.75),
    table=(0.65, 0.65),
)
"""Machine with the paper's lengths but a link 7 of 0.6 m, for a workspace deeper in y."""

register_machine("paper", PAPER_TPM)
register_machine("wide", WIDE_TPM)
