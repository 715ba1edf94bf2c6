"""Controls: conversion of actions to commands for point P, and back.

Every control computes a Cartesian command inside the machine's region, at most the step limit away
from the last command. So the simulation can follow every command. Arrays have rows first, and are
in the machine's frame.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.engine import loops
from tpm_gym.simulation.state import CONTROL_PERIOD

_TRIES = 6  # largest number of tries to scale a joint step down to the step limit
_AIM = 0.9995  # fraction of the step limit that a try aims at
USABLE = 0.95
"""Share of the peak torque that commands may need; the rest is a reserve for disturbances."""
_PARTS = 32  # parts of a straight line; within a part, joints turn at almost constant speed


class Control(Protocol):
    """Conversion between actions and commands, for n robots.

    Attributes:
        name: Value of the environment's option ``control`` that selects this control.
    """

    name: str

    def command(self, actions: FloatArray, current: FloatArray) -> FloatArray:
        """Return the next commands (n, 3) m, for actions (n, 3) in [-1, 1]."""

    def action(self, wanted: FloatArray, current: FloatArray) -> FloatArray:
        """Return actions (n, 3) that move commands (n, 3) m from current towards wanted."""

    def steps(self, wanted: FloatArray, current: FloatArray) -> float:
        """Return the number of control steps between two points (3,) m at the highest speed."""

    def scaled(self, points: FloatArray) -> FloatArray:
        """Convert points (n, 3) m to coordinates (n, 3) whose differences are actions."""

    def rate(self, points: FloatArray) -> FloatArray:
        """Return the derivatives (n, 3, 3) m of P with respect to the action, at points (n, 3) m.

        Column j belongs to component j of the action.
        """


class CartesianControl:
    """Control whose actions are increments of P along x, y, z, in units of the step limit."""

    name = "cartesian"

    def __init__(self, machine: Machine, period: float = CONTROL_PERIOD) -> None:
        """Store the limits of a machine for a control ``period``, s."""
        self._step = np.array(machine.step_limit) * (period / CONTROL_PERIOD)
        self._low, self._high = np.array(machine.region.low), np.array(machine.region.high)

    def command(self, actions: FloatArray, current: FloatArray) -> FloatArray:
        """Add the increments to the commands, and project the sum into the region."""
        plain = np.ascontiguousarray
        commands: FloatArray = loops().shifted(
            plain(current), plain(actions), self._step, self._low, self._high
        )
        return commands

    def action(self, wanted: FloatArray, current: FloatArray) -> FloatArray:
        """Clip the wanted increment axis by axis."""
        actions: FloatArray = np.clip((wanted - current) / self._step, -1.0, 1.0)
        return actions

    def steps(self, wanted: FloatArray, current: FloatArray) -> float:
        """Return the number of steps that the slowest axis needs."""
        return float((np.abs(wanted - current) / self._step).max())

    def scaled(self, points: FloatArray) -> FloatArray:
        """Divide the points by the step limit."""
        return points / self._step

    def rate(self, points: FloatArray) -> FloatArray:
        """Return for each point the diagonal matrix of the step limits along x, y and z, m."""
        return np.tile(np.diag(self._step), (len(points), 1, 1))


class JointControl:
    """Control whose actions are increments of the three joints.

    An action of 1 moves a joint by the machine's ``joint_limit``, scaled to the control period. The
    increment is scaled down as a whole if it would move P farther than the step limit, or into a
    posture that cannot be assembled. (Many increments exceed the step limit along y, because small
    turns of the joints move P far along y.) A command beyond the region is projected into it.
    """

    name = "joints"

    def __init__(self, machine: Machine, period: float = CONTROL_PERIOD) -> None:
        """Store the limits of a machine for a control ``period``, s."""
        share = period / CONTROL_PERIOD
        self._machine, self._step = machine, np.array(machine.step_limit) * share
        self._turn = machine.joint_limit * share

    def command(self, actions: FloatArray, current: FloatArray) -> FloatArray:
        """Move P by the joints' increment, scaled down where necessary."""
        machine = self._machine
        theta = machine.inverse(current)
        step = actions * self._turn
        # The first try is twice the share that reaches the limit according to the Jacobian J.
        rate = np.abs((machine.evaluate(theta).jacobian * step[:, None]).sum(axis=-1))
        share = np.minimum(1.0, 2 * (self._step / np.maximum(rate, 1e-12)).min(axis=-1))
        point, excess = self._tried(current, theta, step, share)
        slow = np.flatnonzero(~(excess <= 1.0))
        if len(slow):
            part = current[slow], theta[slow], step[slow]
            point[slow] = self._slowed(*part, share[slow], excess[slow])
        return machine.region.project(point)

    def _tried(
        self, current: FloatArray, theta: FloatArray, step: FloatArray, share: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return P (r, 3) m after a share (r,) of the increment, and the size (r,) of P's motion.

        The size is the largest displacement along x, y or z, in units of the step limit. It is
        infinite where the machine cannot be assembled in its modes.
        """
        point = self._machine.forward(theta + share[:, None] * step)
        way = (np.abs(point - current) / self._step).max(axis=-1)
        return point, np.where(np.isnan(way), np.inf, way)

    def _slowed(
        self,
        current: FloatArray,
        theta: FloatArray,
        step: FloatArray,
        share: FloatArray,
        excess: FloatArray,
    ) -> FloatArray:
        """Shorten the increment so that P moves by almost the step limit; return P (r, 3) m.

        ``excess`` is P's displacement at ``share``, in units of the step limit. The secant through
        two tries gives the next try. (If every try only divided ``share`` by ``excess``, the search
        would converge slowly next to the serial singularity, where the displacement is not
        proportional to the share.) Next to a parallel singularity, it can happen that all tries
        exceed the limit; P then stays where it is.
        """
        point, low, high = current, np.zeros_like(share), share
        before, was = np.zeros_like(share), np.zeros_like(share)
        for _ in range(_TRIES):
            with np.errstate(invalid="ignore", divide="ignore"):
                secant = share + (_AIM - excess) * (share - before) / (excess - was)
            before, was = share, excess
            between = (secant > low) & (secant < high)
            share = np.where(between, secant, (low + high) / 2)
            tried, excess = self._tried(current, theta, step, share)
            fits = excess <= 1.0
            point = np.where(fits[:, None], tried, point)
            low, high = np.where(fits, share, low), np.where(fits, high, share)
        return point

    def action(self, wanted: FloatArray, current: FloatArray) -> FloatArray:
        """Return the joints' increment, scaled down as a whole where it is too large."""
        there, here = self._machine.require_inverse(np.stack([wanted, current]))
        step = (there - here) / self._turn
        largest = np.maximum(1.0, np.abs(step).max(axis=-1, keepdims=True))
        action: FloatArray = step / largest
        return action

    def steps(self, wanted: FloatArray, current: FloatArray) -> float:
        """Return the number of steps that the slowest axis or joint needs."""
        parts = np.linspace(0.0, 1.0, _PARTS + 1)[:, None]
        way = current + parts * (wanted - current)
        theta = self._machine.require_inverse(self._machine.region.project(way))
        turns = np.abs(np.diff(theta, axis=0)).max() * _PARTS
        axes = (np.abs(wanted - current) / self._step).max()
        return float(max(turns / self._turn, axes))

    def scaled(self, points: FloatArray) -> FloatArray:
        """Compute the joint positions, divided by the joint increment of an action of 1."""
        places: FloatArray = self._machine.inverse(points) / self._turn
        return places

    def rate(self, points: FloatArray) -> FloatArray:
        """Compute J, multiplied by the joint increment of an action of 1."""
        theta = self._machine.inverse(points)
        rate: FloatArray = self._machine.evaluate(theta).jacobian * self._turn
        return rate


class Follower:
    """Limiter of commands, so that the motors can follow them; it uses closed-form dynamics.

    A step is the difference of two successive commands. The change from one step to the next is
    limited along each axis. The step itself is limited so that P can stop at an end of the region.
    Then the change is scaled down as a whole until the nominal machine needs at most the share
    :data:`USABLE` of its motors' peak torques.

    Args:
        machine: Machine. The torques include its payload.
        acceleration: (3,) m/s^2, largest acceleration of the command along each axis.
        braking: (3,) m/s^2, deceleration with which commands stop at an end of the region.
        period: Control period, s.
    """

    def __init__(
        self, machine: Machine, acceleration: ArrayLike, braking: ArrayLike, period: float
    ) -> None:
        """Compute the limits of a machine in a control period."""
        self._machine, self._period = machine, period
        self._change, self._brake = (np.array(rate) * period**2 for rate in (acceleration, braking))
        self._low, self._high = np.array(machine.region.low), np.array(machine.region.high)
        self._most = USABLE * np.array([motor.effort for motor in machine.mechanism.motors])

    def limit(self, wanted: FloatArray, current: FloatArray, before: FloatArray) -> FloatArray:
        """Return commands (n, 3) m close to ``wanted`` that the motors can follow.

        Args:
            wanted: (n, 3) m, the next commands, before they are limited.
            current: (n, 3) m, the last commands.
            before: (n, 3) m, the commands before ``current``.
        """
        last, change, brake = current - before, self._change, self._brake
        step = np.clip(wanted - current, last - change, last + change)
        # A command that slows down by b in each step moves v + (v - b) + ... = v^2 / (2 b) + v / 2.
        down, up = (
            np.sqrt(brake**2 / 4 + 2 * brake * np.maximum(room, 0.0)) - brake / 2
            for room in (current - self._low, self._high - current)
        )
        step = np.clip(step, -down, up)
        straight = np.clip(current + last, self._low, self._high)
        asked = np.clip(current + step, self._low, self._high)
        steady, most = self._torques(before, current, np.stack([straight, asked]))
        # Torques are nearly linear in the change of the step; NaN where nothing changes.
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(most > steady, self._most - steady, self._most + steady)
            share = np.nanmin(room / np.abs(most - steady), axis=-1, initial=1.0)
        commands: FloatArray = straight + np.maximum(share, 0.0)[:, None] * (asked - straight)
        return commands

    def feasible(self, before: FloatArray, current: FloatArray, then: FloatArray) -> BoolArray:
        """Return an array (n,): whether the motors' peak torques suffice in the middle of a path.

        The control points of the path are the commands ``before``, ``current`` and ``then``, each
        (n, 3) m.
        """
        (torques,) = np.abs(self._torques(before, current, then[None]))
        enough: BoolArray = (torques <= self._most / USABLE).all(axis=-1)
        return enough

    def _torques(self, before: FloatArray, current: FloatArray, then: FloatArray) -> FloatArray:
        """Return the torques (k, n, 3) N m in the middle of the path of three commands.

        ``before`` and ``current`` (n, 3) m are the first two commands. ``then`` (k, n, 3) m has k
        alternatives for the third command.
        """
        middle = (before + 6 * current + then) / 8
        ends = np.broadcast_to((before + current) / 2, then.shape), (current + then) / 2
        first, now, last = self._machine.inverse(np.stack([ends[0], middle, ends[1]]))
        rates, changes = (last - first) / self._period, first - 2 * now + last
        return self._machine.torque(now, rates, changes / (self._period / 2) ** 2)


def make_control(kind: str, machine: Machine, period: float = CONTROL_PERIOD) -> Control:
    """Make the control named ``kind``, for a control period in s.

    Raises:
        ConfigurationError: If no control has this name.
    """
    for control in (CartesianControl, JointControl):
        if kind == control.name:
            return control(machine, period)
    raise ConfigurationError("control", kind, "'cartesian' or 'joints'")
