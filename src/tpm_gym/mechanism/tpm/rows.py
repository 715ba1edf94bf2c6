"""Compiled loops over rows of the TPM's kinematics and dynamics.

Row i of the m rows of an input is of the machine ``built[i // (m // b)]``, of b machines. A row of
``built`` (b, 23) holds l1 to l7 (m) and the constants of the dynamics (tpm.inertia).
``machine`` (9,) holds the signs of the assembly mode (2) and of the working mode (4), and gravity
(3) m/s^2. Results are written to the last arguments, NaN where there is none. Each row is computed
by itself, so that it has the same bits alone and among thousands.

Rows are copied to columns of a block, over which the compiler computes several rows at a time.
"""

import math
from typing import Any

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray, IntArray
from tpm_gym.compiling import compilable, kept
from tpm_gym.kinematics import compiled as functions
from tpm_gym.kinematics import equations
from tpm_gym.kinematics.equations import Triple
from tpm_gym.kinematics.geometry import Lengths
from tpm_gym.mechanism.columns import BLOCK, fill, get, put, read, write
from tpm_gym.mechanism.inertia import Swing, swing_force
from tpm_gym.mechanism.tpm import dynamics
from tpm_gym.mechanism.tpm.dynamics import Pose
from tpm_gym.mechanism.tpm.inertia import Inertia

compilable(
    dynamics.pose_at,
    dynamics.torques,
    dynamics.carried,
    dynamics.masses,
    dynamics.velocities,
    dynamics.accelerations,
    dynamics.gather,
    dynamics._resolve,
    swing_force,
)

_NONE = (0.0, 0.0, 0.0)
NS: Any = functions


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


def _pose(theta: Triple, g: Lengths, modes: Triple) -> tuple[Pose, bool, bool]:
    """Assemble the machine; return whether it is real and regular, and in the working mode."""
    pose, real = dynamics.pose_at(theta, (modes[0], modes[1]), g, NS)
    working = real & (pose.found.cos_beta * modes[2] > 0.0)
    return pose, real & equations.regular(pose.factors, g), working


def _place(columns: FloatArray, j: int, pose: Pose, real: bool) -> tuple[Triple, Triple, Triple]:
    """Set the first columns of a row to P and to the rows of J, and return these."""
    rows = equations.velocity(pose.rods, pose.factors)
    put(columns, 0, j, (pose.found.x, pose.found.y, pose.found.z), real)
    put(columns, 3, j, rows[0], real)
    put(columns, 6, j, rows[1], real)
    put(columns, 9, j, rows[2], real)
    return rows


compilable(_lengths, _inertia, _pose, _place)


@kept
def inverse(
    position: FloatArray, built: FloatArray, machine: FloatArray, theta: FloatArray
) -> None:
    """Compute joint positions (m, 3) for P at ``position`` (m, 3)."""
    signs = machine[2], machine[3], machine[4], machine[5]
    own, given, found = np.empty((7, BLOCK)), np.empty((3, BLOCK)), np.empty((3, BLOCK))
    each = len(position) // len(built)
    for start in range(0, len(position), BLOCK):
        count = min(BLOCK, len(position) - start)
        fill(built, start, count, each, own)
        read(position, start, count, given, 0)
        for j in range(count):
            g = _lengths(own, j)
            angles, real, _, _ = equations.posture_at(get(given, 0, j), signs, g, NS)
            put(found, 0, j, angles, real)
        write(found, 0, start, count, theta)


@kept
def forward(
    theta: FloatArray, built: FloatArray, machine: FloatArray, position: FloatArray
) -> None:
    """Compute P (m, 3) at joint positions (m, 3), in the modes of the machine."""
    planar, side, turned = machine[0], machine[1], machine[2]
    own, given, found = np.empty((7, BLOCK)), np.empty((3, BLOCK)), np.empty((3, BLOCK))
    each = len(theta) // len(built)
    for start in range(0, len(theta), BLOCK):
        count = min(BLOCK, len(theta) - start)
        fill(built, start, count, each, own)
        read(theta, start, count, given, 0)
        for j in range(count):
            g = _lengths(own, j)
            cos, sin = equations.arms(get(given, 0, j), g, NS)
            there, real, _ = equations.assembly_at(cos, sin, planar, side, g, NS)
            working = there.cos_beta * turned > 0.0
            put(found, 0, j, (there.x, there.y, there.z), real & working)
        write(found, 0, start, count, position)


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
    modes = machine[0], machine[1], machine[2]
    own, given, found = np.empty((7, BLOCK)), np.empty((3, BLOCK)), np.empty((14, BLOCK))
    each = len(theta) // len(built)
    for start in range(0, len(theta), BLOCK):
        count = min(BLOCK, len(theta) - start)
        fill(built, start, count, each, own)
        read(theta, start, count, given, 0)
        for j in range(count):
            g = _lengths(own, j)
            pose, real, found[13, j] = _pose(get(given, 0, j), g, modes)
            rows = _place(found, j, pose, real)
            found[12, j] = equations.conditioning(rows, NS) if real else math.nan
        write(found, 0, start, count, position)
        write(found, 3, start, count, jacobian)
        for j in range(count):
            conditioning[start + j], working[start + j] = found[12, j], found[13, j] > 0.0


@kept
def conditioning_at(
    position: FloatArray,
    limit: float,
    built: FloatArray,
    machine: FloatArray,
    conditioning: FloatArray,
) -> None:
    """Compute 1/cond(J) (m,) for P at ``position`` (m, 3); 0 where the machine's modes end."""
    signs = machine[2], machine[3], machine[4], machine[5]
    modes = machine[0], machine[1], machine[2]
    own, given = np.empty((7, BLOCK)), np.empty((3, BLOCK))
    each = len(position) // len(built)
    for start in range(0, len(position), BLOCK):
        count = min(BLOCK, len(position) - start)
        fill(built, start, count, each, own)
        read(position, start, count, given, 0)
        for j in range(count):
            g, (x, y, z) = _lengths(own, j), get(given, 0, j)
            angles, reached, _, _ = equations.posture_at((x, y, z), signs, g, NS)
            pose, real, _ = _pose(angles, g, modes)
            there = pose.found
            near = (abs(there.x - x) < limit) & (abs(there.y - y) < limit)
            known = reached & real & near & (abs(there.z - z) < limit)
            rows = equations.velocity(pose.rods, pose.factors)
            conditioning[start + j] = equations.conditioning(rows, NS) if known else 0.0


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
    modes, fall = (machine[0], machine[1], machine[2]), (machine[6], machine[7], machine[8])
    own, given, found = np.empty((23, BLOCK)), np.zeros((12, BLOCK)), np.empty((3, BLOCK))
    each = len(theta) // len(built)
    for start in range(0, len(theta), BLOCK):
        count = min(BLOCK, len(theta) - start)
        fill(built, start, count, each, own)
        read(theta, start, count, given, 0)
        read(theta_dot, start, count, given, 3)
        read(theta_ddot, start, count, given, 6)
        if len(force):
            read(force, start, count, given, 9)
        for j in range(count):
            g, inertia = _lengths(own, j), _inertia(own, j)
            pose, real, _ = _pose(get(given, 0, j), g, modes)
            rates, changes = get(given, 3, j), get(given, 6, j)
            one, two, three = dynamics.torques(pose, rates, changes, fall, inertia)
            a, b, c = dynamics.gather(pose, (0.0, 0.0), get(given, 9, j))
            put(found, 0, j, (one - a, two - b, three - c), real)
        write(found, 0, start, count, torques)


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
    modes, fall = (machine[0], machine[1], machine[2]), (machine[6], machine[7], machine[8])
    own, given, found = np.empty((23, BLOCK)), np.empty((6, BLOCK)), np.empty((25, BLOCK))
    each = len(theta) // len(built)
    for start in range(0, len(theta), BLOCK):
        count = min(BLOCK, len(theta) - start)
        fill(built, start, count, each, own)
        read(theta, start, count, given, 0)
        read(theta_dot, start, count, given, 3)
        for j in range(count):
            g, inertia = _lengths(own, j), _inertia(own, j)
            pose, real, found[24, j] = _pose(get(given, 0, j), g, modes)
            rows = _place(found, j, pose, real)
            a, b, c, d, e, f = dynamics.masses(pose, rows, inertia)
            put(found, 12, j, (a, b, c), real)
            put(found, 15, j, (b, d, e), real)
            put(found, 18, j, (c, e, f), real)
            load = dynamics.torques(pose, get(given, 3, j), _NONE, fall, inertia)
            put(found, 21, j, load, real)
        write(found, 0, start, count, position)
        write(found, 3, start, count, jacobian)
        write(found, 12, start, count, mass)
        write(found, 21, start, count, bias)
        for j in range(count):
            working[start + j] = found[24, j] > 0.0


@kept
def mode_left(
    theta: FloatArray,
    position: FloatArray,
    limit: float,
    built: FloatArray,
    machine: FloatArray,
    left: IntArray,
) -> None:
    """Find the mode (m,) that is left with P at ``position`` (m, 3): 1 assembly, 2 working."""
    planar, side, turned = machine[0], machine[1], machine[2]
    own, given = np.empty((7, BLOCK)), np.empty((6, BLOCK))
    each = len(theta) // len(built)
    for start in range(0, len(theta), BLOCK):
        count = min(BLOCK, len(theta) - start)
        fill(built, start, count, each, own)
        read(theta, start, count, given, 0)
        read(position, start, count, given, 3)
        for j in range(count):
            g = _lengths(own, j)
            cos, sin = equations.arms(get(given, 0, j), g, NS)
            there, real, _ = equations.assembly_at(cos, sin, planar, side, g, NS)
            x, y, z = get(given, 3, j)
            off2 = (there.x - x) ** 2 + (there.y - y) ** 2 + (there.z - z) ** 2
            kept = real & (y * side > 0.0) & (off2 <= limit * limit)
            left[start + j] = (2 if there.cos_beta * turned <= 0.0 else 0) if kept else 1
