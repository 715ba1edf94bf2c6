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
from tpm_gym.simulation.compiled import servo_torque
from tpm_gym.simulation.drives import References
from tpm_gym.simulation.vectors import (
    Symmetric,
    clip,
    dot,
    onto,
    page_row,
    plus,
    put_page_row,
    put_row,
    row_of,
    solved,
    spread,
)

_CREEP = 2e-5  # m/s; below this speed, friction falls to zero in proportion to the speed
_SIGNS = np.array([(i, j, k) for i in (0, 1, -1) for j in (0, 1, -1) for k in (0, 1, -1)], float)
_ZERO: Vector = (0.0, 0.0, 0.0)

_Course = tuple[Any, ...]
"""Attributes ``theta`` to ``carried`` of :class:`Course`."""
_New = tuple[FloatArray, ...]
"""Results at the end of a time step: joint positions, joint velocities and torques (r, 3); two
predictions of P (2, r, 3) m, one from the joint velocities and one from the velocity of P; and the
acceleration of P due to the change of the joint velocities, (r, 3) m/s^2."""


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
        behind: (2, r) whether a motor was at its limit: in the previous time step (first row), and
            in this time step (second row); updated.
    """
    rate = 1.0 / step
    for row in range(len(effort)):
        mass, load = _inertia(row, course, at, step)
        ahead = plus(page_row(references, index, row), row_of(course[0], row), -1.0)
        goal = plus(_ZERO, ahead, rate)
        fast = spread(mass, plus(row_of(course[1], row), goal, -1.0))
        impulse = plus(fast, load, -step)
        short = resisted(mass, impulse, plus(_ZERO, row_of(effort, row), step))
        behind[0, row] = behind[1, row]
        behind[1, row] = short[0] != 0 or short[1] != 0 or short[2] != 0
        torque = plus(_ZERO, plus(spread(mass, short), impulse, -1.0), rate)
        for i in range(3):  # next to a singularity, ``torque`` is mostly rounding errors
            most = effort[row, i]
            held = max(-most, min(torque[i], most))
            new[2][row, i] = held if short[i] == 0 else -np.sign(short[i]) * most
        _integrate(row, plus(goal, short), course, at, step, new)


@kept
def ideal_push(
    index: int,
    references: FloatArray,
    effort: FloatArray,
    theta: FloatArray,
    rates: FloatArray,
    inverse: FloatArray,
    step: float,
    torque: FloatArray,
    behind: BoolArray,
) -> None:
    """Find the torques of ideal drives from the inverse inertia; this matrix may be singular.

    Other arguments are explained in :func:`ideal_step`.

    Args:
        theta: (r, 3) rad, joint positions at the beginning of the time step.
        rates: (r, 3) rad/s, joint velocities that the time step would end with if the torques were
            zero.
        inverse: (r, 3, 3) 1/(kg m^2), inverse inertia at the motors' axes, plus the compliance of
            the motors.
        torque: (r, 3) N m, output.
    """
    for row in range(len(effort)):
        ahead = plus(page_row(references, index, row), row_of(theta, row), -1.0)
        wanted = plus(plus(_ZERO, ahead, 1.0 / step), row_of(rates, row), -1.0)
        a, b, c = page_row(inverse, row, 0)
        _, d, e = page_row(inverse, row, 1)
        matrix = a, b, c, d, e, inverse[row, 2, 2]
        most = plus(_ZERO, row_of(effort, row), step)
        found = _bounded(matrix, wanted, most)
        behind[0, row] = behind[1, row]
        behind[1, row] = False
        for i in range(3):
            behind[1, row] |= abs(found[i]) >= most[i]
            torque[row, i] = found[i] / step


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
    theta, rates = course[0], course[1]
    for row in range(len(theta)):
        mass, load = _inertia(row, course, at, step)
        torque = servo_torque(row, index, references, law, theta, rates, step, memory)
        put_row(new[2], row, torque)
        before, rubbing = row_of(rates, row), row_of(friction, row)
        impulse = plus(plus(spread(mass, before), torque, step), load, -step)
        found = resisted(mass, impulse, plus(_ZERO, rubbing, step))
        _integrate(row, found, course, at, step, new)


def _inertia(row: int, course: _Course, at: Motion, step: float) -> tuple[Symmetric, Vector]:
    """Return the inertia and the load of robot and objects at the motors' axes."""
    m, load, (x, y, z), carried = at[3], row_of(at[4], row), row_of(course[5], row), course[6][row]
    mass = m[row, 0, 0], m[row, 0, 1], m[row, 0, 2], m[row, 1, 1], m[row, 1, 2], m[row, 2, 2]
    if x != 0 or y != 0 or z != 0 or carried != 0:
        return _with_objects(row, mass, load, course, at[1], step)
    return mass, load


@compiled
def _with_objects(
    row: int, mass: Symmetric, load: Vector, course: _Course, jacobian: FloatArray, step: float
) -> tuple[Symmetric, Vector]:
    """Add the inertia and the forces of objects.

    A horizontal force on P that opposes the motion of P is treated as friction. This friction is
    assumed proportional to the velocity of P at the end of the time step. If it were computed from
    the velocity at the beginning, friction could reverse the motion, and P would oscillate.
    """
    (x, y, z), carried = row_of(course[5], row), course[6][row]
    u, v, _ = plus(row_of(course[3], row), row_of(course[4], row), -1.0)
    u, v = u / step, v / step
    speed = np.sqrt(u * u + v * v)
    slow = max(speed, _CREEP)
    opposing = max(-(x * u + y * v), 0.0)
    share = speed / slow if opposing > 0 else 1.0
    level = carried + step * opposing / (max(speed, 1e-12) * slow)
    for axis, force, inertia in ((0, share * x, level), (1, share * y, level), (2, z, carried)):
        a, b, c = page_row(jacobian, row, axis)
        load = plus(load, (a, b, c), -force)
        p, q, r, s, t, w = mass
        mass = (
            p + inertia * a * a, q + inertia * a * b, r + inertia * a * c,
            s + inertia * b * b, t + inertia * b * c, w + inertia * c * c,
        )  # fmt: skip
    return mass, load


def _integrate(
    row: int, rates: Vector, course: _Course, at: Motion, step: float, new: _New
) -> None:
    """Write joint positions, joint velocities, predicted P and acceleration of P to ``new``."""
    position = row_of(course[3], row)
    put_row(new[0], row, plus(row_of(course[0], row), rates, step))
    put_row(new[1], row, rates)
    put_page_row(new[3], 0, row, plus(position, onto(_ZERO, at[1], row, rates), step))
    x, y, z = row_of(course[4], row)
    put_page_row(new[3], 1, row, plus((-x, -y, -z), position, 2.0))
    change = onto(_ZERO, at[1], row, plus(rates, row_of(course[1], row), -1.0))
    put_row(new[4], row, plus(_ZERO, change, 1.0 / step))


compilable(_inertia, _integrate)


@kept
def modes_left(
    position: FloatArray, side: BoolArray, working: BoolArray, before: NDArray[np.int8]
) -> tuple[NDArray[np.int8], bool]:
    """Return the mode that each robot has left (r,), and whether any robot has left one.

    After P has passed a parallel singularity, the joint positions also fit a point on the side that
    P has left. Forward kinematics return this point. So only ``side`` detects the passage.

    Args:
        position: (r, 3) m, P by forward kinematics; NaN if there is no assembly.
        side: (2, r) whether P stays on its side of the singularity, for two predictions of P: one
            from the joint velocities, and one from the velocity of P.
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
def resisted(mass: Symmetric, impulse: Vector, limit: Vector) -> Vector:
    """Compute the joint velocities u (rad/s) after an impulse, with Coulomb friction.

    mass @ u = impulse - resistance. The resistance of a joint is limit * sign(u); if u is 0, the
    size of the resistance is at most limit. So u minimises
    u @ mass @ u / 2 - impulse @ u + limit @ |u|.

    Args:
        mass: Inertia, kg m^2.
        impulse: N m s.
        limit: N m s, zero or more.
    """
    found = solved(mass, impulse)
    if limit[0] != 0 or limit[1] != 0 or limit[2] != 0:
        signs = np.sign(found[0]), np.sign(found[1]), np.sign(found[2])
        found = _moving(mass, impulse, limit, signs)
        if not (found[0] * signs[0] > 0 and found[1] * signs[1] > 0 and found[2] * signs[2] > 0):
            best = np.inf
            for choice in range(27):  # all combinations of u < 0, u = 0 and u > 0
                tried = _moving(mass, impulse, limit, row_of(_SIGNS, choice))
                x, y, z = spread(mass, tried)
                cost = dot(tried, plus((x / 2, y / 2, z / 2), impulse, -1.0))
                cost += dot(limit, (abs(tried[0]), abs(tried[1]), abs(tried[2])))
                if cost < best:
                    best, found = cost, tried
    return found


@compiled
def _moving(mass: Symmetric, impulse: Vector, limit: Vector, signs: Vector) -> Vector:
    """Solve mass @ u = impulse - limit * signs for u, where ``signs`` are the assumed signs of u.

    If a component of ``signs`` is 0, this component of u is 0, and its equation is left out.
    """
    (a, b, c, d, e, f), (p, q, r) = mass, (abs(signs[0]), abs(signs[1]), abs(signs[2]))
    own = a * p + 1 - p, b * p * q, c * p * r, d * q + 1 - q, e * q * r, f * r + 1 - r
    x, y, z = impulse
    x, y, z = x - limit[0] * signs[0], y - limit[1] * signs[1], z - limit[2] * signs[2]
    return solved(own, (p * x, q * y, r * z))


@compiled
def _bounded(matrix: Symmetric, wanted: Vector, most: Vector) -> Vector:
    """Find x from -``most`` to ``most`` that minimises x @ matrix @ x / 2 - wanted @ x.

    At the minimum, some components of x may be at a bound. With respect to each other component,
    the derivative of the minimised function is zero.
    """
    found, best = _ZERO, np.inf
    for choice in range(27):  # all combinations of no bound, upper bound and lower bound
        u, v, w = row_of(_SIGNS, choice)
        fixed = u * most[0], v * most[1], w * most[2]
        x, y, z = _moving(
            matrix,
            plus(wanted, spread(matrix, fixed), -1.0),
            _ZERO,
            (1.0 - abs(u), 1.0 - abs(v), 1.0 - abs(w)),
        )
        p, q, r = plus((x, y, z), fixed)
        tried = clip(p, -most[0], most[0]), clip(q, -most[1], most[1]), clip(r, -most[2], most[2])
        a, b, c = spread(matrix, tried)
        cost = dot(tried, plus((a / 2, b / 2, c / 2), wanted, -1.0))
        if cost < best:
            best, found = cost, tried
        if choice == 0 and tried == (p, q, r):
            break
    return found
