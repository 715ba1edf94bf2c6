"""From an action to the next command for point P, and back.

Both kinds of control end in a Cartesian command inside :data:`~tpm_gym.kinematics.workspace.TASK_REGION`, at
most :data:`STEP_LIMIT` away from the last one, so that the simulation never sees a target that it
cannot follow. Everything is in the paper frame.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.errors import ConfigurationError, UnreachableError
from tpm_gym.kinematics import DEFAULT_ASSEMBLY, equations, inverse, jacobian
from tpm_gym.kinematics.geometry import PAPER
from tpm_gym.kinematics.workspace import TASK_REGION

__all__ = ["JOINT_LIMIT", "STEP_LIMIT", "CartesianControl", "Control", "JointControl", "make"]

FloatArray = NDArray[np.float64]

STEP_LIMIT = np.array([0.030, 0.005, 0.030])
"""Largest change of the command for P along x, y, z in one control step, m."""
STEP_LIMIT.setflags(write=False)

JOINT_LIMIT = 0.08
"""Largest change of a joint's command in one control step, rad."""
_BISECTIONS = 10  # the fraction of a step to a thousandth


class Control(Protocol):
    """What an environment asks of its kind of control; commands are point P in m."""

    def command(self, action: ArrayLike, current: ArrayLike) -> FloatArray:
        """The next command (3,), for an action (3,) in [-1, 1] and the current command (3,)."""

    def action(self, wanted: ArrayLike, current: ArrayLike) -> FloatArray:
        """The action (3,) in [-1, 1] that moves the command from current towards wanted."""


class CartesianControl:
    """Actions are increments of point P along x, y, z, in units of STEP_LIMIT."""

    def command(self, action: ArrayLike, current: ArrayLike) -> FloatArray:
        """The current command plus the increment, projected into the region."""
        return TASK_REGION.project(np.asarray(current) + np.asarray(action) * STEP_LIMIT)

    def action(self, wanted: ArrayLike, current: ArrayLike) -> FloatArray:
        """The increment that is wanted, clipped axis by axis."""
        step: FloatArray = (np.asarray(wanted) - np.asarray(current)) / STEP_LIMIT
        return np.clip(step, -1.0, 1.0)


class JointControl:
    """Actions are increments of the three actuated angles, in units of JOINT_LIMIT.

    Where the increment would move P faster than STEP_LIMIT allows (along y it often would: the
    platform is quick there, and near the singularity very quick) or into a posture that cannot be
    assembled, all three joints are slowed down together; what then still leaves the region is
    projected into it.
    """

    def command(self, action: ArrayLike, current: ArrayLike) -> FloatArray:
        """Point P after the (slowed down) increment of the joints, projected into the region."""
        start = np.asarray(current, dtype=np.float64)
        theta = inverse(start)
        step = np.asarray(action, dtype=np.float64) * JOINT_LIMIT
        # By J, this fraction of the step uses the limit up; the exact one is near.
        rate = np.abs(jacobian.evaluate(theta).velocity @ step)
        linear = float((STEP_LIMIT / np.maximum(rate, 1e-12)).min())
        low, high = 0.0, min(1.0, 2 * linear)
        point = self._allowed(theta + high * step, start)
        if point is None:
            point = start
            for _ in range(_BISECTIONS):
                middle = (low + high) / 2
                tried = self._allowed(theta + middle * step, start)
                if tried is None:
                    high = middle
                else:
                    low, point = middle, tried
        return TASK_REGION.project(point)

    def _allowed(self, theta: FloatArray, start: FloatArray) -> FloatArray | None:
        """Point P at ``theta``, if it is assembled as at ``start`` and within STEP_LIMIT of it."""
        a, b, c = theta.tolist()
        try:
            there = equations.assemble((a, b, c), DEFAULT_ASSEMBLY, PAPER)
        except UnreachableError:
            return None
        point = np.array(there[:3])
        near = bool((np.abs(point - start) <= STEP_LIMIT).all())
        return point if near and there.cos_beta > 0 else None

    def action(self, wanted: ArrayLike, current: ArrayLike) -> FloatArray:
        """The increment of the joints, scaled down as a whole where it is too large."""
        step: FloatArray = (inverse(wanted) - inverse(current)) / JOINT_LIMIT
        return step / max(1.0, float(np.abs(step).max()))


def make(kind: str) -> Control:
    """The control of that name.

    Raises:
        ConfigurationError: If there is none.
    """
    kinds: dict[str, type[Control]] = {"cartesian": CartesianControl, "joints": JointControl}
    if kind not in kinds:
        raise ConfigurationError("control", kind, ", ".join(map(repr, kinds)))
    return kinds[kind]()
