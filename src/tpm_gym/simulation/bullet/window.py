"""Window of PyBullet, which shows a second copy of the robot and its scene."""

from __future__ import annotations

from collections.abc import Sequence

import pybullet

from tpm_gym.arrays import FloatArray
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.bullet.client import Client
from tpm_gym.simulation.bullet.physics import Physics
from tpm_gym.simulation.bullet.robot import Robot
from tpm_gym.simulation.bullet.scenery import Scenery
from tpm_gym.simulation.bullet.silence import silence
from tpm_gym.simulation.engine import UPRIGHT, Pose
from tpm_gym.simulation.imaging import Camera
from tpm_gym.simulation.stage import MARKER_COLOUR
from tpm_gym.simulation.state import Scene

_CLOSER = 0.42  # factor of the camera's distance, for the window's field of view: always 90 degrees
_OFF = (
    pybullet.COV_ENABLE_GUI,  # side panels
    pybullet.COV_ENABLE_RGB_BUFFER_PREVIEW,
    pybullet.COV_ENABLE_DEPTH_BUFFER_PREVIEW,
    pybullet.COV_ENABLE_SEGMENTATION_MARK_PREVIEW,
    pybullet.COV_ENABLE_SHADOWS,  # they take most of the time on software OpenGL
)


class Window:
    """Window with bodies that are placed, but not simulated.

    In PyBullet, each call to a client with a window may wait for a frame. The simulation of a
    control step makes about 100 calls. So another client simulates, and a few calls in each control
    step copy all poses to the window.

    Raises:
        ConfigurationError: If no window can open.
    """

    def __init__(self, physics: Physics) -> None:
        """Open an empty window."""
        with silence():  # the window's thread prints after it has opened
            self._client = Client(physics, gui=True)
            for part in _OFF:
                self._client.configureDebugVisualizer(part, 0)
        self._aimed: Camera | None = None

    def load(self, machine: Machine, scene: Scene) -> None:
        """Replace the robot and the scene."""
        client = self._client
        client.resetSimulation()
        client.configureDebugVisualizer(client.COV_ENABLE_RENDERING, 0)
        robot = Robot(client, machine.mechanism, machine.mount)
        robot.paint()
        self._joints: dict[int, list[int]] = {}
        for body, joint in robot.joints.values():
            self._joints.setdefault(body, []).append(joint)
        self._objects = Scenery(client, scene, machine.table).bodies
        shape = client.createVisualShape(
            client.GEOM_SPHERE, radius=scene.marker_radius, rgbaColor=MARKER_COLOUR
        )
        self._markers = [
            client.createMultiBody(baseVisualShapeIndex=shape) for _ in range(scene.markers)
        ]
        client.configureDebugVisualizer(client.COV_ENABLE_RENDERING, 1)

    def show(
        self, joints: Sequence[float], objects: Sequence[Pose], camera: Camera, markers: FloatArray
    ) -> None:
        """Place the robot, the objects and the markers.

        ``joints`` are the joint positions (rad) in the order of ``Robot.joints``.
        """
        client, positions = self._client, iter(joints)
        if camera != self._aimed:  # else the user may move the camera
            self._aimed = camera
            pose = camera.yaw, camera.pitch, camera.target
            client.resetDebugVisualizerCamera(_CLOSER * camera.distance, *pose)
        for body, moved in self._joints.items():
            places = [[next(positions)] for _ in moved]
            client.resetJointStatesMultiDof(body, moved, places)
        poses = [*objects, *(Pose((x, y, z), UPRIGHT) for x, y, z in markers.tolist())]
        for body, place in zip([*self._objects, *self._markers], poses, strict=True):
            client.resetBasePositionAndOrientation(body, *place)

    def close(self) -> None:
        """Close the window; a second call does nothing."""
        self._client.close()
