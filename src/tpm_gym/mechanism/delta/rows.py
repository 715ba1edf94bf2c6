"""Compiled loops over rows of the Delta's kinematics and dynamics.

They are those of :mod:`tpm_gym.mechanism.tpm.rows`, for another mechanism. A row of ``built``
(b, 21) holds l1 to l5 (m) and the constants of the dynamics. ``machine`` (7,) holds the sign of the
assembly mode, the signs of the working mode (3), and gravity (3) m/s^2.
"""

import math
from typing import Any

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray, IntArray
from tpm_gym.compiling import compilable, kept
from tpm_gym.kinematics import compiled as functions
from tpm_gym.kinematics.equations import Triple, arms, conditioning
from tpm_gym.mechanism.columns import BLOCK, fill, get, put, read, write
from tpm_gym.mechanism.delta import dynamics, equations
from tpm_gym.mechanism.delta.bodies import Inertia
from tpm_gym.mechanism.delta.equations import Pose
from tpm_gym.mechanism.delta.geometry import DeltaLengths
from tpm_gym.mechanism.inertia import swing_force

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
    equations.regular,
    equations.resolve,
    equations.velocity,
    dynamics.legs,
    dynamics.torques,
    dynamics.gather,
    dynamics.masses,
    dynamics._drift,
    dynamics._inertial,
    dynamics._along,
    dynamics._turn,
    dynamics._swinging,
)

_NONE = (0.0, 0.0, 0.0)
NS: Any = functions


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


def _pose(theta: Triple, g: DeltaLengths, machine: FloatArray) -> tuple[Pose, bool, bool]:
    """Assemble the machine; return whether it is real and regular, and in the working mode."""
    pose, real = equations.pose_at(theta, machine[0], g, NS)
    return pose, real & equations.regular(pose, g), real & _working(pose, machine)


def _working(pose: Pose, machine: FloatArray) -> bool:
    one, two, three = pose.serial
    out: bool = (one * machine[1] > 0.0) & (two * machine[2] > 0.0) & (three * machine[3] > 0.0)
    return out


def _place(columns: FloatArray, j: int, pose: Pose, real: bool) -> tuple[Triple, Triple, Triple]:
    """Set the first columns of a row to P and to the rows of J, and return these."""
    rows = equations.velocity(pose)
    put(columns, 0, j, pose.position, real)
    put(columns, 3, j, rows[0], real)
    put(columns, 6, j, rows[1], real)
    put(columns, 9, j, rows[2], real)
    return rows


compilable(_lengths, _inertia, _pose, _working, _place)


@kept
def inverse(
    position: FloatArray, built: FloatArray, machine: FloatArray, theta: FloatArray
) -> None:
    """Compute joint positions (m, 3) for P at ``position`` (m, 3)."""
    bends = machine[1], machine[2], machine[3]
    own, given, found = np.empty((5, BLOCK)), np.empty((3, BLOCK)), np.empty((3, BLOCK))
    each = len(position) // len(built)
    for start in range(0, len(position), BLOCK):
        count = min(BLOCK, len(position) - start)
        fill(built, start, count, each, own)
        read(position, start, count, given, 0)
        for j in range(count):
            angles, real, _ = equations.posture_at(get(given, 0, j), bends, _lengths(own, j), NS)
            put(found, 0, j, angles, real)
        write(found, 0, start, count, theta)


@kept
def forward(
    theta: FloatArray, built: FloatArray, machine: FloatArray, position: FloatArray
) -> None:
    """Compute P (m, 3) at joint positions (m, 3), in the modes of the machine."""
    own, given, found = np.empty((5, BLOCK)), np.empty((3, BLOCK)), np.empty((3, BLOCK))
    each = len(theta) // len(built)
    for start in range(0, len(theta), BLOCK):
        count = min(BLOCK, len(theta) - start)
        fill(built, start, count, each, own)
        read(theta, start, count, given, 0)
        for j in range(count):
            pose, _, working = _pose(get(given, 0, j), _lengths(own, j), machine)
            put(found, 0, j, pose.position, working)
        write(found, 0, start, count, position)


@kept
def evaluate(
    theta: FloatArray,
    built: FloatArray,
    machine: FloatArray,
    position: FloatArray,
    jacobian: FloatArray,
    conditionings: FloatArray,
    working: BoolArray,
) -> None:
    """Compute P (m, 3), J (m, 3, 3), 1/cond(J) (m,) and whether in the working mode (m,)."""
    own, given, found = np.empty((5, BLOCK)), np.empty((3, BLOCK)), np.empty((14, BLOCK))
    each = len(theta) // len(built)
    for start in range(0, len(theta), BLOCK):
        count = min(BLOCK, len(theta) - start)
        fill(built, start, count, each, own)
        read(theta, start, count, given, 0)
        for j in range(count):
            pose, real, found[13, j] = _pose(get(given, 0, j), _lengths(own, j), machine)
            rows = _place(found, j, pose, real)
            found[12, j] = conditioning(rows, NS) if real else math.nan
        write(found, 0, start, count, position)
        write(found, 3, start, count, jacobian)
        for j in range(count):
            conditionings[start + j], working[start + j] = found[12, j], found[13, j] > 0.0


@kept
def conditioning_at(
    position: FloatArray,
    limit: float,
    built: FloatArray,
    machine: FloatArray,
    conditionings: FloatArray,
) -> None:
    """Compute 1/cond(J) (m,) for P at ``position`` (m, 3); 0 where the machine's modes end."""
    bends = machine[1], machine[2], machine[3]
    own, given = np.empty((5, BLOCK)), np.empty((3, BLOCK))
    each = len(position) // len(built)
    for start in range(0, len(position), BLOCK):
        count = min(BLOCK, len(position) - start)
        fill(built, start, count, each, own)
        read(position, start, count, given, 0)
        for j in range(count):
            g, point = _lengths(own, j), get(given, 0, j)
            angles, reached, _ = equations.posture_at(point, bends, g, NS)
            pose, real, _ = _pose(angles, g, machine)
            x, y, z = pose.position
            near = (abs(x - point[0]) < limit) & (abs(y - point[1]) < limit)
            known = reached & real & near & (abs(z - point[2]) < limit)
            conditionings[start + j] = conditioning(equations.velocity(pose), NS) if known else 0.0


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
    fall = machine[4], machine[5], machine[6]
    own, given, found = np.empty((21, BLOCK)), np.zeros((12, BLOCK)), np.empty((3, BLOCK))
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
            pose, real, _ = _pose(get(given, 0, j), _lengths(own, j), machine)
            rates, changes = get(given, 3, j), get(given, 6, j)
            one, two, three = dynamics.torques(pose, rates, changes, fall, _inertia(own, j))
            a, b, c = dynamics.gather(pose, get(given, 9, j))
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
    fall = machine[4], machine[5], machine[6]
    own, given, found = np.empty((21, BLOCK)), np.empty((6, BLOCK)), np.empty((25, BLOCK))
    each = len(theta) // len(built)
    for start in range(0, len(theta), BLOCK):
        count = min(BLOCK, len(theta) - start)
        fill(built, start, count, each, own)
        read(theta, start, count, given, 0)
        read(theta_dot, start, count, given, 3)
        for j in range(count):
            inertia = _inertia(own, j)
            pose, real, found[24, j] = _pose(get(given, 0, j), _lengths(own, j), machine)
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
    own, given = np.empty((5, BLOCK)), np.empty((6, BLOCK))
    each = len(theta) // len(built)
    for start in range(0, len(theta), BLOCK):
        count = min(BLOCK, len(theta) - start)
        fill(built, start, count, each, own)
        read(theta, start, count, given, 0)
        read(position, start, count, given, 3)
        for j in range(count):
            g, point = _lengths(own, j), get(given, 3, j)
            pose, real = equations.pose_at(get(given, 0, j), machine[0], g, NS)
            x, y, z = pose.position
            off2 = (x - point[0]) ** 2 + (y - point[1]) ** 2 + (z - point[2]) ** 2
            cos, sin = arms(get(given, 0, j), g, NS)
            there = equations.pose_of(cos, sin, point, g)
            kept_ = real & (there.parallel * machine[0] > 0.0) & (off2 <= limit * limit)
            left[start + j] = (0 if _working(pose, machine) else 2) if kept_ else 1


@kept
def same_side(
    position: FloatArray, built: FloatArray, machine: FloatArray, side: BoolArray
) -> None:
    """Find whether P at ``position`` (m, 3) is not beyond a parallel singularity, (m,).

    Points out of reach are beyond a serial singularity instead.
    """
    bends = machine[1], machine[2], machine[3]
    own, given = np.empty((5, BLOCK)), np.empty((3, BLOCK))
    each = len(position) // len(built)
    for start in range(0, len(position), BLOCK):
        count = min(BLOCK, len(position) - start)
        fill(built, start, count, each, own)
        read(position, start, count, given, 0)
        for j in range(count):
            g, point = _lengths(own, j), get(given, 0, j)
            angles, real, _ = equations.posture_at(point, bends, g, NS)
            cos, sin = arms(angles, g, NS)
            pose = equations.pose_of(cos, sin, point, g)
            side[start + j] = (not real) | (pose.parallel * machine[0] > 0.0)
