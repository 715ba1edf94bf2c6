"""The vacuum cup in PyBullet: it seals on contact, holds up to a force, and lets go."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from tpm_gym.arrays import Vector
from tpm_gym.mechanism.cup import CUP, sealed
from tpm_gym.simulation.bullet.client import Client
from tpm_gym.simulation.bullet.robot import Robot
from tpm_gym.simulation.engine import Pose
from tpm_gym.simulation.state import Block

__all__ = ["Cup", "Grip"]


class Grip(NamedTuple):
    """Which object is held, and its pose in the tool's inertial frame."""

    which: int
    pose: Pose


class Cup:
    """The cup on a robot's platform, and the objects of which it can hold one.

    Args:
        client: The physics client.
        robot: Whose platform carries the cup.
        bodies: The objects' numbers in the client.
        blocks: What they are.
    """

    def __init__(
        self, client: Client, robot: Robot, bodies: Sequence[int], blocks: Sequence[Block]
    ) -> None:
        """Start with nothing held."""
        self._client, self._robot = client, robot
        self._bodies, self._blocks = bodies, blocks
        self._constraint: int | None = None
        self.grip: Grip | None = None

    def suck(self) -> None:
        """With the vacuum on: drop an object that was pulled off, take one that is touched."""
        if not self._bodies:
            return
        lip, axis = self._robot.cup()
        if self.grip is not None:
            if not self._seals(self.grip.which, lip, axis):
                self.let_go()
            return
        for index in range(len(self._bodies)):
            if self._seals(index, lip, axis):
                self.take(Grip(index, self._relative_pose(index)))
                return

    def take(self, grip: Grip) -> None:
        """Fix an object to the tool."""
        constraint = self._client.createConstraint(
            *self._robot.tool,
            self._bodies[grip.which],
            -1,
            self._client.JOINT_FIXED,
            (0.0, 0.0, 0.0),
            grip.pose.position,
            (0.0, 0.0, 0.0),
            grip.pose.quaternion,
        )
        # Beyond this force the constraint yields, the lip lifts off, and the next check lets go.
        self._client.changeConstraint(constraint, maxForce=CUP.pull_off)
        self._constraint, self.grip = constraint, grip

    def let_go(self) -> None:
        """Release the object, if one is held."""
        if self._constraint is not None:
            self._client.removeConstraint(self._constraint)
        self._constraint = self.grip = None

    def _seals(self, index: int, lip: Vector, axis: Vector) -> bool:
        block = self._blocks[index]
        pose = Pose(*self._client.getBasePositionAndOrientation(self._bodies[index]))
        return sealed(lip, axis, pose.position, pose.quaternion, (block.width, block.height))

    def _relative_pose(self, index: int) -> Pose:
        """Pose of an object in the tool's inertial frame, as it is now."""
        state = self._client.getLinkState(*self._robot.tool, computeForwardKinematics=True)
        inverse = self._client.invertTransform(state[0], state[1])
        pose = self._client.getBasePositionAndOrientation(self._bodies[index])
        return Pose(*self._client.multiplyTransforms(*inverse, *pose))
