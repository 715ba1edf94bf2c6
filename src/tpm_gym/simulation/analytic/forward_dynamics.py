"""Motion from torques: joint velocities first, then joint positions, time step by time step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.analytic.steps import (
    driven_by_torque,
    driven_ideally,
    felt,
    modes_left,
    moved,
)
from tpm_gym.simulation.drives import References, ServoDrives

__all__ = ["Course", "IdealSteps", "ServoSteps", "Steps", "march"]


@dataclass
class Course:
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

    def move(
        self, index: int, course: Course, mass: FloatArray, load: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return joint velocities (r, 3) at the end of a time step, and torques (r, 3)."""


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

    def move(
        self, index: int, course: Course, mass: FloatArray, load: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """See the protocol."""
        rates, torque = np.empty((2, *load.shape))
        self._behind[0] = self._behind[1]
        driven_ideally(
            self._references[index], self._effort, course.theta, course.rates, mass, load,
            self._step, rates, torque, self._behind[1],
        )  # fmt: skip
        return rates, torque

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

    def move(
        self, index: int, course: Course, mass: FloatArray, load: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """See the protocol."""
        torque = self._drives.torque(self._references, index, course.theta, course.rates).copy()
        rates = np.empty_like(torque)
        driven_by_torque(torque, self._drives.friction, course.rates, mass, load, self._step, rates)
        return rates, torque


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
) -> FloatArray:
    """Run ``count`` time steps of some machines by forward dynamics.

    A machine that leaves its modes stays where it was before.

    Args:
        machine: The nominal machine.
        built: (r, k) parameters of the true machines; None for nominal ones.
        steps: The drives.
        count: K.
        course: Where the machines are; advanced.
        step: s.
        touch: Lets objects and cups act.

    Returns:
        Torques (K, r, 3) N m.
    """
    torques = np.empty((count, *course.theta.shape))
    at = machine.motion(course.theta, course.rates, built)
    for index in range(count):
        travel = course.position - course.before
        mass, load = felt(at.mass, at.bias, at.jacobian, course.force, course.carried, travel, step)
        rates, torque = steps.move(index, course, mass, load)
        theta, expected, drifting, gain = moved(
            course.theta, course.rates, rates, course.position, course.before, at.jacobian, step
        )
        at = machine.motion(theta, rates, built)
        side = machine.same_side(expected) & machine.same_side(drifting)
        mode_left, anywhere = modes_left(at.position, side, at.working, course.mode_left)
        new = theta, rates, torque, at.position, gain
        if anywhere:
            gone = (mode_left != 0)[:, None]
            old = course.theta, course.rates, course.torque, course.position, np.zeros_like(gain)
            new = tuple(np.where(gone, *pair) for pair in zip(old, new, strict=True))  # type: ignore[assignment]
            at = machine.motion(new[0], new[1], built)
        push, carried = touch(course.before, course.position, new[3])
        course.before, course.mode_left, course.carried = course.position, mode_left, carried
        course.theta, course.rates, course.torque, course.position, gain = new
        course.force = push + carried[:, None] * gain
        torques[index] = course.torque
    return torques
