"""The translational parallel mechanism as a machine: the paper's, one of practical depth, yours."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.errors import ConfigurationError, UnreachableError
from tpm_gym.kinematics import jacobian, workspace
from tpm_gym.kinematics.equations import assemble, conditioning_at, evaluate, posture
from tpm_gym.kinematics.geometry import PAPER, WIDE, Geometry
from tpm_gym.kinematics.modes import DEFAULT_ASSEMBLY, ELBOWS_OUT, AssemblyMode, WorkingMode
from tpm_gym.kinematics.position import forward_all
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism import tree
from tpm_gym.mechanism.bodies import Mechanism
from tpm_gym.mechanism.dynamics import Dynamics, torques
from tpm_gym.mechanism.machine import Machine, Mode, Reading, register_machine
from tpm_gym.mechanism.mount import Mount
from tpm_gym.mechanism.tpm_batch import TPMBatch

__all__ = ["ASSEMBLY_LIMIT", "PAPER_TPM", "TPM", "WIDE_TPM"]

ASSEMBLY_LIMIT = 0.010
"""Platform against forward kinematics: farther apart, the mechanism is assembled otherwise, m."""


@dataclass(frozen=True, kw_only=True)
class TPM(Machine):
    """The mechanism of the paper, with any lengths.

    ``dataclasses.replace(PAPER_TPM, name=..., geometry=...)`` is one with lengths of yours. Where
    they differ much, ``mount``, ``region``, ``goal_region``, ``home`` and ``step_limit`` have to
    follow them, and so has ``table``.

    Attributes:
        geometry: Link lengths.
        working_mode: How its arms are bent.
        assembly_mode: How link 3' and platform are assembled.
    """

    geometry: Geometry
    working_mode: WorkingMode = ELBOWS_OUT
    assembly_mode: AssemblyMode = DEFAULT_ASSEMBLY

    def __post_init__(self) -> None:
        """See :class:`Machine`."""
        if not isinstance(self.geometry, Geometry):
            raise ConfigurationError("geometry", self.geometry, "a tpm_gym.Geometry")
        super().__post_init__()

    def inverse(self, point: Vector) -> Vector:
        """See :class:`Machine`."""
        return posture(point, self.working_mode, self.geometry)

    def evaluate(self, theta: Vector) -> Reading:
        """See :class:`Machine`."""
        (x, y, z, *_), rows, conditioning = evaluate(theta, self.assembly_mode, self.geometry)
        return Reading((x, y, z), rows, conditioning)

    def forward(self, theta: Vector) -> Vector:
        """See :class:`Machine`."""
        there = assemble(theta, self.assembly_mode, self.geometry)
        if there.cos_beta * self.working_mode.cos_beta <= 0:
            hint = "choose joint angles on the machine's side of y = l7"
            raise UnreachableError(theta, "working mode (cos(beta))", 0.0, hint)
        return there[:3]

    def mode_left(self, theta: Vector, position: Vector) -> Mode | None:
        """See :class:`Machine`."""
        try:
            there = assemble(theta, self.assembly_mode, self.geometry)
        except UnreachableError:
            return "assembly"
        mirrored = position[1] * self.assembly_mode.sin_beta <= 0
        if mirrored or not math.dist(there[:3], position) <= ASSEMBLY_LIMIT:
            return "assembly"
        return "working" if there.cos_beta * self.working_mode.cos_beta <= 0 else None

    def is_safe(self, point: Vector) -> bool:
        """See :class:`Machine`."""
        modes = self.working_mode, self.assembly_mode
        return conditioning_at(point, *modes, self.geometry) >= self.safe_conditioning

    def conditioning_at(self, points: ArrayLike) -> FloatArray:
        """See :class:`Machine`."""
        return workspace.conditioning_at(
            points, self.working_mode, self.assembly_mode, self.geometry
        )

    def conditioning(self, theta: ArrayLike) -> FloatArray:
        """See :class:`Machine`."""
        angles = np.asarray(theta, dtype=np.float64)
        assembled = forward_all(angles, self.geometry).valid[..., self.assembly_mode.index]
        result = np.zeros(angles.shape[:-1])
        result[assembled] = jacobian.conditioning(
            angles[assembled], self.assembly_mode, self.geometry
        )
        return result

    @cached_property
    def mechanism(self) -> Mechanism:
        """See :class:`Machine`."""
        return tree.build(self.geometry)

    def joint_positions(self, theta: Vector) -> dict[str, float]:
        """See :class:`Machine`."""
        return tree.joint_angles(theta, self.assembly_mode, self.geometry)

    @cached_property
    def dynamics(self) -> Dynamics:
        """Torques, mass matrix and so on, as designed and with nothing in the cup."""
        return Dynamics(
            geometry=self.geometry, branch=self.assembly_mode, free_fall=self.mount.free_fall
        )

    def torque(self, theta: Vector, theta_dot: Vector, theta_ddot: Vector) -> Vector:
        """See :class:`Machine`."""
        dynamics = self.dynamics
        pose = dynamics.pose(theta)
        return torques(pose, theta_dot, theta_ddot, dynamics.free_fall, dynamics.inertia)

    def batch(self, count: int) -> TPMBatch:
        """See :class:`Machine`."""
        return TPMBatch(self, count)

    @property
    def lengths(self) -> tuple[float, ...]:
        """l1 to l7, m."""
        return tuple(vars(self.geometry).values())

    def with_lengths(self, lengths: tuple[float, ...]) -> TPM:
        """The machine with these l1 to l7, m."""
        return replace(self, geometry=Geometry(*lengths))


PAPER_TPM = TPM(
    name="paper",
    geometry=PAPER,
    # The cup touches the table at z = 0.93 m of the paper frame, well inside the reach.
    mount=Mount(height=0.97),
    # The slab 0 < y < l7, less a margin to the parallel singularity y = 0 and to the edge y = l7.
    # Nearer to y = 0 the motors' torque no longer suffices to hold y when a random policy reverses
    # x or z at full speed: the platform is then thrown through the singularity. Farther from the
    # base the cup would be pushed back farther than its stroke by a puck that lies askew.
    region=Region(low=(-0.24, 0.012, 0.66), high=(0.12, 0.046, 0.903)),
    goal_region=Region(low=(-0.20, 0.016, 0.70), high=(0.10, 0.042, 0.90)),
    home=(-0.04, 0.028, 0.80),
    step_limit=(0.030, 0.005, 0.030),
    joint_limit=0.08,
    # There, a joint error of 1 mrad moves the platform by 3 mm at most; as y goes to zero, the one
    # grows without bound and the other falls with y. A sixth of the region is below.
    safe_conditioning=0.08,
)
"""The paper's case study, upside down over a table."""

WIDE_TPM = TPM(
    name="wide",
    geometry=WIDE,
    mount=Mount(height=0.95),
    # The largest box of WIDE whose conditioning is at least 0.1 (analysis.aspects), less a margin,
    # and on towards y = 0, where the penalty begins.
    region=Region(low=(0.12, 0.10, 0.58), high=(0.48, 0.50, 0.883)),
    goal_region=Region(low=(0.14, 0.12, 0.62), high=(0.46, 0.48, 0.88)),
    home=(0.30, 0.36, 0.75),
    table=(0.65, 0.65),
)
"""The paper's lengths but for a link 7 of 0.6 m, for a workspace of practical depth in y."""

register_machine("paper", PAPER_TPM)
register_machine("wide", WIDE_TPM)
