"""From an action to the next command for point P, and back.

Both kinds of control end in a Cartesian command inside the machine's region, at most its step limit
away from the last one, so that the simulation never sees a target that it cannot follow. Everything
is in the machine's frame.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.errors import ConfigurationError, UnreachableError
from tpm_gym.mechanism.machine import Machine

__all__ = ["CartesianControl", "Control", "JointControl", "make_control"]

_BISECTIONS = 10  # the fraction of a step to a thousandth
_PARTS = 32  # of a way, in which joints turn nearly evenly


class Control(Protocol):
    """What an environment asks of its kind of control; commands are point P in m.

    Attributes:
        name: What the environment's option calls it.
    """

    name: str

    def next(self, action: Vector, current: Vector) -> Vector:
        """The next command, for an action in [-1, 1] and the current command."""

    def command(self, action: ArrayLike, current: ArrayLike) -> FloatArray:
        """The same for arrays of both, (3,).

        Or (n, 3), of machines that have a :meth:`~tpm_gym.Machine.batch`.
        """

    def action(self, wanted: ArrayLike, current: ArrayLike) -> FloatArray:
        """The action (3,) in [-1, 1] that moves the command from current towards wanted."""

    def steps(self, wanted: ArrayLike, current: ArrayLike) -> float:
        """Control steps that a straight way at constant speed takes, if no limit is exceeded."""


class CartesianControl:
    """Actions are increments of point P along x, y, z, in units of the machine's step limit."""

    name = "cartesian"

    def __init__(self, machine: Machine) -> None:
        """For one machine."""
        self._region, self._limit = machine.region, machine.step_limit
        self._step = np.array(machine.step_limit)

    def next(self, action: Vector, current: Vector) -> Vector:
        """The current command plus the increment, projected into the region."""
        (a, b, c), (d, e, f), (x, y, z) = action, self._limit, current
        return self._region.nearest((x + a * d, y + b * e, z + c * f))

    def command(self, action: ArrayLike, current: ArrayLike) -> FloatArray:
        """The same for arrays (..., 3)."""
        return self._region.project(np.asarray(current) + np.asarray(action) * self._step)

    def action(self, wanted: ArrayLike, current: ArrayLike) -> FloatArray:
        """The increment that is wanted, clipped axis by axis."""
        step: FloatArray = (np.asarray(wanted) - np.asarray(current)) / self._step
        return np.clip(step, -1.0, 1.0)

    def steps(self, wanted: ArrayLike, current: ArrayLike) -> float:
        """By the axis that has farthest to go."""
        return float((np.abs(np.subtract(wanted, current)) / self._step).max())


class JointControl:
    """Actions are increments of the three joints, in units of the machine's joint limit.

    Where the increment would move P faster than the step limit allows (along y the TPM often would:
    the platform is quick there, and near the singularity very quick) or into a posture that cannot
    be assembled, all three joints are slowed down together; what then still leaves the region is
    projected into it.
    """

    name = "joints"

    def __init__(self, machine: Machine) -> None:
        """For one machine."""
        self._machine, self._step = machine, np.array(machine.step_limit)

    def next(self, action: Vector, current: Vector) -> Vector:
        """Point P after the (slowed down) increment of the joints, projected into the region."""
        joints = self._machine.inverse(current)
        step = np.array(action) * self._machine.joint_limit
        # By J, this fraction of the step uses the limit up; the exact one is near.
        rate = np.abs(np.array(self._machine.evaluate(joints).jacobian) @ step)
        linear = float((self._step / np.maximum(rate, 1e-12)).min())
        low, high = 0.0, min(1.0, 2 * linear)
        turn = _vector(step)
        point = self._allowed(joints, turn, high, current)
        if point is None:
            point = current
            for _ in range(_BISECTIONS):
                middle = (low + high) / 2
                tried = self._allowed(joints, turn, middle, current)
                if tried is None:
                    high = middle
                else:
                    low, point = middle, tried
        return self._machine.region.nearest(point)

    def command(self, action: ArrayLike, current: ArrayLike) -> FloatArray:
        """The same for arrays (..., 3)."""
        actions, start = (np.asarray(a, dtype=np.float64) for a in (action, current))
        if start.ndim == 1:
            return np.array(self.next(_vector(actions), _vector(start)))
        return self._commands(actions, start)

    def _commands(self, actions: FloatArray, current: FloatArray) -> FloatArray:
        """The same for a batch (n, 3)."""
        start, limit = np.ascontiguousarray(current.T), self._step[:, None]
        batch = self._machine.batch(len(current))
        theta = batch.inverse(start)
        step = np.ascontiguousarray(actions.T) * self._machine.joint_limit
        a, b, c = batch.evaluate(theta).jacobian.swapaxes(0, 1)
        rate = np.abs(a * step[0] + b * step[1] + c * step[2])
        linear = (limit / np.maximum(rate, 1e-12)).min(axis=0)
        high = np.minimum(1.0, 2 * linear)
        point = batch.forward(theta + high * step)
        slow = np.nonzero(~(np.abs(point - start) <= limit).all(axis=0))[0]
        if len(slow):
            point[:, slow] = self._slowed(start[:, slow], theta[:, slow], step[:, slow], high[slow])
        return self._machine.region.project(point.T)

    def _slowed(
        self, start: FloatArray, theta: FloatArray, step: FloatArray, high: FloatArray
    ) -> FloatArray:
        """Point P where the joints' step, shortened by bisection, is no more than P's (3, n)."""
        batch, limit = self._machine.batch(start.shape[1]), self._step[:, None]
        low, point = np.zeros_like(high), start
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            tried = batch.forward(theta + middle * step)
            allowed = (np.abs(tried - start) <= limit).all(axis=0)
            low, high = np.where(allowed, middle, low), np.where(allowed, high, middle)
            point = np.where(allowed, tried, point)
        return point

    def _allowed(self, joints: Vector, turn: Vector, share: float, start: Vector) -> Vector | None:
        """Point P that ``share`` of the turn further, if it is in the modes and a step away."""
        a, b, c = joints
        d, e, f = turn
        try:
            x, y, z = self._machine.forward((a + share * d, b + share * e, c + share * f))
        except UnreachableError:
            return None
        # In plain floats: asked up to eleven times in a control step
        (u, v, w), (p, q, r) = start, self._machine.step_limit
        return (x, y, z) if abs(x - u) <= p and abs(y - v) <= q and abs(z - w) <= r else None

    def action(self, wanted: ArrayLike, current: ArrayLike) -> FloatArray:
        """The increment of the joints, scaled down as a whole where it is too large."""
        inverse = self._machine.inverse
        there, here = (inverse(_vector(np.asarray(p))) for p in (wanted, current))
        step: FloatArray = np.subtract(there, here) / self._machine.joint_limit
        return step / max(1.0, float(np.abs(step).max()))

    def steps(self, wanted: ArrayLike, current: ArrayLike) -> float:
        """By the axis, or the joint where it turns fastest, that has farthest to go.

        What lies beyond the region is projected into it, as commands are.
        """
        inverse, project = self._machine.inverse, self._machine.region.project
        parts = np.linspace(0.0, 1.0, _PARTS + 1)[:, None]
        way = np.asarray(current) + parts * np.subtract(wanted, current)
        turns = np.diff([inverse(_vector(project(point))) for point in way], axis=0) * _PARTS
        joints = float(np.abs(turns).max()) / self._machine.joint_limit
        return max(joints, float((np.abs(way[-1] - way[0]) / self._step).max()))


def make_control(kind: str, machine: Machine) -> Control:
    """The control of that name.

    Raises:
        ConfigurationError: If there is none.
    """
    for control in (CartesianControl, JointControl):
        if kind == control.name:
            return control(machine)
    raise ConfigurationError("control", kind, "'cartesian' or 'joints'")


def _vector(array: FloatArray) -> Vector:
    a, b, c = array.tolist()
    return a, b, c
