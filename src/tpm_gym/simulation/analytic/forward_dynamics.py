"""Forward dynamics with semi-implicit time steps: joint velocities first, then joint positions."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.mechanism.machine import Machine, Motion
from tpm_gym.simulation.analytic.steps import ideal_push, ideal_step, modes_left, servo_step
from tpm_gym.simulation.drives import References, ServoDrives


class Course(NamedTuple):
    """State of r robots at the end of a time step; machine's frame.

    Attributes:
        theta: (r, 3) rad, joint positions.
        rates: (r, 3) rad/s, joint velocities.
        torque: (r, 3) N m, torques of the motors.
        position: (r, 3) m, point P.
        before: (r, 3) m, point P a time step earlier.
        force: (r, 3) N, force of objects on P without the inertial force of the carried mass.
        carried: (r,) kg, mass of the held object.
        mode_left: (r,) mode that was left, coded as in :meth:`tpm_gym.Machine.mode_left`.
    """

    theta: FloatArray
    rates: FloatArray
    torque: FloatArray
    position: FloatArray
    before: FloatArray
    force: FloatArray
    carried: FloatArray
    mode_left: NDArray[np.int8]


class IdealSteps:
    """Ideal drives with limited torques.

    Args:
        references: (K, r, 3) rad, joint positions at the ends of the time steps.
        effort: (r, 3) N m, largest torques.
        step: Time step, s.
    """

    def __init__(self, references: FloatArray, effort: FloatArray, step: float) -> None:
        """Store the arguments; no motor has been at its limit yet."""
        self._references, self._effort, self.step = references, effort, step
        self._behind = np.zeros((2, len(effort)), dtype=np.bool_)

    def move(self, index: int, course: Course, at: Motion, new: tuple[FloatArray, ...]) -> None:
        """Compute a time step; arguments as in :func:`ideal_step`."""
        ideal_step(
            index, self._references, self._effort, course[:-1], at, self.step, new, self._behind
        )

    def push(
        self, index: int, theta: FloatArray, rates: FloatArray, inverse: FloatArray
    ) -> FloatArray:
        """Find the torques (r, 3) N m of a time step; arguments as in :func:`ideal_push`."""
        torque = np.empty_like(theta)
        references, effort, step = self._references, self._effort, self.step
        ideal_push(index, references, effort, theta, rates, inverse, step, torque, self._behind)
        return torque

    @property
    def behind(self) -> BoolArray:
        """Whether a motor was at its limit in one of the last two time steps, (r,)."""
        behind: BoolArray = self._behind[0] | self._behind[1]
        return behind


class ServoSteps:
    """Servo drives: :class:`tpm_gym.simulation.drives.ServoDrives` in forward dynamics."""

    def __init__(self, drives: ServoDrives, references: References, step: float) -> None:
        """Store the arguments, and begin the control period of ``drives``."""
        self._drives, self._references, self._step = drives, references, step
        drives.begin(references.theta[0])

    def move(self, index: int, course: Course, at: Motion, new: tuple[FloatArray, ...]) -> None:
        """Compute a time step; arguments as in :func:`servo_step`."""
        drives = self._drives
        servo_step(
            index, self._references, drives.law, drives.friction, course[:-1], at, self._step, new,
            drives.memory,
        )  # fmt: skip


Touch = Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""Function that moves objects and cups by one time step.

The arguments are three positions of P, each (r, 3) m: at the beginning of the previous time step,
at the beginning of this time step, and at the end of this time step. The function returns the force
(r, 3) N of objects on P and the mass (r,) kg of the held objects.
"""


def march(
    machine: Machine,
    built: FloatArray | None,
    steps: IdealSteps | ServoSteps,
    count: int,
    course: Course,
    touch: Touch,
) -> tuple[Course, FloatArray]:
    """Compute ``count`` time steps of r robots by forward dynamics.

    A robot that leaves its assembly or working mode stays at its last valid state.

    Args:
        machine: Nominal machine.
        built: (r, k) parameters of the true machines; None for nominal machines.
        steps: Drives of the robots.
        count: Number of time steps, K.
        course: State of the robots at the beginning.
        touch: Function that moves objects and cups, and returns forces on P and carried masses.

    Returns:
        State of the robots at the end, and the torques (K, r, 3) N m in all time steps.
    """
    torques = np.empty((count, *course.theta.shape))
    at = machine.motion(course.theta, course.rates, built)
    for index in range(count):
        theta, rates, gain = np.empty((3, *course.theta.shape))
        torque, ahead = torques[index], np.empty((2, *theta.shape))
        steps.move(index, course, at, (theta, rates, torque, ahead, gain))
        at = machine.motion(theta, rates, built)
        mode_left, anywhere = modes_left(
            at.position, machine.same_side(ahead), at.working, course.mode_left
        )
        position = at.position
        if anywhere:
            gone, position = mode_left != 0, position.copy()
            for new, old in zip((theta, rates, torque, position), course[:4], strict=True):
                new[gone] = old[gone]
            gain[gone] = 0.0
            at = machine.motion(theta, rates, built)
        force, carried = touch(course.before, course.position, position)
        if carried.any():
            force += gain * carried[:, None]
        course = Course(theta, rates, torque, position, course.position, force, carried, mode_left)
    return course, torques
