"""Vacuum cup in MuJoCo: a weld holds an object until the vacuum law releases it.

The vacuum law is in :mod:`tpm_gym.simulation.vacuum`.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from tpm_gym.arrays import Quaternion, Vector, rotate
from tpm_gym.mechanism.cup import CUP, sealed
from tpm_gym.simulation.engine import Grip, Pose
from tpm_gym.simulation.mujoco.model import grip_name, object_name
from tpm_gym.simulation.mujoco.robot import Robot
from tpm_gym.simulation.mujoco.scenery import Scenery
from tpm_gym.simulation.state import Block
from tpm_gym.simulation.vacuum import CLEARANCE, EMPTY, Load, hold_after

_SOFTER = 0.5
"""Factor of the stiffness of a held object's contacts, for example with the table.

With factor 1, MuJoCo would push a held object out of the table too fast. Then the force of the
cup's spring and the torques of the motors would be 3% smaller than in PyBullet.
"""


class Cup:
    """Vacuum cup on a robot's platform; it can hold one object.

    A weld replaces the contact between lip and object. It keeps a gap of 20 um and transmits pull,
    pressure and shear, so its force is the load of the seal.

    Attributes:
        grip: Held object, and its pose in the tool's frame.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        robot: Robot,
        scenery: Scenery,
        blocks: tuple[Block, ...],
    ) -> None:
        """Create an empty cup."""
        self._model, self._data = model, data
        self._robot, self._scenery, self._blocks = robot, scenery, blocks
        names = range(len(blocks))
        self._welds = [model.equality(grip_name(index)).id for index in names]
        geoms = [model.geom(object_name(index)).id for index in names]
        self._pairs = [(model.pair_geom1 == g) | (model.pair_geom2 == g) for g in geoms]
        self._stiffness = model.pair_solref[:, 0].copy()
        self._row = 3 * (model.neq - len(blocks))  # first row of the weld, after the closures
        self._reach = [math.hypot(*CUP.lip) + block.radius + CUP.seal_gap for block in blocks]
        self.grip = Grip()

    def load(self) -> Load:
        """Return the load of the seal; call after ``mj_step2``, the second half of a time step."""
        if self.grip.hold.which < 0:
            return Load()
        row = self._row
        x, y, z = self._data.efc_force[row : row + 3].tolist()
        _, (a, b, c) = self._robot.cup()
        tension = a * x + b * y + c * z
        shear = math.hypot(x - tension * a, y - tension * b, z - tension * c)
        return Load(tension, shear)

    def breathe(self, on: bool, load: Load) -> bool:
        """Apply the vacuum law of a time step; return whether the held object has changed."""
        before, pose = self.grip
        if not on and before == EMPTY:
            return False
        touched = self._touched() if on and before.which < 0 else -1
        hold = hold_after(before, self._model.opt.timestep, on, load, touched)
        if hold.which == before.which:
            self.grip = Grip(hold, pose)
            return False
        self.set(Grip(hold, self._sealed_pose(hold.which) if hold.which >= 0 else None))
        return True

    def set(self, grip: Grip) -> None:
        """Weld the held object of ``grip`` (if any) to the cup, and release all other objects."""
        model, active = self._model, self._data.eq_active
        active[self._welds] = 0
        model.pair_solref[:, 0] = self._stiffness
        self.grip = grip
        if grip.pose is not None:
            which, ((x, y, z), (qx, qy, qz, qw)) = grip.hold.which, grip.pose
            weld = self._welds[which]
            active[weld] = 1
            model.pair_solref[self._pairs[which], 0] *= _SOFTER
            model.eq_data[weld, 3:10] = (x, y, z, qw, qx, qy, qz)

    def _touched(self) -> int:
        """Return the index of the first object on which the lip can seal; -1 for none."""
        height = self._robot.tool_height()
        for index, (block, reach) in enumerate(zip(self._blocks, self._reach, strict=True)):
            if height - self._scenery.height(index) <= reach:  # a cheap check before sealed()
                lip, axis = self._robot.cup()
                pose = self._scenery.pose(index)
                if sealed(lip, axis, *pose, (block.width, block.height)):
                    return index
        return -1

    def _sealed_pose(self, index: int) -> Pose:
        """Return the pose of an object in the tool's frame, for the weld to the cup.

        If the gap between lip and object is less than 20 um, the pose is moved down until the gap
        is 20 um.
        """
        origin, turn = self._robot.tool()
        position, quaternion = self._scenery.pose(index)
        lip, _ = self._robot.cup()
        gap = _in_frame(position, quaternion, lip)[2] - self._blocks[index].height / 2
        x, y, z = _in_frame(origin, turn, position)
        relative = np.empty(4)
        mujoco.mju_mulQuat(relative, np.roll(_inverse(turn), 1), np.roll(quaternion, 1))
        qw, qx, qy, qz = relative.tolist()
        return Pose((x, y, z + max(0.0, CLEARANCE - gap)), (qx, qy, qz, qw))


def _inverse(quaternion: Quaternion) -> Quaternion:
    x, y, z, w = quaternion
    return -x, -y, -z, w


def _in_frame(origin: Vector, quaternion: Quaternion, point: Vector) -> Vector:
    """Convert a point (m) from the world to a frame with this origin (m) and orientation."""
    (x, y, z), (u, v, w) = point, origin
    return rotate(_inverse(quaternion), (x - u, y - v, z - w))
