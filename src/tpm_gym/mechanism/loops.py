"""Compiled loops over rows of a mechanism's kinematics and dynamics.

Row i of the m rows of an input is of the machine ``built[i // (m // b)]``, of b machines. A row of
``built`` (b, k) holds the lengths (m) and the constants of the dynamics. ``machine`` holds the
signs of the modes, and at its end gravity (3) m/s^2. Results are written to the last arguments, NaN
where there is none. Each row is computed by itself, so that it has the same bits alone and among
thousands.

Rows are copied to columns of a block, over which the compiler computes several rows at a time.
"""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray, IntArray
from tpm_gym.compiling import compilable, kept
from tpm_gym.kinematics import compiled as functions
from tpm_gym.kinematics.equations import Triple, conditioning

NS: Any = functions
"""Namespace of compiled functions."""

_BLOCK: Final = 64  # rows of a block; their columns stay in the cache
_NONE: Final = (0.0, 0.0, 0.0)


class Equations(NamedTuple):
    """Functions of one mechanism that the loops call; all of them are compilable.

    Attributes:
        modes: Signs of the modes, of ``machine``.
        lengths: Lengths of row j of columns.
        inertia: Constants of the dynamics of row j of columns.
        posture: Joint positions for a point, modes and lengths, and whether they are real.
        pose: Configuration at joint positions, for modes and lengths; whether it is real; and
            whether it is in the working mode.
        position: Point P of a configuration.
        regular: Whether J exists, for a configuration and lengths.
        velocity: Rows of J of a configuration.
        same_side: Whether P at a point is on the assembly mode's side, with the arms as in a
            configuration, for modes and lengths.
        torques: Torques for a configuration, rates, their changes, gravity and inertia.
        gather: Torques that balance a force at P.
        masses: Upper triangle of M for a configuration, J and inertia.
    """

    modes: Callable[..., Any]
    lengths: Callable[..., Any]
    inertia: Callable[..., Any]
    posture: Callable[..., Any]
    pose: Callable[..., Any]
    position: Callable[..., Any]
    regular: Callable[..., Any]
    velocity: Callable[..., Any]
    same_side: Callable[..., Any]
    torques: Callable[..., Any]
    gather: Callable[..., Any]
    masses: Callable[..., Any]


def get(columns: FloatArray, first: int, j: int) -> Triple:
    """Return three columns of a row."""
    return columns[first, j], columns[first + 1, j], columns[first + 2, j]


def _put(columns: FloatArray, first: int, j: int, values: Triple, real: bool) -> None:
    """Set three columns of a row, to NaN if there is no solution."""
    columns[first, j] = values[0] if real else math.nan
    columns[first + 1, j] = values[1] if real else math.nan
    columns[first + 2, j] = values[2] if real else math.nan


def _fill(built: FloatArray, start: int, count: int, each: int, own: FloatArray) -> None:
    """Fill the columns ``own`` with the machine parameters of the rows from ``start`` on.

    Where all rows are of one machine, the first block's columns serve all.
    """
    if start == 0 or len(built) > 1:
        for j in range(count):
            machine = (start + j) // each
            for k in range(len(own)):
                own[k, j] = built[machine, k]


def _read(rows: FloatArray, start: int, count: int, columns: FloatArray, first: int) -> None:
    """Copy rows (count, 3) to the columns from ``first`` on."""
    for j in range(count):
        columns[first, j] = rows[start + j, 0]
        columns[first + 1, j] = rows[start + j, 1]
        columns[first + 2, j] = rows[start + j, 2]


def _write(columns: FloatArray, first: int, start: int, count: int, rows: FloatArray) -> None:
    """Copy columns from ``first`` on to rows (m, 3) or (m, 3, 3)."""
    for j in range(count):
        for k in range(3):  # loops of constant length are unrolled
            if rows.ndim == 2:
                rows[start + j, k] = columns[first + k, j]
            else:
                for i in range(3):
                    rows[start + j, k, i] = columns[first + 3 * k + i, j]


compilable(get, _put, _fill, _read, _write)


def loops(name: str, few: int, many: int, equations: Equations) -> SimpleNamespace:
    """Compile the loops of a mechanism; see :class:`tpm_gym.mechanism.compiled.CompiledMachine`.

    Args:
        name: Name of the mechanism, for the machine code on disk.
        few: Number of lengths.
        many: Number of lengths and constants of the dynamics.
        equations: Functions of the mechanism.
    """
    (modes_of, lengths, inertia, posture, pose, position_of, regular, velocity, on_side, torques,
     gather, masses) = equations  # fmt: skip

    def place(columns: FloatArray, j: int, at: Any, real: bool) -> tuple[Triple, Triple, Triple]:
        """Set the first columns of a row to P and to the rows of J, and return these."""
        rows: tuple[Triple, Triple, Triple] = velocity(at)
        _put(columns, 0, j, position_of(at), real)
        _put(columns, 3, j, rows[0], real)
        _put(columns, 6, j, rows[1], real)
        _put(columns, 9, j, rows[2], real)
        return rows

    compilable(place)

    def inverse(
        position: FloatArray, built: FloatArray, machine: FloatArray, theta: FloatArray
    ) -> None:
        """Compute joint positions (m, 3) for P at ``position`` (m, 3)."""
        modes = modes_of(machine)
        own, given, found = np.empty((few, _BLOCK)), np.empty((3, _BLOCK)), np.empty((3, _BLOCK))
        each = len(position) // len(built)
        for start in range(0, len(position), _BLOCK):
            count = min(_BLOCK, len(position) - start)
            _fill(built, start, count, each, own)
            _read(position, start, count, given, 0)
            for j in range(count):
                angles, real = posture(get(given, 0, j), modes, lengths(own, j))
                _put(found, 0, j, angles, real)
            _write(found, 0, start, count, theta)

    def forward(
        theta: FloatArray, built: FloatArray, machine: FloatArray, position: FloatArray
    ) -> None:
        """Compute P (m, 3) at joint positions (m, 3), in the modes of the machine."""
        modes = modes_of(machine)
        own, given, found = np.empty((few, _BLOCK)), np.empty((3, _BLOCK)), np.empty((3, _BLOCK))
        each = len(theta) // len(built)
        for start in range(0, len(theta), _BLOCK):
            count = min(_BLOCK, len(theta) - start)
            _fill(built, start, count, each, own)
            _read(theta, start, count, given, 0)
            for j in range(count):
                at, _, working = pose(get(given, 0, j), modes, lengths(own, j))
                _put(found, 0, j, position_of(at), working)
            _write(found, 0, start, count, position)

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
        modes = modes_of(machine)
        own, given, found = np.empty((few, _BLOCK)), np.empty((3, _BLOCK)), np.empty((14, _BLOCK))
        each = len(theta) // len(built)
        for start in range(0, len(theta), _BLOCK):
            count = min(_BLOCK, len(theta) - start)
            _fill(built, start, count, each, own)
            _read(theta, start, count, given, 0)
            for j in range(count):
                g = lengths(own, j)
                at, there, found[13, j] = pose(get(given, 0, j), modes, g)
                real = there & regular(at, g)
                rows = place(found, j, at, real)
                found[12, j] = conditioning(rows, NS) if real else math.nan
            _write(found, 0, start, count, position)
            _write(found, 3, start, count, jacobian)
            for j in range(count):
                conditionings[start + j], working[start + j] = found[12, j], found[13, j] > 0.0

    def conditioning_at(
        position: FloatArray,
        limit: float,
        built: FloatArray,
        machine: FloatArray,
        conditionings: FloatArray,
    ) -> None:
        """Compute 1/cond(J) (m,) for P at ``position`` (m, 3); 0 where the machine's modes end."""
        modes = modes_of(machine)
        own, given = np.empty((few, _BLOCK)), np.empty((3, _BLOCK))
        each = len(position) // len(built)
        for start in range(0, len(position), _BLOCK):
            count = min(_BLOCK, len(position) - start)
            _fill(built, start, count, each, own)
            _read(position, start, count, given, 0)
            for j in range(count):
                g, point = lengths(own, j), get(given, 0, j)
                angles, reached = posture(point, modes, g)
                at, there, _ = pose(angles, modes, g)
                x, y, z = position_of(at)
                near = (abs(x - point[0]) < limit) & (abs(y - point[1]) < limit)
                known = reached & there & regular(at, g) & near & (abs(z - point[2]) < limit)
                conditionings[start + j] = conditioning(velocity(at), NS) if known else 0.0

    def torque(
        theta: FloatArray,
        theta_dot: FloatArray,
        theta_ddot: FloatArray,
        force: FloatArray,
        built: FloatArray,
        machine: FloatArray,
        found_torques: FloatArray,
    ) -> None:
        """Compute the motors' torques (m, 3) N m for a motion against forces on P (m, 3) N."""
        modes, fall = modes_of(machine), (machine[-3], machine[-2], machine[-1])
        own, given, found = np.empty((many, _BLOCK)), np.zeros((12, _BLOCK)), np.empty((3, _BLOCK))
        each = len(theta) // len(built)
        for start in range(0, len(theta), _BLOCK):
            count = min(_BLOCK, len(theta) - start)
            _fill(built, start, count, each, own)
            _read(theta, start, count, given, 0)
            _read(theta_dot, start, count, given, 3)
            _read(theta_ddot, start, count, given, 6)
            if len(force):
                _read(force, start, count, given, 9)
            for j in range(count):
                g, bodies = lengths(own, j), inertia(own, j)
                at, there, _ = pose(get(given, 0, j), modes, g)
                one, two, three = torques(at, get(given, 3, j), get(given, 6, j), fall, bodies)
                a, b, c = gather(at, get(given, 9, j))
                _put(found, 0, j, (one - a, two - b, three - c), there & regular(at, g))
            _write(found, 0, start, count, found_torques)

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
        modes, fall = modes_of(machine), (machine[-3], machine[-2], machine[-1])
        own, given, found = np.empty((many, _BLOCK)), np.empty((6, _BLOCK)), np.empty((25, _BLOCK))
        each = len(theta) // len(built)
        for start in range(0, len(theta), _BLOCK):
            count = min(_BLOCK, len(theta) - start)
            _fill(built, start, count, each, own)
            _read(theta, start, count, given, 0)
            _read(theta_dot, start, count, given, 3)
            for j in range(count):
                g, bodies = lengths(own, j), inertia(own, j)
                at, there, found[24, j] = pose(get(given, 0, j), modes, g)
                real = there & regular(at, g)
                rows = place(found, j, at, real)
                a, b, c, d, e, f = masses(at, rows, bodies)
                _put(found, 12, j, (a, b, c), real)
                _put(found, 15, j, (b, d, e), real)
                _put(found, 18, j, (c, e, f), real)
                _put(found, 21, j, torques(at, get(given, 3, j), _NONE, fall, bodies), real)
            _write(found, 0, start, count, position)
            _write(found, 3, start, count, jacobian)
            _write(found, 12, start, count, mass)
            _write(found, 21, start, count, bias)
            for j in range(count):
                working[start + j] = found[24, j] > 0.0

    def mode_left(
        theta: FloatArray,
        position: FloatArray,
        limit: float,
        built: FloatArray,
        machine: FloatArray,
        left: IntArray,
    ) -> None:
        """Find the mode (m,) that is left with P at ``position`` (m, 3): 1 assembly, 2 working."""
        modes = modes_of(machine)
        own, given = np.empty((few, _BLOCK)), np.empty((6, _BLOCK))
        each = len(theta) // len(built)
        for start in range(0, len(theta), _BLOCK):
            count = min(_BLOCK, len(theta) - start)
            _fill(built, start, count, each, own)
            _read(theta, start, count, given, 0)
            _read(position, start, count, given, 3)
            for j in range(count):
                g, point = lengths(own, j), get(given, 3, j)
                at, there, working = pose(get(given, 0, j), modes, g)
                x, y, z = position_of(at)
                off2 = (x - point[0]) ** 2 + (y - point[1]) ** 2 + (z - point[2]) ** 2
                same = there & on_side(at, point, modes, g) & (off2 <= limit * limit)
                left[start + j] = (0 if working else 2) if same else 1

    def same_side(
        position: FloatArray, built: FloatArray, machine: FloatArray, side: BoolArray
    ) -> None:
        """Find whether P at ``position`` (m, 3) is not beyond a parallel singularity, (m,).

        Points out of reach are beyond a serial singularity instead.
        """
        modes = modes_of(machine)
        own, given = np.empty((few, _BLOCK)), np.empty((3, _BLOCK))
        each = len(position) // len(built)
        for start in range(0, len(position), _BLOCK):
            count = min(_BLOCK, len(position) - start)
            _fill(built, start, count, each, own)
            _read(position, start, count, given, 0)
            for j in range(count):
                g, point = lengths(own, j), get(given, 0, j)
                angles, real = posture(point, modes, g)
                at, _, _ = pose(angles, modes, g)
                side[start + j] = (not real) | on_side(at, point, modes, g)

    found = SimpleNamespace()
    for loop in (
        inverse, forward, evaluate, conditioning_at, torque, motion, mode_left, same_side
    ):  # fmt: skip
        # Machine code on disk is found by this name: each mechanism needs its own.
        loop.__qualname__ = f"{name}.{loop.__name__}"
        setattr(found, loop.__name__, kept(loop))
    return found
