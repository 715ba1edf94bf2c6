"""Vacuum cup in PyBullet: a fixed joint (weld) holds an object until the vacuum law releases it.

The vacuum law is in :mod:`tpm_gym.simulation.vacuum`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import pybullet

from tpm_gym.arrays import Vector
from tpm_gym.mechanism.cup import CUP, sealed
from tpm_gym.simulation.bullet.client import Client
from tpm_gym.simulation.bullet.robot import Robot
from tpm_gym.simulation.engine import Grip, Pose
from tpm_gym.simulation.state import Block
from tpm_gym.simulation.vacuum import CLEARANCE, EMPTY, Load, hold_after

_WELD_FORCE = 1e4  # N; so large that only the vacuum law ends the weld
_FASTEST = 2.5  # m/s, largest speed of lip towards object: twice the largest commanded speed


class Cup:
    """Vacuum cup on a robot's platform; it can hold one object.

    A fixed joint (weld) holds the object 20 um below the lip. Without this gap, the contact between
    lip and object would act against the weld.

    Args:
        client: Physics client.
        robot: Robot with the cup.
        bodies: Body ids of the objects.
        blocks: Objects of the scene.
        time_step: Time step, s.

    Attributes:
        grip: Held object, and its pose in the frame at the centre of mass of the cup's link.
        first: First time step of the control period in which the lip can touch an object.
        first_update: First time step of the control period that needs :meth:`update`.
    """

    def __init__(
        self,
        client: Client,
        robot: Robot,
        bodies: Sequence[int],
        blocks: Sequence[Block],
        time_step: float,
    ) -> None:
        """Create an empty cup."""
        self._client, self._robot, self._time_step = client, robot, time_step
        self._bodies, self._blocks = bodies, blocks
        self._radii = [block.radius for block in blocks]
        self._weld = -1
        self._near: list[int] = []
        self._fastest = _FASTEST * time_step  # m per time step
        self._wait = 0  # number of time steps in which the lip cannot reach an object
        self.first = self.first_update = self._steps = 0
        self.grip = Grip()

    def find_near(self, steps: int, on: bool) -> list[int]:
        """Return indices of the objects that the lip can touch in the next ``steps`` time steps."""
        self._near, self._wait, self.first, self._steps = [], 0, steps, steps
        if self._bodies:
            lip, number = self._robot.lip(), self._client.number
            place = pybullet.getBasePositionAndOrientation
            for index, body in enumerate(self._bodies):
                way = math.dist(place(body, number)[0], lip) - self._radii[index] - CUP.radius
                wait = int(way / self._fastest) if way > 0 else 0
                if wait < steps:
                    self._near.append(index)
                    self.first = min(self.first, wait)
        self.first_update = 0 if self.grip != Grip() else self.first if on else steps
        return self._near

    def update(self, on: bool) -> None:
        """Update vacuum and held object after a time step, by the law :func:`hold_after`."""
        hold, pose = self.grip
        load = Load() if pose is None else self._load()
        touched = self._touched() if on and pose is None else -1
        if touched < 0 and hold == EMPTY:
            return
        new = hold_after(hold, self._time_step, on, load, touched)
        if new.which == hold.which:
            self.grip = Grip(new, pose)
        else:
            self.take(Grip(new, None if new.which < 0 else self._seat(new.which)))

    def take(self, grip: Grip) -> None:
        """Release the held object, then hold the object of ``grip`` if it has one."""
        client, tool = self._client, self._robot.tool
        if self.grip.pose is not None:
            client.removeConstraint(self._weld)
        self.grip = grip
        if grip.pose is not None:
            which, zero = grip.hold.which, (0.0, 0.0, 0.0)
            ends = (*tool, self._bodies[which], -1, client.JOINT_FIXED, zero)
            position, turn = grip.pose
            self._weld = client.createConstraint(*ends, position, zero, turn)
            client.changeConstraint(self._weld, maxForce=_WELD_FORCE)

    def _load(self) -> Load:
        """Return the force of the weld in the last time step.

        PyBullet reports the force along the world's axes, and the cup's axis is vertical. So the
        tension is minus the z component, and the x and y components are the shear.
        """
        x, y, z, *_ = self._client.getConstraintState(self._weld)
        return Load(-z, math.hypot(x, y))

    def _touched(self) -> int:
        """Return the index of the first object on which the lip can seal; -1 for none."""
        if self._wait > 0:
            self._wait -= 1
            return -1
        lip, number, least = self._robot.lip(), self._client.number, self._steps * self._fastest
        for index in self._near:
            block = self._blocks[index]
            place, turn = pybullet.getBasePositionAndOrientation(self._bodies[index], number)
            way = math.dist(place, lip) - self._radii[index] - CUP.seal_gap
            least = min(least, way)
            if way < 0:
                size, axis = (block.width, block.height), self._robot.cup_axis()
                if sealed(lip, axis, place, turn, size):
                    return index
        self._wait = int(max(least, 0.0) / self._fastest)
        return -1

    def _seat(self, index: int) -> Pose:
        """Return the pose that an object shall have while the cup holds it, 20 um below the lip.

        The pose is given in the frame at the centre of mass of the link with the cup.
        """
        client, (body, link) = self._client, self._robot.tool
        state = client.getLinkState(body, link, computeForwardKinematics=True)
        inverse = client.invertTransform(state[0], state[1])
        pose = client.getBasePositionAndOrientation(self._bodies[index])
        (x, y, z), turn = client.multiplyTransforms(*inverse, *pose)
        points = client.getClosestPoints(body, self._bodies[index], CLEARANCE, link, -1)
        depth = CLEARANCE - min((point[8] for point in points), default=CLEARANCE)
        seat: Vector = (x, y, z + depth)
        return Pose(seat, turn)
