"""Compiled loops over rows, which compute a mechanism's kinematics and dynamics.

A loop takes five arguments:

* ``inputs``: a tuple of arrays (n, 3).
* ``limit``: a distance, m, for the loops that compare positions.
* ``built``: (b, k), the lengths (m) and the constants of the dynamics of b machines. Row i of the n
  rows belongs to machine ``built[i // (n // b)]``.
* ``machine``: the signs of the modes, then the three components of gravity, m/s^2.
* ``results``: a tuple of arrays with n rows, which the loop fills; NaN where there is no solution.

A row does not depend on the others. So a call with one row and a call with thousands of rows give
this row equal results, bit for bit. A loop copies the inputs of several rows (a block) to columns
of an array, so that the compiled code can compute several rows at a time.
"""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

import numpy as np

from tpm_gym.arrays import FloatArray
from tpm_gym.compiling import compilable, kept, literal_unroll
from tpm_gym.kinematics import compiled as functions
from tpm_gym.kinematics.equations import Triple, conditioning

NS: Any = functions
"""Namespace of compiled functions."""

_BLOCK: Final = 64  # rows of a block; their columns stay in the cache
_NONE: Final = (0.0, 0.0, 0.0)


class Equations(NamedTuple):
    """Functions of one mechanism, called by the loops over rows.

    Each attribute is given as (arguments) -> results. ``columns[k, j]`` is parameter k of the
    machine to which row j belongs: the lengths come first, then the constants of the dynamics.
    ``rates`` and ``changes`` are the first and second derivatives of the joint positions by time.

    Attributes:
        modes: (machine) -> signs of the modes.
        lengths: (columns, j) -> lengths of row j.
        inertia: (columns, j) -> constants of the dynamics of row j.
        posture: (point, modes, lengths) -> joint positions; whether they exist.
        pose: (joint positions, modes, lengths) -> configuration; whether it exists; whether it is
            in the working mode.
        position: (configuration) -> point P.
        regular: (configuration, lengths) -> whether J exists.
        velocity: (configuration) -> rows of J.
        same_side: (configuration, point, modes, lengths) -> whether the point is on the same side
            of the parallel singularities as the assembly mode. The function may use only the arms
            of the configuration, since the other parts may not exist.
        torques: (configuration, rates, changes, gravity, inertia) -> torques.
        gather: (configuration, force at P) -> torques J^T force.
        masses: (configuration, J, inertia) -> upper triangle of M.
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
    """Return row j of three columns, beginning at column ``first``."""
    return columns[first, j], columns[first + 1, j], columns[first + 2, j]


def _put(columns: FloatArray, first: int, j: int, values: Triple, real: bool) -> None:
    """Write row j of three columns, beginning at column ``first``; NaN if there is no solution."""
    columns[first, j] = values[0] if real else math.nan
    columns[first + 1, j] = values[1] if real else math.nan
    columns[first + 2, j] = values[2] if real else math.nan


def _place(
    columns: FloatArray, j: int, position: Triple, rows: tuple[Triple, Triple, Triple], real: bool
) -> None:
    """Write P and the rows of J to the first 12 columns of row j; NaN if there is no solution."""
    _put(columns, 0, j, position, real)
    _put(columns, 3, j, rows[0], real)
    _put(columns, 6, j, rows[1], real)
    _put(columns, 9, j, rows[2], real)


def _fill(built: FloatArray, start: int, count: int, each: int, own: FloatArray) -> None:
    """Fill the columns ``own`` with the machine parameters of a block of rows.

    The block has ``count`` rows, beginning at row ``start``. ``each`` is the number of rows of one
    machine. If all rows belong to one machine, the columns are filled for the first block only, and
    later blocks use them again.
    """
    if start == 0 or len(built) > 1:
        for j in range(count):
            machine = (start + j) // each
            for k in range(len(own)):
                own[k, j] = built[machine, k]


def _read(rows: FloatArray, start: int, count: int, columns: FloatArray, first: int) -> None:
    """Copy ``count`` rows from row ``start`` on to the three columns from column ``first`` on.

    ``rows`` is (n, 3).
    """
    for j in range(count):
        columns[first, j] = rows[start + j, 0]
        columns[first + 1, j] = rows[start + j, 1]
        columns[first + 2, j] = rows[start + j, 2]


def _write(columns: FloatArray, first: int, start: int, count: int, rows: Any) -> int:
    """Copy columns to ``rows``, (n,), (n, 3) or (n, 3, 3); return the next column's index."""
    if rows.ndim == 1:
        for j in range(count):
            rows[start + j] = columns[first, j]
        return first + 1
    for j in range(count):
        for k in range(3):  # loops of constant length are unrolled
            if rows.ndim == 2:
                rows[start + j, k] = columns[first + k, j]
            else:
                for i in range(3):
                    rows[start + j, k, i] = columns[first + 3 * k + i, j]
    return first + (3 if rows.ndim == 2 else 9)


compilable(get, _put, _place, _fill, _read, _write)


class _Block(NamedTuple):
    """Columns of a block (machine parameters, inputs, results), and values that all rows share."""

    own: FloatArray
    given: FloatArray
    found: FloatArray
    modes: Any
    fall: Triple
    limit: float


def loops(name: str, few: int, many: int, equations: Equations) -> SimpleNamespace:
    """Compile the loops of a mechanism; see :class:`tpm_gym.mechanism.compiled.CompiledMachine`.

    Args:
        name: Name of the mechanism. The compiled functions are kept on disk under this name.
        few: Number of lengths.
        many: Number of lengths and constants of the dynamics.
        equations: Functions of the mechanism. Functions that they call must be compilable.
    """
    compilable(*equations)
    found = SimpleNamespace()
    for size, rows in (few, _kinematics(equations)), (many, _dynamics(equations)):
        for row, width in rows.items():
            loop = _loop(row, equations.modes, size, width)
            # The compiled function is found on disk by this name: each mechanism needs its own.
            loop.__qualname__ = f"{name}.{row.__name__}"
            setattr(found, row.__name__, kept(loop))
    return found


def _loop(row: Callable[..., None], modes_of: Callable[..., Any], size: int, width: int) -> Any:
    """Return a loop over blocks; ``row`` computes the ``width`` results of each row j."""
    compilable(row)

    def loop(
        inputs: Any, limit: float, built: FloatArray, machine: FloatArray, results: Any
    ) -> None:
        modes, fall = modes_of(machine), (machine[-3], machine[-2], machine[-1])
        own, found = np.empty((size, _BLOCK)), np.empty((width, _BLOCK))
        given, rows = np.empty((3 * len(inputs), _BLOCK)), len(inputs[0])
        block = _Block(own, given, found, modes, fall, limit)
        for start in range(0, rows, _BLOCK):
            count = min(_BLOCK, rows - start)
            _fill(built, start, count, rows // len(built), own)
            for k in range(len(inputs)):
                _read(inputs[k], start, count, given, 3 * k)
            for j in range(count):
                row(block, j)
            first = 0
            for result in literal_unroll(results):
                first = _write(found, first, start, count, result)

    return loop


def _kinematics(equations: Equations) -> dict[Callable[..., None], int]:
    """Return the functions for kinematics: {function: number of result columns}.

    Of a machine's parameters, these functions use only the lengths.
    """
    _, lengths, _, posture, pose, position_of, regular, velocity, on_side, *_ = equations

    def inverse(block: _Block, j: int) -> None:
        """Compute the joint positions (3 columns) for P."""
        angles, real = posture(get(block.given, 0, j), block.modes, lengths(block.own, j))
        _put(block.found, 0, j, angles, real)

    def forward(block: _Block, j: int) -> None:
        """Compute P of row j from its joint positions, in the modes of the machine."""
        at, _, working = pose(get(block.given, 0, j), block.modes, lengths(block.own, j))
        _put(block.found, 0, j, position_of(at), working)

    def evaluate(block: _Block, j: int) -> None:
        """Compute P, J, 1/cond(J), and whether the machine is in its working mode, at theta.

        The results have 3, 9, 1 and 1 columns.
        """
        g, found = lengths(block.own, j), block.found
        at, there, found[13, j] = pose(get(block.given, 0, j), block.modes, g)
        real, rows = there & regular(at, g), velocity(at)
        _place(found, j, position_of(at), rows, real)
        found[12, j] = conditioning(rows, NS) if real else math.nan

    def conditioning_at(block: _Block, j: int) -> None:
        """Compute 1/cond(J) for P.

        The result is 0 if P is out of reach, if J does not exist, or if the forward kinematics
        return a point that differs from P by the limit or more.
        """
        g, point, limit = lengths(block.own, j), get(block.given, 0, j), block.limit
        angles, reached = posture(point, block.modes, g)
        at, there, _ = pose(angles, block.modes, g)
        x, y, z = position_of(at)
        near = (abs(x - point[0]) < limit) & (abs(y - point[1]) < limit)
        known = reached & there & regular(at, g) & near & (abs(z - point[2]) < limit)
        block.found[0, j] = conditioning(velocity(at), NS) if known else 0.0

    def mode_left(block: _Block, j: int) -> None:
        """Find the mode that the machine has left: 0 for none, 1 for assembly, 2 for working."""
        g, point = lengths(block.own, j), get(block.given, 3, j)
        at, there, working = pose(get(block.given, 0, j), block.modes, g)
        x, y, z = position_of(at)
        off2 = (x - point[0]) ** 2 + (y - point[1]) ** 2 + (z - point[2]) ** 2
        near = off2 <= block.limit * block.limit
        same = there & on_side(at, point, block.modes, g) & near
        block.found[0, j] = (0.0 if working else 2.0) if same else 1.0

    def same_side(block: _Block, j: int) -> None:
        """Find whether P is on the assembly mode's side of the parallel singularities.

        The result is true for points out of reach, too. They are beyond a serial singularity, which
        limits the reach, and not beyond a parallel one.
        """
        g, point = lengths(block.own, j), get(block.given, 0, j)
        angles, real = posture(point, block.modes, g)
        at, _, _ = pose(angles, block.modes, g)
        block.found[0, j] = (not real) | on_side(at, point, block.modes, g)

    return {inverse: 3, forward: 3, evaluate: 14, conditioning_at: 1, mode_left: 1, same_side: 1}


def _dynamics(equations: Equations) -> dict[Callable[..., None], int]:
    """Return the functions for dynamics: {function: number of result columns}.

    These functions use all parameters of a machine: the lengths and the constants of the dynamics.
    """
    _, lengths, inertia, _, pose, position_of, regular, velocity, _, torques, gather, masses = (
        equations
    )

    def torque(block: _Block, j: int) -> None:
        """Compute the motors' torques (3), N m, for a motion during which a force acts on P.

        The inputs are theta, theta_dot, theta_ddot and the force, N, with three columns each.
        """
        g, given = lengths(block.own, j), block.given
        at, there, _ = pose(get(given, 0, j), block.modes, g)
        rates, changes, bodies = get(given, 3, j), get(given, 6, j), inertia(block.own, j)
        one, two, three = torques(at, rates, changes, block.fall, bodies)
        a, b, c = gather(at, get(given, 9, j))
        _put(block.found, 0, j, (one - a, two - b, three - c), there & regular(at, g))

    def motion(block: _Block, j: int) -> None:
        """Compute P, J, whether the machine is in its working mode, mass matrix, and bias torques.

        The results have 3, 9, 1, 9 and 3 columns. The bias torques are the torques at zero joint
        acceleration.
        """
        g, bodies, found = lengths(block.own, j), inertia(block.own, j), block.found
        at, there, found[12, j] = pose(get(block.given, 0, j), block.modes, g)
        real, rows = there & regular(at, g), velocity(at)
        _place(found, j, position_of(at), rows, real)
        a, b, c, d, e, f = masses(at, rows, bodies)
        _put(found, 13, j, (a, b, c), real)
        _put(found, 16, j, (b, d, e), real)
        _put(found, 19, j, (c, e, f), real)
        _put(found, 22, j, torques(at, get(block.given, 3, j), _NONE, block.fall, bodies), real)

    return {torque: 3, motion: 25}
