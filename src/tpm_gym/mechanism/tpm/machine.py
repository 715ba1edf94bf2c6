"""The translational parallel mechanism as a machine, with the paper's lengths or others."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.arrays import BoolArray, FloatArray, Vector, numbers, points
from tpm_gym.errors import ConfigurationError, SingularityError, UnreachableError
from tpm_gym.kinematics import jacobian, workspace
from tpm_gym.kinematics.equations import no_posture
from tpm_gym.kinematics.geometry import PAPER, WIDE, Geometry
from tpm_gym.kinematics.modes import DEFAULT_ASSEMBLY, ELBOWS_OUT, AssemblyMode, WorkingMode
from tpm_gym.kinematics.position import inverse
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism.bodies import Mechanism
from tpm_gym.mechanism.compiled import CompiledMachine
from tpm_gym.mechanism.machine import register_machine
from tpm_gym.mechanism.mount import Mount
from tpm_gym.mechanism.tpm import bodies
from tpm_gym.mechanism.tpm.dynamics import Dynamics
from tpm_gym.mechanism.tpm.inertia import inertia_of


@dataclass(frozen=True, kw_only=True)
class TPM(CompiledMachine):
    """Mechanism of the paper, with any lengths.

    For other lengths, use ``dataclasses.replace(PAPER_TPM, name=..., geometry=...)``. If the
    lengths differ much, change ``mount``, ``region``, ``goal_region``, ``home``, ``step_limit`` and
    ``table`` too.

    Attributes:
        geometry: Link lengths.
        working_mode: Branch of the inverse kinematics: how the arms are bent.
        assembly_mode: Branch of the forward kinematics: how link 3' and platform are assembled.
    """

    geometry: Geometry
    working_mode: WorkingMode = ELBOWS_OUT
    assembly_mode: AssemblyMode = DEFAULT_ASSEMBLY

    _module: ClassVar = "tpm_gym.mechanism.tpm.rows"
    _inertia_of: ClassVar = staticmethod(inertia_of)

    def __post_init__(self) -> None:
        """See :class:`Machine`."""
        if not isinstance(self.geometry, Geometry):
            raise ConfigurationError("geometry", self.geometry, "a tpm_gym.Geometry")
        for name, kind in (("working_mode", WorkingMode), ("assembly_mode", AssemblyMode)):
            if not isinstance(getattr(self, name), kind):
                valid = f"a tpm_gym.kinematics.{kind.__name__}"
                raise ConfigurationError(name, getattr(self, name), valid)
        super().__post_init__()

    def same_side(self, position: ArrayLike) -> BoolArray:
        """See :class:`Machine`."""
        array = points("position", numbers("position", position))
        return array[..., 1] * self.assembly_mode.sin_beta > 0

    def unreachable(self, position: Vector) -> UnreachableError:
        """See :class:`Machine`."""
        return no_posture(position, self.working_mode, self.geometry)

    def unassembled(self, theta: Vector) -> UnreachableError | SingularityError:
        """See :class:`Machine`."""
        try:
            jacobian.velocity(theta, self.assembly_mode, self.geometry)
        except (UnreachableError, SingularityError) as error:
            return error
        hint = "choose joint angles on the machine's side of y = l7"
        return UnreachableError(theta, "working mode (cos(beta))", 0.0, hint)

    def _postures(self, points: FloatArray) -> tuple[FloatArray, NDArray[np.int8]]:
        # By numpy: machines are made when the package is imported, which must not import Numba.
        theta = inverse(points, self.working_mode, self.geometry)
        slots = workspace.assembly_of(points, self.working_mode, self.geometry)
        return theta, (slots != self.assembly_mode.index).astype(np.int8)

    @cached_property
    def _constants(self) -> FloatArray:
        """Two signs of the assembly mode, four of the working mode, then gravity (3,) m/s^2."""
        signs = *self.assembly_mode.signs, *self.working_mode.signs
        return np.array([*signs, *self.mount.free_fall])

    # -- bodies -----------------------------------------------------------------------------

    @cached_property
    def mechanism(self) -> Mechanism:
        """See :class:`Machine`."""
        return bodies.build(self.geometry, self.payload)

    def joint_positions(self, theta: Vector) -> dict[str, float]:
        """See :class:`Machine`."""
        return bodies.joint_angles(theta, self.assembly_mode, self.geometry)

    @cached_property
    def dynamics(self) -> Dynamics:
        """Torques, mass matrix and energy of the nominal machine with an empty cup."""
        return Dynamics(
            geometry=self.geometry,
            branch=self.assembly_mode,
            free_fall=self.mount.free_fall,
            payload=self.payload,
        )


PAPER_TPM = TPM(
    name="paper",
    geometry=PAPER,
    # The cup touches the table at z = 0.93 m of the machine's frame, well inside the reach.
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
    # At a conditioning of 0.08, a joint error of 1 mrad moves the platform by 3 mm at most. As y
    # goes to 0, the conditioning goes to 0 and this motion of the platform grows without bound. In
    # a sixth of the region, the conditioning is below 0.08.
    safe_conditioning=0.08,
)
"""Machine with the lengths of the paper's case study, upside down over a table."""

WIDE_TPM = TPM(
    name="wide",
    geometry=WIDE,
    mount=Mount(height=0.95),
    # The largest box of WIDE whose conditioning is at least 0.1 (analysis.aspects), less a margin.
    # It is extended towards y = 0, to points whose conditioning is below ``safe_conditioning``, so
    # that rewards have a singularity penalty there.
    region=Region(low=(0.12, 0.10, 0.58), high=(0.48, 0.50, 0.883)),
    goal_region=Region(low=(0.14, 0.12, 0.62), high=(0.46, 0.48, 0.88)),
    home=(0.30, 0.36, 0.75),
    table=(0.65, 0.65),
)
"""Machine with the paper's lengths but a link 7 of 0.6 m, for a workspace deeper in y."""

register_machine("paper", PAPER_TPM)
register_machine("wide", WIDE_TPM)
