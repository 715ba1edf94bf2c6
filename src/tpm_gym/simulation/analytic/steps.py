"""Compiled time steps of forward dynamics, for many machines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.compiling import compiled, kept
from tpm_gym.simulation.compiled import inverted

__all__ = ["driven_by_torque", "driven_ideally", "felt", "modes_left", "moved", "ways_in_world"]

_CREEP = 2e-5  # m/s, at which friction gives way, instead of not at all
_SIGNS = np.array([(i, j, k) for i in (0, 1, -1) for j in (0, 1, -1) for k in (0, 1, -1)], float)


@kept
def driven_ideally(
    reference: FloatArray,
    effort: FloatArray,
    theta: FloatArray,
    rates: FloatArray,
    mass: FloatArray,
    load: FloatArray,
    step: float,
    new_rates: FloatArray,
    torque: FloatArray,
    behind: BoolArray,
) -> None:
    """Run a time step of ideal drives, which remove their error as far as their effort allows.

    Args:
        reference: (r, 3) rad, at the end of the time step.
        effort: (r, 3) N m, largest torques.
        theta: (r, 3) rad.
        rates: (r, 3) rad/s.
        mass: (r, 3, 3) kg m^2; mass theta_ddot = torque - load.
        load: (r, 3) N m.
        step: s.
        new_rates: (r, 3) rad/s, at the end of the time step; written.
        torque: (r, 3) N m; written.
        behind: (r,) whether a motor was at its limit; written.
    """
    goal, impulse, limit, short = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for row in range(len(theta)):
        for i in range(3):
            goal[i] = (reference[row, i] - theta[row, i]) / step
        for i in range(3):
            impulse[i] = -step * load[row, i]
            for k in range(3):
                impulse[i] += mass[row, i, k] * (rates[row, k] - goal[k])
            limit[i] = step * effort[row, i]
        resisted(mass[row], impulse, limit, short)
        behind[row] = short[0] != 0 or short[1] != 0 or short[2] != 0
        for i in range(3):
            new_rates[row, i] = goal[i] + short[i]
            needed = -impulse[i]
            for k in range(3):
                needed += mass[row, i, k] * short[k]
            torque[row, i] = needed / step


@kept
def driven_by_torque(
    torque: FloatArray,
    friction: FloatArray,
    rates: FloatArray,
    mass: FloatArray,
    load: FloatArray,
    step: float,
    new_rates: FloatArray,
) -> None:
    """Run a time step of motors that apply a torque against Coulomb friction.

    Args:
        torque: (r, 3) N m.
        friction: (r, 3) N m, on the motors' axes.
        rates: (r, 3) rad/s.
        mass: (r, 3, 3) kg m^2; mass theta_ddot = torque - load - friction.
        load: (r, 3) N m.
        step: s.
        new_rates: (r, 3) rad/s, at the end of the time step; written.
    """
    impulse, limit, inverse = np.empty(3), np.empty(3), np.empty((3, 3))
    for row in range(len(rates)):
        free = True
        for i in range(3):
            impulse[i] = step * (torque[row, i] - load[row, i])
            for k in range(3):
                impulse[i] += mass[row, i, k] * rates[row, k]
            limit[i] = step * friction[row, i]
            free = free and limit[i] == 0
        if not free:
            resisted(mass[row], impulse, limit, new_rates[row])
            continue
        inverted(
            mass[row, 0, 0], mass[row, 0, 1], mass[row, 0, 2],
            mass[row, 1, 1], mass[row, 1, 2], mass[row, 2, 2], inverse,
        )  # fmt: skip
        for i in range(3):
            new_rates[row, i] = (
                inverse[i, 0] * impulse[0] + inverse[i, 1] * impulse[1] + inverse[i, 2] * impulse[2]
            )


@kept
def moved(
    theta: FloatArray,
    rates: FloatArray,
    new_rates: FloatArray,
    position: FloatArray,
    before: FloatArray,
    jacobian: FloatArray,
    step: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Integrate joint positions, and predict where P goes; all (r, 3).

    Args:
        theta: rad, at the beginning of the time step.
        rates: rad/s, at its beginning.
        new_rates: rad/s, at its end.
        position: m, point P at its beginning.
        before: m, point P a time step earlier.
        jacobian: (r, 3, 3) m/rad, at its beginning.
        step: s.

    Returns:
        Joint positions at the end; P by the joint velocities, and by its own velocity; the
        acceleration of P by the change of the joint velocities, m/s^2.
    """
    new_theta, expected, drifting, gain = (
        np.empty_like(theta), np.empty_like(theta), np.empty_like(theta), np.empty_like(theta),
    )  # fmt: skip
    for row in range(len(theta)):
        for i in range(3):
            new_theta[row, i] = theta[row, i] + step * new_rates[row, i]
            drifting[row, i] = 2 * position[row, i] - before[row, i]
            speed = change = 0.0
            for k in range(3):
                speed += jacobian[row, i, k] * new_rates[row, k]
                change += jacobian[row, i, k] * (new_rates[row, k] - rates[row, k])
            expected[row, i] = position[row, i] + step * speed
            gain[row, i] = change / step
    return new_theta, expected, drifting, gain


@kept
def modes_left(
    position: FloatArray,
    side: BoolArray,
    working: BoolArray,
    before: NDArray[np.int8],
) -> tuple[NDArray[np.int8], bool]:
    """Find which mode each machine has left, (r,), and whether any has.

    Beyond a parallel singularity the joints turn back, so that the positions of the mirrored
    assembly exist too. Only ``side`` tells them apart.

    Args:
        position: (r, 3) m, by forward kinematics; NaN where there is none.
        side: (r,) whether P was about to stay on its side, by the joint velocities and by its own.
        working: (r,) whether the machine is in its working mode.
        before: (r,) mode that was left earlier.
    """
    left, anywhere = before.copy(), False
    for row in range(len(left)):
        if left[row] == 0:
            if not side[row] or np.isnan(position[row, 0]):
                left[row] = 1
            elif not working[row]:
                left[row] = 2
        anywhere |= left[row] != 0
    return left, anywhere


@compiled
def resisted(mass: FloatArray, impulse: FloatArray, limit: FloatArray, rates: FloatArray) -> None:
    """Find the rates u (3,) that an impulse gives against Coulomb friction.

    mass u = impulse - resistance. The resistance is limit sign(u), and up to limit where u is zero.
    So u minimises u mass u / 2 - impulse u + limit |u|.

    Args:
        mass: (3, 3) kg m^2, symmetric.
        impulse: (3,) N m s.
        limit: (3,) N m s, zero or more.
        rates: (3,) rad/s; written.
    """
    signs, best = np.zeros(3), np.inf
    _solved(mass, impulse, limit, signs, np.ones(3), rates)
    if limit[0] == 0 and limit[1] == 0 and limit[2] == 0:
        return
    tried = np.empty(3)
    signs[:] = np.sign(rates)
    _solved(mass, impulse, limit, signs, np.ones(3), tried)
    if tried[0] * signs[0] > 0 and tried[1] * signs[1] > 0 and tried[2] * signs[2] > 0:
        rates[:] = tried
        return
    for choice in range(27):  # all ways in which three rates are zero or have a sign
        signs[:] = _SIGNS[choice]
        _solved(mass, impulse, limit, signs, np.abs(signs), tried)
        cost = 0.0
        for i in range(3):
            share = 0.0
            for k in range(3):
                share += mass[i, k] * tried[k]
            cost += tried[i] * (share / 2 - impulse[i]) + limit[i] * abs(tried[i])
        if cost < best:
            best = cost
            rates[:] = tried


@compiled
def _solved(
    mass: FloatArray,
    impulse: FloatArray,
    limit: FloatArray,
    signs: FloatArray,
    moving: FloatArray,
    rates: FloatArray,
) -> None:
    """Solve mass u = impulse - limit signs for what moves (1); the rest (0) has u = 0."""
    inverse = np.empty((3, 3))
    m0, m1, m2 = moving
    inverted(
        mass[0, 0] * m0 + 1 - m0, mass[0, 1] * m0 * m1, mass[0, 2] * m0 * m2,
        mass[1, 1] * m1 + 1 - m1, mass[1, 2] * m1 * m2, mass[2, 2] * m2 + 1 - m2, inverse,
    )  # fmt: skip
    for i in range(3):
        rates[i] = 0.0
        for k in range(3):
            rates[i] += inverse[i, k] * moving[k] * (impulse[k] - limit[k] * signs[k])


@kept
def felt(
    mass: FloatArray,
    bias: FloatArray,
    jacobian: FloatArray,
    force: FloatArray,
    carried: FloatArray,
    travel: FloatArray,
    step: float,
) -> tuple[FloatArray, FloatArray]:
    """Compute the inertia (r, 3, 3) and load (r, 3) that motors feel, with objects on P.

    The level part of a force that opposes the motion is friction. It is taken as proportional to
    the velocity at the end of the time step: taken from the beginning, friction would overshoot
    what it stops, and push it to and fro.

    Args:
        mass: (r, 3, 3) kg m^2, of the machine alone.
        bias: (r, 3) N m, of the machine alone.
        jacobian: (r, 3, 3) m/rad.
        force: (r, 3) N on P, in the last time step, machine's frame.
        carried: (r,) kg, moving with P.
        travel: (r, 3) m, of P in the last time step.
        step: s.
    """
    inertia, load = mass.copy(), bias.copy()
    for row in range(len(mass)):
        x, y, z = force[row]
        if x == 0 and y == 0 and z == 0 and carried[row] == 0:
            continue
        u, v = travel[row, 0] / step, travel[row, 1] / step
        speed = np.sqrt(u * u + v * v)
        slow = max(speed, _CREEP)
        opposing = max(-(x * u + y * v), 0.0)
        share = speed / slow if opposing > 0 else 1.0
        level = carried[row] + step * opposing / (max(speed, 1e-12) * slow)
        j = jacobian[row]
        for i in range(3):
            load[row, i] -= share * (j[0, i] * x + j[1, i] * y) + j[2, i] * z
            for k in range(3):
                inertia[row, i, k] += level * (j[0, i] * j[0, k] + j[1, i] * j[1, k])
                inertia[row, i, k] += carried[row] * (j[2, i] * j[2, k])
    return inertia, load


@kept
def ways_in_world(
    before: FloatArray,
    position: FloatArray,
    points: FloatArray,
    turn: FloatArray,
    origin: FloatArray,
) -> FloatArray:
    """Join P before the last time step, now, and after each time step to come, in the world.

    Args:
        before: (n, 3) m, machine's frame, as all of them.
        position: (n, 3) m.
        points: (n, K, 3) m.
        turn: (3,) factors of the machine's frame.
        origin: (3,) m.

    Returns:
        (n, K + 2, 3) m.
    """
    count, steps = points.shape[:2]
    ways = np.empty((count, steps + 2, 3))
    for row in range(count):
        for axis in range(3):
            factor, start = turn[axis], origin[axis]
            ways[row, 0, axis] = factor * before[row, axis] + start
            ways[row, 1, axis] = factor * position[row, axis] + start
            for k in range(steps):
                ways[row, k + 2, axis] = factor * points[row, k, axis] + start
    return ways
