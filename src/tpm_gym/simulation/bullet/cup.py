"""The vacuum cup: it seals on contact, holds up to a force, and lets go.

The client is handed in (see :mod:`tpm_gym.simulation.simulation`), so this module does not import the engine.
"""

from __future__ import annotations

import math
from typing import Any

from tpm_gym.mechanism.links import CUP_RADIUS
from tpm_gym.simulation.bullet.robot import Robot
from tpm_gym.simulation.physics import (
    PULL_OFF_FORCE,
    SEAL_GAP,
    SEAL_TILT,
    rotate,
)
from tpm_gym.simulation.state import Puck

__all__ = ["Cup", "Pose"]

Pose = tuple[Any, Any]
"""Position (m) and orientation (x, y, z, w), or two velocities (m/s, rad/s); plain tuples."""


class Cup:
    """The cup on a robot's platform, and the one object that it can hold.

    Args:
        client: The physics client.
        robot: Whose platform carries the cup.
        body: The object's number in the client.
        puck: What the object is.
    """

    def __init__(self, client: Any, robot: Robot, body: int, puck: Puck) -> None:
        """Start with nothing held."""
        self._client, self._robot, self._body, self._puck = client, robot, body, puck
        self._constraint: int | None = None
        self.grip: Pose | None = None
        """Pose of the held object in the tool's inertial frame, None if nothing is held."""

    def suck(self) -> None:
        """With the vacuum on: drop an object that was pulled off, take one that is touched."""
        sealed = self._sealed()
        if self.grip is not None and not sealed:
            self.let_go()
        elif self.grip is None and sealed:
            self.take(self._relative_pose())

    def take(self, grip: Pose) -> None:
        """Fix the object to the tool at ``grip``."""
        constraint = self._client.createConstraint(
            *self._robot.tool,
            self._body,
            -1,
            self._client.JOINT_FIXED,
            (0.0, 0.0, 0.0),
            grip[0],
            (0.0, 0.0, 0.0),
            grip[1],
        )
        # Beyond this force the constraint yields, the lip lifts off, and the next check lets go.
        self._client.changeConstraint(constraint, maxForce=PULL_OFF_FORCE)
        self._constraint, self.grip = constraint, grip

    def let_go(self) -> None:
        """Release the object, if one is held."""
        if self._constraint is not None:
            self._client.removeConstraint(self._constraint)
        self._constraint = self.grip = None

    def _sealed(self) -> bool:
        """Whether the whole lip lies on the top face of the puck."""
        lip, axis = self._robot.cup()
        (x, y, z), (qx, qy, qz, qw) = self._client.getBasePositionAndOrientation(self._body)
        inverse = (-qx, -qy, -qz, qw)
        local = rotate(inverse, (lip[0] - x, lip[1] - y, lip[2] - z))
        gap = local[2] - self._puck.height / 2
        covered = max(abs(local[0]), abs(local[1])) <= self._puck.width / 2 - CUP_RADIUS
        aligned = -rotate(inverse, axis)[2] >= math.cos(SEAL_TILT)
        return abs(gap) <= SEAL_GAP and covered and aligned

    def _relative_pose(self) -> Pose:
        """Pose of the object in the tool's inertial frame, as it is now."""
        state = self._client.getLinkState(*self._robot.tool, computeForwardKinematics=True)
        inverse = self._client.invertTransform(state[0], state[1])
        pose = self._client.getBasePositionAndOrientation(self._body)
        relative: Pose = self._client.multiplyTransforms(*inverse, *pose)
        return relative
