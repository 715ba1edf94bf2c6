"""Compiled time steps of forward dynamics, for many robots.

Each robot is computed separately, so that its result does not depend on the other robots.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import BoolArray, FloatArray, Vector
from tpm_gym.compiling import compilable, compiled, kept
from tpm_gym.mechanism.machine import Motion
from tpm_gym.simulation.compiled import inverted, servo_torque
from tpm_gym.simulation.drives import References
from tpm_gym.simulation.vectors import onto, plus, put, put_row, row_of, three

__all__ = ["ideal_step", "modes_left", "resisted", "servo_step"]

_CREEP = 2e-5  # m/s; below this speed, friction falls to zero in proportion to the speed
_SIGNS = np.array([(i, j, k) for i in (0, 1, -1) for j in (0, 1, -1) for k in (0, 1, -1)], float)

_Course = tuple[Any, ...]
"""Attributes ``theta`` to ``carried`` of :class:`Course`."""
_New = tuple[FloatArray, ...]
"""Results at the end of a time step: joint positions, joint velocities and torques (r, 3), P
predicted from the joint velocities and from its own velocity (2, r, 3) m, and acceleration of P due
to the change of the joint velocities (r, 3) m/s^2."""


@kept
def ideal_step(
    index: int,
    references: FloatArray,
    effort: FloatArray,
    course: _Course,
    at: Motion,
    step: float,
    new: _New,
    behind: BoolArray,
) -> None:
    """Compute a time step of ideal drives with limited torques.

    Args:
        index: Index of the time step in the control period.
        references: (K, r, 3) rad, joint positions at the ends of the time steps.
        effort: (r, 3) N m, largest torques.
        course: State of the robots at the beginning of the time step.
        at: Kinematics and dynamics at the beginning of the time step.
        step: Time step, s.
        new: Output.
        behind: (2, r) whether a motor was at its limit in the last and in this time step; output.
    """
    goal, impulse, limit, short = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    mass, load = np.empty((1, 3, 3)), np.empty(3)
    theta, rates = course[0], course[1]
    for row in range(len(theta)):
        _add_objects(row, course, at, step, mass, load)
        for i in range(3):
            goal[i] = (references[index, row, i] - theta[row, i]) / step
            limit[i] = step * effort[row, i]
        fast = plus(row_of(rates, row), three(goal), -1.0)
        put(impulse, onto((-step * load[0], -step * load[1], -step * load[2]), mass, 0, fast))
        resisted(mass[0], impulse, limit, short)
        behind[0, row] = behind[1, row]
        behind[1, row] = short[0] != 0 or short[1] != 0 or short[2] != 0
        x, y, z = three(impulse)
        needed = onto((-x, -y, -z), mass, 0, three(short))
        put_row(new[2], row, (needed[0] / step, needed[1] / step, needed[2] / step))
        _integrate(row, plus(three(goal), three(short)), course, at, step, new)


@kept
def servo_step(
    index: int,
    references: References,
    law: tuple[FloatArray, float, FloatArray, FloatArray, FloatArray, FloatArray],
    friction: FloatArray,
    course: _Course,
    at: Motion,
    step: float,
    new: _New,
    memory: FloatArray,
) -> None:
    """Compute a time step of servo drives with Coulomb friction on the motors' axes.

    The arguments index, course, at, step and new are explained in :func:`ideal_step`; references,
    law and memory in :func:`tpm_gym.simulation.compiled.servo_torques`.

    Args:
        friction: (r, 3) N m, Coulomb friction on the motors' axes.
    """
    impulse, limit, found = np.empty(3), np.empty(3), np.empty(3)
    mass, load, inverse = np.empty((1, 3, 3)), np.empty(3), np.empty((1, 3, 3))
    theta, rates = course[0], course[1]
    for row in range(len(theta)):
        _add_objects(row, course, at, step, mass, load)
        servo_torque(row, index, references, law, theta, rates, step, memory)
        x, y, z = plus(row_of(memory[0], row), three(load), -1.0)
        put_row(new[2], row, row_of(memory[0], row))
        put(impulse, onto((step * x, step * y, step * z), mass, 0, row_of(rates, row)))
        for i in range(3):
            limit[i] = step * friction[row, i]
        if limit[0] == 0 and limit[1] == 0 and limit[2] == 0:
            m = mass[0]
            inverted(m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2], inverse[0])
            put(found, onto((0.0, 0.0, 0.0), inverse, 0, three(impulse)))
        else:
            resisted(mass[0], impulse, limit, found)
        _integrate(row, three(found), course, at, step, new)


def _add_objects(
    row: int, course: _Course, at: Motion, step: float, mass: FloatArray, load: FloatArray
) -> None:
    """Write the inertia (1, 3, 3) and load (3,) of robot and objects at the motors' axes.

    A horizontal force on P against the motion of P is friction. It is assumed proportional to the
    velocity at the end of the time step. With the velocity at the beginning, friction could
    reverse the motion, and P would oscillate.
    """
    for i in range(3):
        load[i] = at[4][row, i]
        for k in range(3):
            mass[0, i, k] = at[3][row, i, k]
    (x, y, z), carried = row_of(course[5], row), course[6][row]
    if x == 0 and y == 0 and z == 0 and carried == 0:
        return
    u, v, _ = plus(row_of(course[3], row), row_of(course[4], row), -1.0)
    u, v = u / step, v / step
    speed = np.sqrt(u * u + v * v)
    slow = max(speed, _CREEP)
    opposing = max(-(x * u + y * v), 0.0)
    share = speed / slow if opposing > 0 else 1.0
    level = carried + step * opposing / (max(speed, 1e-12) * slow)
    j = at[1]
    for i in range(3):
        load[i] -= share * (j[row, 0, i] * x + j[row, 1, i] * y) + j[row, 2, i] * z
        for k in range(3):
            mass[0, i, k] += level * (j[row, 0, i] * j[row, 0, k] + j[row, 1, i] * j[row, 1, k])
            mass[0, i, k] += carried * (j[row, 2, i] * j[row, 2, k])


def _integrate(
    row: int, rates: Vector, course: _Course, at: Motion, step: float, new: _New
) -> None:
    """Write joint positions, joint velocities, predicted P and acceleration of P to ``new``."""
    zero, position = (0.0, 0.0, 0.0), row_of(course[3], row)
    put_row(new[0], row, plus(row_of(course[0], row), rates, step))
    put_row(new[1], row, rates)
    put_row(new[3][0], row, plus(position, onto(zero, at[1], row, rates), step))
    x, y, z = row_of(course[4], row)
    put_row(new[3][1], row, plus((-x, -y, -z), position, 2.0))
    x, y, z = onto(zero, at[1], row, plus(rates, row_of(course[1], row), -1.0))
    put_row(new[4], row, (x / step, y / step, z / step))


compilable(_add_objects, _integrate)


@kept
def modes_left(
    position: FloatArray, side: BoolArray, working: BoolArray, before: NDArray[np.int8]
) -> tuple[NDArray[np.int8], bool]:
    """Return the mode that each robot has left (r,), and whether any robot has left one.

    Beyond a parallel singularity the joints turn back, so that forward kinematics still return a
    position, but of the wrong assembly. Only ``side`` detects this.

    Args:
        position: (r, 3) m, P by forward kinematics; NaN if there is no assembly.
        side: (2, r) whether P, predicted from the joint velocities and from its own velocity,
            stays on its side of the singularity.
        working: (r,) whether the robot is in its working mode.
        before: (r,) mode that was left earlier.
    """
    left, anywhere = before.copy(), False
    for row in range(len(left)):
        if left[row] == 0:
            if not (side[0, row] and side[1, row]) or np.isnan(position[row, 0]):
                left[row] = 1
            elif not working[row]:
                left[row] = 2
        anywhere |= left[row] != 0
    return left, anywhere


@compiled
def resisted(mass: FloatArray, impulse: FloatArray, limit: FloatArray, rates: FloatArray) -> None:
    """Compute the joint velocities u (3,) after an impulse, with Coulomb friction.

    mass u = impulse - resistance. The resistance is limit sign(u), or at most limit if u is zero.
    So u minimises u mass u / 2 - impulse u + limit |u|.

    Args:
        mass: (3, 3) kg m^2, symmetric.
        impulse: (3,) N m s.
        limit: (3,) N m s, zero or more.
        rates: (3,) rad/s, u; output.
    """
    everything, still = (1.0, 1.0, 1.0), limit[0] == 0 and limit[1] == 0 and limit[2] == 0
    best, found = np.inf, _solved(mass, impulse, limit, (0.0, 0.0, 0.0), everything)
    if not still:
        signs = np.sign(found[0]), np.sign(found[1]), np.sign(found[2])
        found = _solved(mass, impulse, limit, signs, everything)
        if not (found[0] * signs[0] > 0 and found[1] * signs[1] > 0 and found[2] * signs[2] > 0):
            for choice in range(27):  # all combinations of u < 0, u = 0 and u > 0
                signs = row_of(_SIGNS, choice)
                moving = abs(signs[0]), abs(signs[1]), abs(signs[2])
                tried, cost = _solved(mass, impulse, limit, signs, moving), 0.0
                for i in range(3):
                    share = mass[i, 0] * tried[0] + mass[i, 1] * tried[1] + mass[i, 2] * tried[2]
                    cost += tried[i] * (share / 2 - impulse[i]) + limit[i] * abs(tried[i])
                if cost < best:
                    best, found = cost, tried
    put(rates, found)


@compiled
def _solved(
    mass: FloatArray, impulse: FloatArray, limit: FloatArray, signs: Vector, moving: Vector
) -> Vector:
    """Solve mass u = impulse - limit signs for joints with ``moving`` 1; u = 0 for those with 0."""
    inverse = np.empty((1, 3, 3))
    m0, m1, m2 = moving
    inverted(
        mass[0, 0] * m0 + 1 - m0, mass[0, 1] * m0 * m1, mass[0, 2] * m0 * m2,
        mass[1, 1] * m1 + 1 - m1, mass[1, 2] * m1 * m2, mass[2, 2] * m2 + 1 - m2, inverse[0],
    )  # fmt: skip
    resistance = limit[0] * signs[0], limit[1] * signs[1], limit[2] * signs[2]
    x, y, z = plus(three(impulse), resistance, -1.0)
    return onto((0.0, 0.0, 0.0), inverse, 0, (m0 * x, m1 * y, m2 * z))
