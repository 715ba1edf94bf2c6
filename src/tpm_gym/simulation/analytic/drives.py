"""What motors do in a time step where motion follows from torques, for many machines at a time.

All of it is elementwise. Inertias are the upper triangles of symmetric matrices, (6, r).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Protocol

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray, IntArray
from tpm_gym.mechanism.dynamics import SYMMETRIC, solve
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.analytic.columns import Batch
from tpm_gym.simulation.drives import Gains, Memory, Reference, Servo, wanted
from tpm_gym.simulation.randomisation import NOMINAL, Plant

__all__ = ["Drive", "IdealDrives", "ServoDrives", "limited", "resisted"]

_SIGNS = np.array(list(product((0.0, 1.0, -1.0), repeat=3))).T[:, :, None]  # (3, 27, 1)


class Drive(Protocol):
    """Three motors on each of r machines, over a control period."""

    def step(
        self,
        reference: Reference,
        theta: FloatArray,
        theta_dot: FloatArray,
        mass: FloatArray,
        load: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Run a time step: mass theta_ddot = torque - load.

        Args:
            reference: Where to, columns (3, r).
            theta: At its beginning, (3, r) rad.
            theta_dot: The same, rad/s.
            mass: (6, r) kg m^2.
            load: (3, r) N m.

        Returns:
            Rates at its end (3, r) rad/s, and what the motors applied (3, r) N m.
        """


class IdealDrives:
    """Motors that take out all of their error in a time step, as far as their effort allows.

    Args:
        effort: (3, r) N m.
        time_step: s.

    Attributes:
        behind: (2, r) which machines had a motor at its limit in the last two time steps.
    """

    def __init__(self, effort: FloatArray, time_step: float) -> None:
        """Be where they shall be."""
        self._effort, self._step = effort, time_step
        self.behind: BoolArray = np.zeros((2, effort.shape[1]), dtype=np.bool_)

    def step(
        self,
        reference: Reference,
        theta: FloatArray,
        theta_dot: FloatArray,
        mass: FloatArray,
        load: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """See the protocol."""
        step = self._step
        goal = (np.stack(reference.theta) - theta) / step
        drive = _times(mass, theta_dot - goal) - step * load
        short = resisted(mass, drive, step * self._effort)
        self.behind = np.stack([self.behind[1], (short != 0).any(axis=0)])
        return goal + short, (_times(mass, short) - drive) / step


class ServoDrives:
    """What :class:`~tpm_gym.simulation.drives.Servos` are, on each of n machines.

    Args:
        law: Stiffness, damping, feed-forward.
        machine: The nominal machine.
        memory: (2, 3, n) torques and rates of the last time step, which are kept there.
        time_step: s.

    Attributes:
        law: See above.
    """

    def __init__(self, law: Servo, machine: Machine, memory: FloatArray, time_step: float) -> None:
        """Be the nominal drives, the machines at rest at home."""
        count = memory.shape[2]
        self.law, self._memory, self._step = law, memory, time_step
        self._machine, self._model = machine, Batch(machine, count)
        motors = machine.mechanism.motors
        self._speed = np.array([[motor.speed] for motor in motors])
        self._corner = np.array([[motor.corner] for motor in motors])
        self._nominal_effort = np.array([[motor.effort] for motor in motors])
        self._stiffness, self._effort, self._friction = np.zeros((3, 3, count))
        self._lightest = np.ones(count)
        home = np.repeat(np.array([machine.inverse(machine.home)]).T, count, axis=1)
        rows = np.arange(count)
        self.alter(rows, [()] * count, [NOMINAL] * count)
        self.rest(rows, home)

    def alter(
        self, rows: IntArray, lengths: Sequence[tuple[float, ...]], plants: Sequence[Plant]
    ) -> None:
        """Become the drives of some plants, the machines of which have these lengths (m)."""
        self._model.build(rows, lengths, [()] * len(rows))
        factors = np.array([p.servo_stiffness for p in plants]).T
        self._stiffness[:, rows] = self.law.stiffness * factors
        strength = np.array([p.motor_strength for p in plants]).T
        self._effort[:, rows] = self._nominal_effort * strength
        self._friction[:, rows] = np.array([p.joint_friction for p in plants]).T
        self._lightest[rows] = [min(p.link_masses, default=1.0) for p in plants]

    def rest(self, rows: IntArray, theta: FloatArray) -> None:
        """Start at rest at ``theta`` (3, r) rad, with what carries the machines there."""
        still = np.zeros_like(theta)
        self._memory[0][:, rows] = self._model.take(rows).motion(theta, still).bias
        self._memory[1][:, rows] = 0.0

    def begin(self, theta: FloatArray) -> None:
        """Take up the inertia at ``theta`` (3, n) rad, for a control period."""
        step, damping = self._step, self.law.damping
        mass = self._lightest * self._inertia(theta)
        braced = mass.copy()
        braced[[0, 3, 5]] += step * (step * self._stiffness + damping)
        units = np.eye(3)[:, :, None]
        inverse = [np.stack(np.broadcast_arrays(*solve(tuple(braced), u))) for u in units]
        a, b, c = self._stiffness
        self._gains = Gains((a, b, c), damping, mass[SYMMETRIC], inverse, step)

    def _inertia(self, theta: FloatArray) -> FloatArray:
        """(6, n) kg m^2; that at home where a machine, its lengths being off, cannot be there."""
        still = np.zeros_like(theta)
        position, _, _, mass, _ = self._model.motion(theta, still)
        lost = np.flatnonzero(~np.isfinite(position + mass[:3] + mass[3:]).all(axis=0))
        if len(lost):
            home = np.array([self._machine.inverse(self._machine.home)]).T
            away = np.repeat(home, len(lost), axis=1)
            mass[:, lost] = self._model.take(lost).motion(away, still[:, lost]).mass
        return mass

    def step(
        self,
        reference: Reference,
        theta: FloatArray,
        theta_dot: FloatArray,
        mass: FloatArray,
        load: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """See the protocol."""
        step, columns = self._step, _triple(theta_dot)
        memory = Memory(_triple(self._memory[0]), _triple(self._memory[1]))
        asked = np.stack(wanted(self._gains, memory, reference, _triple(theta), columns))
        torque = limited(asked, theta_dot, self._effort, self._speed, self._corner)
        self._memory[:] = torque, theta_dot
        drive = _times(mass, theta_dot) + step * (torque - load)
        if not self._friction.any():
            return np.stack(solve(tuple(mass), _triple(drive))), torque
        return resisted(mass, drive, step * self._friction), torque


def limited(
    torque: FloatArray, rate: FloatArray, effort: FloatArray, speed: FloatArray, corner: FloatArray
) -> FloatArray:
    """What :func:`tpm_gym.simulation.drives.limited` says, for columns (3, r)."""
    driving = effort * np.minimum(1.0, np.maximum(0.0, (speed - np.abs(rate)) / (speed - corner)))
    high = np.where(rate > 0, driving, effort)
    low = np.where(rate > 0, -effort, -driving)
    return np.minimum(high, np.maximum(low, torque))


def resisted(mass: FloatArray, drive: FloatArray, limit: FloatArray) -> FloatArray:
    """Rates u (3, r) that an impulse ``drive`` gives against what resists them.

    mass u = drive - resistance, which is limit sign(u), and where u is zero anything up to limit.
    That is the least of u mass u / 2 - drive u + limit |u|.

    Args:
        mass: (6, r) kg m^2.
        drive: (3, r) N m s.
        limit: (3, r) N m s, zero or more.
    """
    free = np.stack(solve(tuple(mass), _triple(drive)))
    signs = np.sign(free)
    rates = np.stack(solve(tuple(mass), _triple(drive - limit * signs)))
    other = np.flatnonzero(~(rates * signs > 0).all(axis=0))
    if len(other):
        rates[:, other] = _least(mass[:, other], drive[:, other], limit[:, other])
    return rates


def _least(mass: FloatArray, drive: FloatArray, limit: FloatArray) -> FloatArray:
    """The same by trying all 27 ways in which three rates are zero or have a sign."""
    (m1, m2, m3), drive, limit = np.abs(_SIGNS), drive[:, None], limit[:, None]
    a, b, c, d, e, f = mass[:, None]
    # What stands still takes no part.
    matrix = (
        a * m1 + 1 - m1,
        b * m1 * m2,
        c * m1 * m3,
        d * m2 + 1 - m2,
        e * m2 * m3,
        f * m3 + 1 - m3,
    )
    right = (drive - limit * _SIGNS) * np.abs(_SIGNS)
    rates = np.stack(solve(matrix, _triple(right)))
    cost = (rates * (_times(mass[:, None], rates) / 2 - drive) + limit * np.abs(rates)).sum(axis=0)
    best = np.argmin(cost, axis=0)
    found: FloatArray = np.take_along_axis(rates, best[None, None], axis=1)[:, 0]
    return found


def _times(mass: FloatArray, column: FloatArray) -> FloatArray:
    """A symmetric matrix times a column."""
    (a, b, c, d, e, f), (x, y, z) = mass, column
    return np.stack([a * x + b * y + c * z, b * x + d * y + e * z, c * x + e * y + f * z])


def _triple(array: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    one, two, three = array
    return one, two, three
