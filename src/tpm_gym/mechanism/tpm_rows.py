"""Compiled loops over rows of the TPM's kinematics and dynamics.

Row i of the m rows of an input is of the machine ``built[i // (m // b)]``, of b machines. A row of
``built`` (b, 23) holds l1 to l7 (m) and the constants of the dynamics (mechanism.inertia).
``machine`` (9,) holds the signs of the assembly mode (2) and of the working mode (4), and gravity
(3) m/s^2. Results are written to the last arguments, NaN where there is none. Each row is computed
by itself, so that it has the same bits alone and among thousands.
"""

import math
from typing import Any

from tpm_gym.arrays import BoolArray, FloatArray, IntArray
from tpm_gym.compiling import compilable, compiled, kept
from tpm_gym.kinematics import compiled as functions
from tpm_gym.kinematics import equations
from tpm_gym.kinematics.equations import Triple
from tpm_gym.kinematics.geometry import Lengths
from tpm_gym.mechanism import dynamics
from tpm_gym.mechanism.dynamics import Pose
from tpm_gym.mechanism.inertia import Inertia, Swing

compilable(
    dynamics.pose_at,
    dynamics.torques,
    dynamics.carried,
    dynamics.masses,
    dynamics.velocities,
    dynamics.accelerations,
    dynamics.gather,
    dynamics._resolve,
    dynamics._swing,
)

_NONE = (0.0, 0.0, 0.0)
NS: Any = functions


@compiled
def _lengths(p: FloatArray) -> Lengths:
    return Lengths(p[0], p[1], p[2], p[3], p[4], p[5], p[6])


@compiled
def _inertia(p: FloatArray) -> Inertia:
    return Inertia(
        (p[7], p[8], p[9]),
        (p[10], p[11], p[12]),
        (p[13], p[14], p[15]),
        p[16],
        p[17],
        p[18],
        Swing(p[19], p[20]),
        Swing(p[21], p[22]),
    )


@compiled
def _triple(row: FloatArray) -> Triple:
    return row[0], row[1], row[2]


@compiled
def _write(row: FloatArray, values: Triple, real: bool) -> None:
    row[0] = values[0] if real else math.nan
    row[1] = values[1] if real else math.nan
    row[2] = values[2] if real else math.nan


@compiled
def _pose(theta: FloatArray, p: FloatArray, machine: FloatArray) -> tuple[Pose, bool, bool]:
    """Assemble the machine; whether that is real and regular, and in the working mode."""
    g = _lengths(p)
    pose, real = dynamics.pose_at(_triple(theta), (machine[0], machine[1]), g, NS)
    working = real and pose.found.cos_beta * machine[2] > 0.0
    return pose, real and equations.regular(pose.factors, g), working


@kept
def inverse(
    position: FloatArray, built: FloatArray, machine: FloatArray, theta: FloatArray
) -> None:
    """Compute joint positions (m, 3) for P at ``position`` (m, 3)."""
    signs = machine[2], machine[3], machine[4], machine[5]
    each = len(position) // len(built)
    for k in range(len(built)):
        g = _lengths(built[k])
        for i in range(k * each, (k + 1) * each):
            found, real, _, _ = equations.posture_at(_triple(position[i]), signs, g, NS)
            _write(theta[i], found, real)


@kept
def forward(
    theta: FloatArray, built: FloatArray, machine: FloatArray, position: FloatArray
) -> None:
    """Compute P (m, 3) at joint positions (m, 3), in the modes of the machine."""
    each = len(theta) // len(built)
    for k in range(len(built)):
        g = _lengths(built[k])
        for i in range(k * each, (k + 1) * each):
            cos, sin = equations.arms(_triple(theta[i]), g, NS)
            found, real, _ = equations.assembly_at(cos, sin, machine[0], machine[1], g, NS)
            working = found.cos_beta * machine[2] > 0.0
            _write(position[i], (found.x, found.y, found.z), real and working)


@kept
def evaluate(
    theta: FloatArray,
    built: FloatArray,
    machine: FloatArray,
    position: FloatArray,
    jacobian: FloatArray,
    conditioning: FloatArray,
    working: BoolArray,
) -> None:
    """Compute P (m, 3), J (m, 3, 3), 1/cond(J) (m,) and whether in the working mode (m,)."""
    each = len(theta) // len(built)
    for k in range(len(built)):
        for i in range(k * each, (k + 1) * each):
            pose, real, working[i] = _pose(theta[i], built[k], machine)
            rows = equations.velocity(pose.rods, pose.factors)
            _write(position[i], (pose.found.x, pose.found.y, pose.found.z), real)
            for axis in range(3):
                _write(jacobian[i, axis], rows[axis], real)
            conditioning[i] = equations.conditioning(rows, NS) if real else math.nan


@kept
def torque(
    theta: FloatArray,
    theta_dot: FloatArray,
    theta_ddot: FloatArray,
    force: FloatArray,
    built: FloatArray,
    machine: FloatArray,
    torques: FloatArray,
) -> None:
    """Compute the motors' torques (m, 3) N m for a motion against forces on P (m, 3) N."""
    fall = machine[6], machine[7], machine[8]
    each = len(theta) // len(built)
    for k in range(len(built)):
        inertia = _inertia(built[k])
        for i in range(k * each, (k + 1) * each):
            pose, real, _ = _pose(theta[i], built[k], machine)
            rates, changes = _triple(theta_dot[i]), _triple(theta_ddot[i])
            one, two, three = dynamics.torques(pose, rates, changes, fall, inertia)
            if len(force):
                a, b, c = dynamics.gather(pose, (0.0, 0.0), _triple(force[i]))
                one, two, three = one - a, two - b, three - c
            _write(torques[i], (one, two, three), real)


@kept
def motion(
    theta: FloatArray,
    theta_dot: FloatArray,
    built: FloatArray,
    machine: FloatArray,
    position: FloatArray,
    jacobian: FloatArray,
    working: BoolArray,
    mass: FloatArray,
    bias: FloatArray,
) -> None:
    """Compute P (m, 3), J (m, 3, 3), the mode (m,), masses (m, 3, 3) and bias (m, 3)."""
    fall = machine[6], machine[7], machine[8]
    each = len(theta) // len(built)
    for k in range(len(built)):
        inertia = _inertia(built[k])
        for i in range(k * each, (k + 1) * each):
            pose, real, working[i] = _pose(theta[i], built[k], machine)
            rows = equations.velocity(pose.rods, pose.factors)
            _write(position[i], (pose.found.x, pose.found.y, pose.found.z), real)
            for axis in range(3):
                _write(jacobian[i, axis], rows[axis], real)
            a, b, c, d, e, f = dynamics.masses(pose, rows, inertia)
            _write(mass[i, 0], (a, b, c), real)
            _write(mass[i, 1], (b, d, e), real)
            _write(mass[i, 2], (c, e, f), real)
            load = dynamics.torques(pose, _triple(theta_dot[i]), _NONE, fall, inertia)
            _write(bias[i], load, real)


@kept
def conditioning_at(
    position: FloatArray, built: FloatArray, machine: FloatArray, conditioning: FloatArray
) -> None:
    """Compute 1/cond(J) (m,) at P (m, 3); 0 where P cannot be in the machine's modes."""
    signs = machine[2], machine[3], machine[4], machine[5]
    g = _lengths(built[0])
    for i in range(len(position)):
        point = _triple(position[i])
        theta, real, link7, _ = equations.posture_at(point, signs, g, NS)
        cos, sin = equations.arms(theta, g, NS)
        found = equations.Assembly(
            point[0], point[1], point[2], link7[0], link7[1], link7[2], link7[3]
        )
        bars = equations.rods(cos, sin, found, g)
        values = equations.factors(cos, sin, found, bars, g)
        same = values.planar * machine[0] > 0.0 and values.sin_beta * machine[1] > 0.0
        least = equations.conditioning(equations.velocity(bars, values), NS)
        conditioning[i] = least if real and same and least <= 1.0 else 0.0


@kept
def mode_left(
    theta: FloatArray,
    position: FloatArray,
    limit: float,
    built: FloatArray,
    machine: FloatArray,
    left: IntArray,
) -> None:
    """Find which mode (m,) int8 is left with P at ``position`` (m, 3): 1 assembly, 2 working."""
    each = len(theta) // len(built)
    for k in range(len(built)):
        g = _lengths(built[k])
        for i in range(k * each, (k + 1) * each):
            cos, sin = equations.arms(_triple(theta[i]), g, NS)
            found, real, _ = equations.assembly_at(cos, sin, machine[0], machine[1], g, NS)
            x, y, z = _triple(position[i])
            off = math.sqrt((found.x - x) ** 2 + (found.y - y) ** 2 + (found.z - z) ** 2)
            if not (real and y * machine[1] > 0.0 and off <= limit):
                left[i] = 1
            else:
                left[i] = 2 if found.cos_beta * machine[2] <= 0.0 else 0
