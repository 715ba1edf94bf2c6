"""From an action to the next command for point P, and back.

Both kinds of control end in a Cartesian command inside :data:`~tpm_gym.workspace.TASK_REGION`, at
most :data:`STEP_LIMIT` away from the last one, so that the simulation never sees a target that it
cannot follow. Everything is in the paper frame.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics import DEFAULT_ASSEMBLY, ForwardSolutions, forward_all, inverse
from tpm_gym.workspace import TASK_REGION

__all__ = ["JOINT_LIMIT", "STEP_LIMIT", "CartesianControl", "Control", "JointControl", "make"]

FloatArray = NDArray[np.float64]

STEP_LIMIT = np.array([0.030, 0.005, 0.030])
"""Largest change of the command for P along x, y, z in one control step, m."""
STEP_LIMIT.setflags(write=False)

JOINT_LIMIT = 0.08
"""Largest change of a joint's command in one control step, rad."""


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
        point = start
        low, high = 0.0, 1.0
        # The largest allowed fraction of the step, to 1/64 and then to 1/4096 of it.
        for _ in range(2):
            fractions = np.linspace(low, high, 65)[1:]
            solutions = forward_all(theta + fractions[:, None] * step)
            points = solutions.position[:, DEFAULT_ASSEMBLY.index]
            allowed = self._allowed(solutions, start)
            count = len(fractions) if allowed.all() else int(allowed.argmin())
            if count:
                point = points[count - 1]
            if count == len(fractions):
                break
            low, high = (fractions[count - 1] if count else low), fractions[count]
        return TASK_REGION.project(point)

    def _allowed(self, solutions: ForwardSolutions, start: FloatArray) -> NDArray[np.bool_]:
        """Whether postures are assembled as ``start`` is, with P no farther than STEP_LIMIT."""
        slot = DEFAULT_ASSEMBLY.index
        moved = np.abs(solutions.position[:, slot] - start) <= STEP_LIMIT
        same_mode = np.abs(solutions.beta[:, slot]) < np.pi / 2  # cos(beta) > 0; NaN compares false
        allowed: NDArray[np.bool_] = moved.all(axis=-1) & same_mode
        return allowed

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
