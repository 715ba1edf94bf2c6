"""Motion from torques: joint velocities first, then joint positions, time step by time step."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.mechanism.machine import Machine, Motion
from tpm_gym.simulation.analytic.steps import ideal_step, modes_left, servo_step
from tpm_gym.simulation.drives import References, ServoDrives

__all__ = ["Course", "IdealSteps", "ServoSteps", "Steps", "march"]


class Course(NamedTuple):
    """States of r machines at the end of a time step; machine's frame.

    Attributes:
        theta: (r, 3) rad.
        rates: (r, 3) rad/s.
        torque: (r, 3) N m, applied by the motors.
        position: (r, 3) m, point P.
        before: (r, 3) m, point P a time step earlier.
        force: (r, 3) N, of objects on P, less what accelerates the carried mass.
        carried: (r,) kg, moving with P.
        mode_left: (r,) as :meth:`tpm_gym.Machine.mode_left` codes it.
    """

    theta: FloatArray
    rates: FloatArray
    torque: FloatArray
    position: FloatArray
    before: FloatArray
    force: FloatArray
    carried: FloatArray
    mode_left: NDArray[np.int8]


class Steps(Protocol):
    """Drives of r machines over a control period."""

    def move(self, index: int, course: Course, at: Motion, new: tuple[FloatArray, ...]) -> None:
        """Run a time step; see :func:`tpm_gym.simulation.analytic.steps.servo_step`."""


class IdealSteps:
    """Ideal drives, whose effort is limited.

    Args:
        references: (K, r, 3) rad.
        effort: (r, 3) N m.
        step: s.

    Attributes:
        behind: (r,) whether a motor was at its limit in one of the last two time steps.
    """

    def __init__(self, references: FloatArray, effort: FloatArray, step: float) -> None:
        """Start with no motor behind."""
        self._references, self._effort, self._step = references, effort, step
        self._behind = np.zeros((2, len(effort)), dtype=np.bool_)

    def move(self, index: int, course: Course, at: Motion, new: tuple[FloatArray, ...]) -> None:
        """See the protocol."""
        ideal_step(
            index, self._references, self._effort, course[:-1], at, self._step, new, self._behind
        )

    @property
    def behind(self) -> BoolArray:
        """See the class."""
        behind: BoolArray = self._behind[0] | self._behind[1]
        return behind


class ServoSteps:
    """Servo drives; see :class:`tpm_gym.simulation.drives.ServoDrives`."""

    def __init__(self, drives: ServoDrives, references: References, step: float) -> None:
        """Compute the inertia for the control period."""
        self._drives, self._references, self._step = drives, references, step
        drives.begin(references.theta[0])

    def move(self, index: int, course: Course, at: Motion, new: tuple[FloatArray, ...]) -> None:
        """See the protocol."""
        drives = self._drives
        servo_step(
            index, self._references, drives.law, drives.friction, course[:-1], at, self._step, new,
            drives.memory,
        )  # fmt: skip


Touch = Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""Function of P (r, 3) m a time step ago, now and at its end; returns the force (r, 3) N on P
and the mass (r,) kg that moves with it."""


def march(
    machine: Machine,
    built: FloatArray | None,
    steps: Steps,
    count: int,
    course: Course,
    step: float,
    touch: Touch,
) -> tuple[Course, FloatArray]:
    """Run ``count`` time steps of some machines by forward dynamics.

    A machine that leaves its modes stays where it was before.

    Args:
        machine: The nominal machine.
        built: (r, k) parameters of the true machines; None for nominal ones.
        steps: The drives.
        count: K.
        course: Where the machines are.
        step: s.
        touch: Lets objects and cups act.

    Returns:
        Where the machines are then, and the torques (K, r, 3) N m.
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
        force += np.multiply(gain, carried[:, None], out=gain)
        course = Course(theta, rates, torque, position, course.position, force, carried, mode_left)
    return course, torques
