"""Postures of the mechanism on any solution branch, from closed-form kinematics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.analysis.singularity import FACTORS, nearest_singularity
from tpm_gym.arrays import FloatArray, vector
from tpm_gym.errors import InputError
from tpm_gym.kinematics import (
    ASSEMBLY_MODES,
    ROTATED_MODES,
    WORKING_MODES,
    AssemblyMode,
    RotatedMode,
    RotatedPostures,
    WorkingMode,
    forward,
    forward_rotated,
    inverse,
    inverse_rotated,
    jacobian,
    rotated,
)
from tpm_gym.kinematics.namespaces import NUMPY
from tpm_gym.kinematics.workspace import assembly_of
from tpm_gym.mechanism import Delta
from tpm_gym.mechanism.bodies import Place
from tpm_gym.mechanism.delta import bodies as delta_bodies
from tpm_gym.mechanism.delta import equations, geometry
from tpm_gym.mechanism.delta import kinematics as delta
from tpm_gym.mechanism.tpm import TPM, bodies

__all__ = ["OPERATIONS", "Margin", "Operation", "Posture", "at_joints", "at_point"]

Operation: TypeAlias = Literal["translating", "rotated"]
OPERATIONS: Final[tuple[Operation, ...]] = ("translating", "rotated")


@dataclass(frozen=True)
class Margin:
    """Nearest singular position of point P.

    Attributes:
        distance: Distance from P, m.
        point: The singular position (3,) m, machine's frame.
        factor: Name of the factor that is zero there.
    """

    distance: float
    point: FloatArray
    factor: str


@dataclass(frozen=True)
class Posture:
    """The mechanism with closed loops; machine's frame.

    Attributes:
        machine: The machine.
        theta: (3,) rad, joint positions of the motors.
        position: (3,) m, point P.
        tilt: Turn of link 3' and the platform about y, rad; 0 in translating operation.
        working: Working mode, the signs of the serial factors: a WorkingMode; of a Delta, a tuple.
        assembly: Assembly mode, an AssemblyMode; a RotatedMode in rotated operation; of a Delta,
            the sign of det A.
        joints: Positions of all joints by name, rad or m.
        conditioning: 1/cond(J) of the motion of P, in [0, 1]; 0 at a singularity.
    """

    machine: TPM | Delta
    theta: FloatArray
    position: FloatArray
    tilt: float
    working: Any
    assembly: Any
    joints: Mapping[str, float]
    conditioning: float

    @property
    def operation(self) -> Operation:
        """Operation mode."""
        return "rotated" if isinstance(self.assembly, RotatedMode) else "translating"

    @cached_property
    def places(self) -> dict[str, Place]:
        """Positions and orientations of all links in the base's frame, by name."""
        return self.machine.mechanism.places(self.joints)

    @property
    def gap(self) -> float:
        """Largest distance between the two points of a loop closure, m."""
        ends = [
            self.places[closure.link_a].point(closure.point_a)
            - self.places[closure.link_b].point(closure.point_b)
            for closure in self.machine.mechanism.closures
        ]
        return float(np.linalg.norm(ends, axis=-1).max())

    @property
    def stop_margins(self) -> FloatArray:
        """Distance of each motor to its nearest stop, (3,) rad; negative beyond the stop."""
        low, high = self.machine.stops
        margins: FloatArray = np.minimum(self.theta - low, high - self.theta)
        return margins

    def singularity_margin(self) -> Margin | None:
        """Find the nearest singular position of P; None in rotated operation, and of a Delta.

        The search takes 5 to 10 ms, unlike everything else here.
        """
        if not (isinstance(self.machine, TPM) and isinstance(self.assembly, AssemblyMode)):
            return None
        found = nearest_singularity(
            self.position, self.working, self.assembly, self.machine.geometry
        )
        if not found.valid:
            return None
        return Margin(float(found.distance), found.point, FACTORS[int(found.factor)])


def at_point(
    machine: TPM | Delta, position: ArrayLike, operation: Operation, working: Any, tilt: float = 0.0
) -> Posture:
    """Solve the posture with P at ``position`` (3,) m, on a working mode.

    Args:
        machine: The machine.
        position: Point P, machine's frame.
        operation: Operation mode.
        working: Working mode.
        tilt: Of several rotated postures, the one with the tilt nearest to this is taken, rad.

    Raises:
        InputError: If position is no three finite numbers, or no such rotated posture exists.
        UnreachableError: If a leg does not reach.
    """
    place = np.array(vector("position", position))
    if isinstance(machine, Delta):
        theta = delta.inverse_all(place, machine.geometry)[geometry.WORKING_MODES.index(working)]
        if np.isnan(theta).any():
            raise machine.unreachable(vector("position", place))
        both = delta.forward_all(theta, machine.geometry)
        side = int(np.linalg.norm(both - place, axis=-1).argmin())
        return _of_delta(machine, theta, geometry.ASSEMBLY_MODES[side])
    lengths = machine.geometry
    if operation == "translating":
        theta = inverse(place, working, lengths)
        assembly = ASSEMBLY_MODES[int(assembly_of(place, working, lengths))]
        return _straight(machine, theta, place, working, assembly)
    found = inverse_rotated(place, lengths)
    serial = rotated.factors(found).serial
    ours = found.valid & ((serial > 0) == (np.array(working.signs) > 0)).all(axis=-1)
    if not ours.any():
        valid = "where link 3' can be turned in this working mode; "
        others = int(found.valid.sum())
        valid += f"other working modes have {others} such postures here" if others else "none has"
        raise InputError("position", tuple(place.round(4).tolist()), valid)
    one = _slot(found, int(np.where(ours, abs(found.tilt - tilt), np.inf).argmin()))
    every = forward_rotated(one.theta, lengths)
    apart = abs(every.tilt - one.tilt) + abs(every.beta - one.beta)
    index = int(np.where(every.valid, apart, np.inf).argmin())
    return _turned(machine, one, working, ROTATED_MODES[index])


def at_joints(machine: TPM | Delta, theta: ArrayLike, assembly: Any) -> Posture:
    """Solve the posture with the motors at ``theta`` (3,) rad, on an assembly mode.

    Raises:
        InputError: If theta is no three finite numbers, or a rotated mode does not exist there.
        UnreachableError: If the assembly mode does not exist there.
    """
    angles = np.array(vector("theta", theta))
    if isinstance(machine, Delta):
        return _of_delta(machine, angles, assembly)
    lengths = machine.geometry
    if isinstance(assembly, RotatedMode):
        found = forward_rotated(angles, lengths)
        if not found.valid[assembly.index]:
            valid = f"where this rotated assembly exists; {int(found.valid.sum())} others do"
            raise InputError("theta", tuple(angles.round(4).tolist()), valid)
        one = _slot(found, assembly.index)
        return _turned(machine, one, _working(rotated.factors(one).serial), assembly)
    place = forward(angles, assembly, lengths)
    working = _working(jacobian.factors(angles, assembly, lengths).serial)
    return _straight(machine, angles, place, working, assembly)


def _of_delta(machine: Delta, theta: FloatArray, side: float) -> Posture:
    """Return the posture of a Delta in an assembly mode."""
    angles = vector("theta", theta)
    with np.errstate(all="ignore"):
        at, real = equations.pose_at(tuple(map(np.float64, angles)), side, machine.geometry, NUMPY)
    if not real:
        raise delta.no_assembly(angles, side, machine.geometry)
    one, two, three = (1.0 if leg > 0 else -1.0 for leg in at.serial)
    working = one, two, three
    place, joints = (
        np.array(at.position),
        delta_bodies.joint_positions(at, angles, machine.geometry.l4),
    )
    quality = float(np.nan_to_num(delta.conditioning_at(place, working, machine.geometry)))
    return Posture(machine, theta, place, 0.0, working, side, joints, quality)


def _straight(
    machine: TPM,
    theta: FloatArray,
    place: FloatArray,
    working: WorkingMode,
    assembly: AssemblyMode,
) -> Posture:
    """Return the posture with link 3' parallel to x."""
    joints = bodies.joint_angles(theta, assembly, machine.geometry)
    quality = float(jacobian.conditioning(theta, assembly, machine.geometry))
    return Posture(machine, theta, place, 0.0, working, assembly, joints, quality)


def _turned(machine: TPM, one: RotatedPostures, working: WorkingMode, mode: RotatedMode) -> Posture:
    """Return a posture with link 3' turned."""
    joints = {name: float(angle) for name, angle in bodies.rotated_joint_arrays(one).items()}
    sizes = np.linalg.svd(np.nan_to_num(rotated.velocity(one)[:3]), compute_uv=False)
    quality = float(sizes[2] / sizes[0]) if sizes[0] > 0 else 0.0
    place, tilt = one.position, float(one.tilt)
    return Posture(machine, one.theta, place, tilt, working, mode, joints, quality)


def _slot(found: RotatedPostures, slot: int) -> RotatedPostures:
    """Return the posture in one slot."""
    theta, link3, tilt, beta = found.theta[slot], found.link3[slot], found.tilt[slot], found.beta
    return RotatedPostures(theta, link3, tilt, beta[slot], found.geometry)


def _working(serial: FloatArray) -> WorkingMode:
    """Return the working mode with the signs of the serial factors (4,)."""
    return WORKING_MODES[int(((serial > 0) * [8, 4, 2, 1]).sum())]
