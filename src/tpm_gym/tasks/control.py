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
from tpm_gym.errors import ConfigurationError
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
        """Compute the next commands (..., 3) for arrays of both."""

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
        """Compute the next command; see :meth:`command`."""
        return _vector(self.command(action, current))

    def command(self, action: ArrayLike, current: ArrayLike) -> FloatArray:
        """Compute P (..., 3) after the (slowed down) increment of the joints, within the region."""
        start, limit, forward = np.asarray(current), self._step, self._machine.forward
        theta = self._machine.inverse(start)
        step = np.asarray(action) * self._machine.joint_limit
        # By J, this fraction of the step uses the limit up; the exact one is near.
        rate = np.abs(np.einsum("...ij,...j->...i", self._machine.evaluate(theta).jacobian, step))
        linear = (limit / np.maximum(rate, 1e-12)).min(axis=-1, keepdims=True)
        low, high = np.zeros_like(linear), np.minimum(1.0, 2 * linear)
        whole = forward(theta + high * step)
        fits = (np.abs(whole - start) <= limit).all(axis=-1, keepdims=True)
        point = np.where(fits, whole, start)
        for _ in range(0 if fits.all() else _BISECTIONS):
            middle = (low + high) / 2
            tried = forward(theta + middle * step)
            allowed = (np.abs(tried - start) <= limit).all(axis=-1, keepdims=True)
            low, high = np.where(allowed, middle, low), np.where(allowed, high, middle)
            point = np.where(allowed & ~fits, tried, point)
        return self._machine.region.project(point)

    def action(self, wanted: ArrayLike, current: ArrayLike) -> FloatArray:
        """The increment of the joints, scaled down as a whole where it is too large."""
        there, here = self._machine.require_inverse(np.array([wanted, current]))
        step: FloatArray = np.subtract(there, here) / self._machine.joint_limit
        return step / max(1.0, float(np.abs(step).max()))

    def steps(self, wanted: ArrayLike, current: ArrayLike) -> float:
        """By the axis, or the joint where it turns fastest, that has farthest to go.

        What lies beyond the region is projected into it, as commands are.
        """
        parts = np.linspace(0.0, 1.0, _PARTS + 1)[:, None]
        way = np.asarray(current) + parts * np.subtract(wanted, current)
        theta = self._machine.require_inverse(self._machine.region.project(way))
        turns = np.diff(theta, axis=0) * _PARTS
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
