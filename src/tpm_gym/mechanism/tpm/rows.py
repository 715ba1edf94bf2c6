"""Compiled loops over many TPMs (:mod:`tpm_gym.mechanism.loops`).

The loops have two arguments that depend on the mechanism. ``built`` has a row of 23 numbers for
each machine: l1 to l7 (m), and the 16 constants of the dynamics. ``machine`` has nine numbers: two
signs of the assembly mode, four signs of the working mode, and three components of gravity (m/s^2).
"""

from tpm_gym.arrays import FloatArray
from tpm_gym.compiling import compilable
from tpm_gym.kinematics import equations
from tpm_gym.kinematics.equations import Triple
from tpm_gym.kinematics.geometry import Lengths
from tpm_gym.mechanism.inertia import Swing, swing_force
from tpm_gym.mechanism.loops import NS, Equations, get, loops
from tpm_gym.mechanism.tpm import dynamics
from tpm_gym.mechanism.tpm.dynamics import Pose
from tpm_gym.mechanism.tpm.inertia import Inertia

compilable(
    dynamics.pose_at,
    dynamics.velocities,
    dynamics.accelerations,
    dynamics.gather,
    dynamics._resolve,
    swing_force,
)

Modes = tuple[float, float, float, float, float, float]


def _modes(machine: FloatArray) -> Modes:
    return machine[0], machine[1], machine[2], machine[3], machine[4], machine[5]


def _lengths(own: FloatArray, j: int) -> Lengths:
    return Lengths(own[0, j], own[1, j], own[2, j], own[3, j], own[4, j], own[5, j], own[6, j])


def _inertia(own: FloatArray, j: int) -> Inertia:
    return Inertia(
        get(own, 7, j),
        get(own, 10, j),
        get(own, 13, j),
        own[16, j],
        own[17, j],
        own[18, j],
        Swing(own[19, j], own[20, j]),
        Swing(own[21, j], own[22, j]),
    )


def _posture(point: Triple, modes: Modes, g: Lengths) -> tuple[Triple, bool]:
    angles, real, _, _ = equations.posture_at(point, modes[2:], g, NS)
    return angles, real


def _pose(theta: Triple, modes: Modes, g: Lengths) -> tuple[Pose, bool, bool]:
    pose, real = dynamics.pose_at(theta, modes[:2], g, NS)
    return pose, real, real & (pose.found.cos_beta * modes[2] > 0.0)


def _position(pose: Pose) -> Triple:
    return pose.found.x, pose.found.y, pose.found.z


def _regular(pose: Pose, g: Lengths) -> bool:
    regular: bool = equations.regular(pose.factors, g)
    return regular


def _same_side(_at: Pose, point: Triple, modes: Modes, _g: Lengths) -> bool:
    side: bool = point[1] * modes[1] > 0.0
    return side


def _gather(pose: Pose, force: Triple) -> Triple:
    return dynamics.gather(pose, (0.0, 0.0), force)


_KINEMATICS = _modes, _lengths, _inertia, _posture, _pose, _position, _regular
_DYNAMICS = dynamics.torques, _gather, dynamics.masses
LOOPS = loops("tpm", 7, 23, Equations(*_KINEMATICS, dynamics.velocity, _same_side, *_DYNAMICS))
