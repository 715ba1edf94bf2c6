"""Forward dynamics of P, for machines that may pass a parallel singularity.

In the plane of the singularity, the inertia M at the motors' axes is infinite. The inertia of P is
finite: it is K^T M K, where K is the inverse Jacobian, theta_dot = K v, and v is the velocity of P.
The inertia of P changes smoothly with the distance from the plane, and is equal on both sides. So
this module integrates v, not the joint velocities. In the plane, the column of K for the direction
normal to the plane is zero. There, the motors cannot accelerate P in this direction, and P keeps
its speed.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import FloatArray
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.analytic.forward_dynamics import Course, IdealSteps, Touch

_LIFT: Final = 5e-5
"""Smallest distance from the plane, m, at which inertia and forces are computed.

Closer to the plane, the values at this distance are used. The values change with the square of the
distance. So the error of this replacement is smaller than the rounding errors of values computed at
the true distance.
"""
_BESIDE: Final = 1e-4
"""Distance, m, from P to a point ahead of it and to a point behind it, on the line of its velocity.

The joint positions at the three points give the second derivative of the joint positions at P.
"""
_COMPLIANCE: Final = 1e-8
"""Compliance of ideal motors, as a fraction of the trace of the inverse inertia at their axes.

In the singular plane y = 0, the inverse inertia is singular. With the compliance, the torques are
unique there too.
"""


class _Dynamics(NamedTuple):
    """Dynamics of P at velocity v: mass dv/dt + bias = rate^T torque, with theta_dot = rate v.

    Attributes:
        rate: Inverse Jacobian K, (r, 3, 3) rad/m.
        inverse: Inverse of the mass, (r, 3, 3) 1/kg.
        bias: Force on P that balances the weight and the velocity-dependent forces, (r, 3) N. With
            this force from the motors, v would stay constant.
    """

    rate: FloatArray
    inverse: FloatArray
    bias: FloatArray


class _Lifted(NamedTuple):
    """Kinematics at points on the same side of the singular plane as the machine's home.

    Attributes:
        points: Points on this side, at least _LIFT away from the plane, (r, 3) m. Points that
            were on the other side have been mirrored.
        side: Factors that mirror a vector in the same way as its point, (r, 3): -1 for the
            component normal to the plane if the point was mirrored, else 1.
        theta: Joint positions at ``points``, (r, 3) rad.
        own_rate: Inverse Jacobian K at ``points``, (r, 3, 3) rad/m.
        rate: Inverse Jacobian K at the original points, (r, 3, 3) rad/m. Its column for the
            direction normal to the plane is proportional to the distance from the plane.
    """

    points: FloatArray
    side: FloatArray
    theta: FloatArray
    own_rate: FloatArray
    rate: FloatArray


def pass_through(
    machine: Machine,
    built: FloatArray | None,
    steps: IdealSteps,
    count: int,
    course: Course,
    touch: Touch,
) -> tuple[Course, FloatArray]:
    """Compute ``count`` time steps of r robots with ideal drives.

    Arguments and results are explained in :func:`.forward_dynamics.march`.
    """
    torques, step = np.empty((count, *course.theta.shape)), steps.step
    speed = (course.position - course.before) / step
    for index in range(count):
        # K in the middle of the time step gives accurate changes of the joint positions.
        at = _dynamics(machine, built, course.position + step / 2 * speed, speed, course.carried)
        free = speed + step * _times(at.inverse, course.force - at.bias)
        inverse = at.rate @ at.inverse @ at.rate.swapaxes(1, 2)
        trace = np.trace(inverse, axis1=1, axis2=2)
        inverse += _COMPLIANCE * trace[:, None, None] * np.eye(3)
        torque = steps.push(index, course.theta, _times(at.rate, free), inverse)
        speed = free + step * _times(at.inverse, _times(at.rate.swapaxes(1, 2), torque))
        position = course.position + step * speed
        theta = machine.inverse(position, built)
        rates = _times(_lifted(machine, built, position).rate, speed)
        mode_left = course.mode_left.copy()
        mode_left[np.isnan(rates).any(axis=1) & (mode_left == 0)] = 1
        gone = mode_left != 0
        for new, old in zip((theta, rates, torque, position), course[:4], strict=True):
            new[gone] = old[gone]
        speed[gone], torques[index] = 0.0, torque
        force, carried = touch(course.before, course.position, position)
        course = Course(theta, rates, torque, position, course.position, force, carried, mode_left)
    return course, torques


def _dynamics(
    machine: Machine,
    built: FloatArray | None,
    position: FloatArray,
    speed: FloatArray,
    carried: FloatArray,
) -> _Dynamics:
    """Compute the dynamics of P at ``position`` and ``speed`` (r, 3), with carried masses (r,)."""
    points, side, theta, own_rate, rate = _lifted(machine, built, position)
    own_speed = side * speed
    length = np.linalg.norm(own_speed, axis=1, keepdims=True)
    beside = _BESIDE * own_speed / np.maximum(length, 1e-12)
    bend = machine.inverse(points + beside, built) + machine.inverse(points - beside, built)
    turning = (bend - 2 * theta) * (length / _BESIDE) ** 2  # d2 theta / dt2 at constant velocity
    motion = machine.motion(theta, _times(own_rate, own_speed), built)
    back = own_rate.swapaxes(1, 2)
    mass = back @ motion.mass @ own_rate * (side[:, :, None] * side[:, None, :])
    mass += carried[:, None, None] * np.eye(3)
    bias = side * _times(back, _times(motion.mass, turning) + motion.bias)
    return _Dynamics(rate, np.linalg.inv(mass), bias)


def _lifted(machine: Machine, built: FloatArray | None, position: FloatArray) -> _Lifted:
    """Compute the kinematics at points on the home's side of the singular plane.

    Points of ``position`` (r, 3) m on the other side are mirrored to the side of the machine's
    home. Points that are nearer to the plane than _LIFT are moved to this distance.
    """
    axis = machine.mirror_axis or 0
    home = np.sign(machine.home[axis])
    points, side, scale = position.copy(), np.ones_like(position), np.ones_like(position)
    side[position[:, axis] * home < 0, axis] = -1.0
    points[:, axis] = home * np.maximum(np.abs(position[:, axis]), _LIFT)
    scale[:, axis] = position[:, axis] / points[:, axis]
    theta = machine.inverse(points, built)
    own_rate: NDArray[Any] = np.linalg.inv(machine.evaluate(theta, built).jacobian)
    return _Lifted(points, side, theta, own_rate, own_rate * scale[:, None])


def _times(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """Multiply matrices (r, 3, 3) and vectors (r, 3)."""
    product: FloatArray = (matrices * vectors[:, None, :]).sum(axis=-1)
    return product
