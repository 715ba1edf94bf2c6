"""The Delta as a machine, with the lengths of ABB's IRB 360 or with other lengths."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import FloatArray, Vector, explained, is_number, vector
from tpm_gym.errors import ConfigurationError, SingularityError, UnreachableError
from tpm_gym.kinematics.equations import Triple
from tpm_gym.kinematics.namespaces import NUMPY
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism.bodies import Mechanism
from tpm_gym.mechanism.compiled import CompiledMachine
from tpm_gym.mechanism.delta import bodies, equations, kinematics
from tpm_gym.mechanism.delta.dynamics import DeltaDynamics
from tpm_gym.mechanism.delta.geometry import (
    ASSEMBLY_MODES,
    ELBOWS_OUT,
    IRB_360,
    WORKING_MODES,
    DeltaGeometry,
)
from tpm_gym.mechanism.machine import SAME_PLACE, register_machine
from tpm_gym.mechanism.mount import Mount


@dataclass(frozen=True, kw_only=True)
class Delta(CompiledMachine):
    """Delta with any lengths.

    Attributes:
        geometry: Lengths.
        working_mode: For each leg, 1 if the elbow is out, and -1 if it is in.
        assembly_mode: 1 if P is below the elbows, and -1 if P is above the elbows.
    """

    geometry: DeltaGeometry
    working_mode: Triple = ELBOWS_OUT
    assembly_mode: float = 1.0

    _module: ClassVar = "tpm_gym.mechanism.delta.rows"
    _inertia_of: ClassVar = staticmethod(bodies.inertia_of)

    def __post_init__(self) -> None:
        """See :class:`Machine`."""
        if not isinstance(self.geometry, DeltaGeometry):
            raise ConfigurationError("geometry", self.geometry, "a DeltaGeometry")
        signs = vector("working_mode", self.working_mode, ConfigurationError)
        if signs not in WORKING_MODES:
            raise ConfigurationError("working_mode", self.working_mode, "three signs, 1 or -1")
        object.__setattr__(self, "working_mode", signs)
        if not is_number(self.assembly_mode) or self.assembly_mode not in ASSEMBLY_MODES:
            raise ConfigurationError("assembly_mode", self.assembly_mode, "1 or -1")
        super().__post_init__()

    def unreachable(self, position: Vector) -> UnreachableError:
        """See :class:`Machine`."""
        return kinematics.no_posture(position, self.geometry)

    def unassembled(self, theta: Vector) -> UnreachableError | SingularityError:
        """See :class:`Machine`."""
        return kinematics.no_assembly(theta, self.assembly_mode, self.geometry)

    def _postures(self, points: FloatArray) -> tuple[FloatArray, NDArray[np.int8]]:
        # By numpy: machines are made when the package is imported, which must not import Numba.
        slot = WORKING_MODES.index(self.working_mode)
        theta = kinematics.inverse_all(points, self.geometry)[..., slot, :]
        lost = np.isnan(theta[..., 0])
        if lost.any():
            raise explained(self.unreachable, points, lost)
        side = ASSEMBLY_MODES.index(self.assembly_mode)
        there = kinematics.forward_all(theta, self.geometry)[..., side, :]
        left: NDArray[np.int8] = np.abs(there - points).max(axis=-1) > SAME_PLACE
        return theta, left.astype(np.int8)

    @cached_property
    def _constants(self) -> FloatArray:
        """Signs of the modes, and gravity, (7,); see :mod:`tpm_gym.mechanism.delta.rows`."""
        return np.array([self.assembly_mode, *self.working_mode, *self.mount.free_fall])

    @cached_property
    def mechanism(self) -> Mechanism:
        """See :class:`Machine`."""
        return bodies.build(self.geometry, self.payload)

    def joint_positions(self, theta: Vector) -> dict[str, float]:
        """See :class:`Machine`."""
        angles = vector("theta", theta)
        pose, real = equations.pose_at(
            tuple(map(np.float64, angles)), self.assembly_mode, self.geometry, NUMPY
        )
        if not real:
            raise self.unassembled(angles)
        return bodies.joint_positions(pose, angles, self.geometry.l4)

    @cached_property
    def dynamics(self) -> DeltaDynamics:
        """Torques, mass matrix and energy of the nominal machine with an empty cup."""
        return DeltaDynamics(
            geometry=self.geometry,
            side=self.assembly_mode,
            free_fall=self.mount.free_fall,
            payload=self.payload,
        )


DELTA = Delta(
    name="delta",
    geometry=IRB_360,
    mount=Mount(height=1.23),
    # As large as the region of WIDE_TPM, in the middle of a workspace that is 1.6 m wide: with the
    # step limit, an expert crosses the region twice in an episode. The conditioning is at least
    # 0.36.
    region=Region(low=(-0.20, -0.20, 0.86), high=(0.20, 0.20, 1.163)),
    goal_region=Region(low=(-0.17, -0.17, 0.90), high=(0.17, 0.17, 1.16)),
    home=(0.0, 0.0, 1.03),
)
"""Machine with the lengths of ABB's IRB 360. Like the TPM, it hangs upside down over a table."""

register_machine("delta", DELTA)
