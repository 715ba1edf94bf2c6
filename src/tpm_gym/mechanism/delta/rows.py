"""Compiled loops over many Deltas (:mod:`tpm_gym.mechanism.loops`).

The loops have two arguments that depend on the mechanism. ``built`` has a row of 21 numbers for
each machine: l1 to l5 (m), and the 16 constants of the dynamics. ``machine`` has seven numbers: the
sign of the assembly mode, three signs of the working mode, and three components of gravity (m/s^2).
"""

from tpm_gym.arrays import FloatArray
from tpm_gym.compiling import compilable
from tpm_gym.kinematics.equations import Triple
from tpm_gym.mechanism.delta import dynamics, equations
from tpm_gym.mechanism.delta.bodies import Inertia
from tpm_gym.mechanism.delta.equations import Pose
from tpm_gym.mechanism.delta.geometry import DeltaLengths
from tpm_gym.mechanism.inertia import swing_force
from tpm_gym.mechanism.loops import NS, Equations, get, loops

compilable(
    swing_force,
    equations.dot,
    equations.cross,
    equations.inwards,
    equations.outwards,
    equations.assembly_at,
    equations.posture_at,
    equations.pose_at,
    equations.pose_of,
    equations.rod,
    equations.resolve,
    dynamics.legs,
    dynamics._drift,
    dynamics._inertial,
    dynamics._along,
    dynamics._turn,
    dynamics._swinging,
)

Modes = tuple[float, float, float, float]


def _modes(machine: FloatArray) -> Modes:
    return machine[0], machine[1], machine[2], machine[3]


def _lengths(own: FloatArray, j: int) -> DeltaLengths:
    return DeltaLengths(own[0, j], own[1, j], own[2, j], own[3, j], own[4, j])


def _inertia(own: FloatArray, j: int) -> Inertia:
    return Inertia(
        get(own, 5, j),
        get(own, 8, j),
        get(own, 11, j),
        own[14, j],
        get(own, 15, j),
        get(own, 18, j),
    )


def _posture(point: Triple, modes: Modes, g: DeltaLengths) -> tuple[Triple, bool]:
    found: tuple[Triple, bool] = equations.posture_at(point, modes[1:], g, NS)
    return found


def _pose(theta: Triple, modes: Modes, g: DeltaLengths) -> tuple[Pose, bool, bool]:
    pose, real = equations.pose_at(theta, modes[0], g, NS)
    one, two, three = pose.serial
    working = (one * modes[1] > 0.0) & (two * modes[2] > 0.0) & (three * modes[3] > 0.0)
    return pose, real, real & working


def _position(pose: Pose) -> Triple:
    return pose.position


def _same_side(pose: Pose, point: Triple, modes: Modes, g: DeltaLengths) -> bool:
    there = equations.pose_of(pose.cos, pose.sin, point, g)
    side: bool = there.parallel * modes[0] > 0.0
    return side


_KINEMATICS = _modes, _lengths, _inertia, _posture, _pose, _position, equations.regular
_DYNAMICS = dynamics.torques, dynamics.gather, dynamics.masses
LOOPS = loops("delta", 5, 21, Equations(*_KINEMATICS, equations.velocity, _same_side, *_DYNAMICS))
