"""What stands around the robot: table, floor, goal marker, puck, and the camera.

The client is handed in (see :mod:`tpm_gym.simulation.simulation`), so this module does not import the engine.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tpm_gym.mechanism.bodies import Vector
from tpm_gym.simulation.bullet.cup import Pose
from tpm_gym.simulation.physics import Quaternion
from tpm_gym.simulation.state import Puck, Scene

__all__ = ["AT_REST", "UPRIGHT", "Scenery"]

FloatArray = NDArray[np.float64]
Colour = tuple[float, float, float, float]

_NOWHERE: Vector = (math.nan, math.nan, math.nan)
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
AT_REST: Pose = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

_TABLE_COLOUR: Colour = (0.86, 0.84, 0.80, 1.0)
_FLOOR_COLOUR: Colour = (0.70, 0.72, 0.75, 1.0)
_MARKER_COLOUR: Colour = (0.1, 0.8, 0.2, 0.6)
_PUCK_COLOUR: Colour = (0.83, 0.18, 0.33, 1.0)

# The camera: what it looks at (m), from how far (m), and from where (degrees).
_TARGET, _DISTANCE, _YAW, _PITCH = (-0.01, 0.0, 0.47), 1.85, 32.0, -13.0


class Scenery:
    """Everything in the client that is not the robot.

    Args:
        client: The physics client.
        scene: What to load.

    Attributes:
        puck: Number of the puck in the client, or None.
    """

    def __init__(self, client: Any, scene: Scene) -> None:
        """Load it."""
        self._client = client
        table = self._add_box((0.45, 0.30, 0.02), (0.0, 0.0, -0.02), _TABLE_COLOUR)
        # The engine multiplies the friction of both bodies.
        client.changeDynamics(table, -1, lateralFriction=1.0)
        self._add_box((2.0, 2.0, 0.02), (0.0, 0.0, -0.52), _FLOOR_COLOUR)
        shape = client.createVisualShape(
            client.GEOM_SPHERE, radius=scene.marker_radius, rgbaColor=_MARKER_COLOUR
        )
        self._marker = client.createMultiBody(baseVisualShapeIndex=shape)
        self._nominal = scene.puck
        self.puck: int | None = None if scene.puck is None else self._add_puck(scene.puck)

    def _add_box(self, half: Vector, centre: Vector, colour: Colour) -> int:
        """A static box."""
        client = self._client
        solid = client.createCollisionShape(client.GEOM_BOX, halfExtents=half)
        drawn = client.createVisualShape(client.GEOM_BOX, halfExtents=half, rgbaColor=colour)
        body: int = client.createMultiBody(
            baseCollisionShapeIndex=solid, baseVisualShapeIndex=drawn, basePosition=centre
        )
        return body

    def _add_puck(self, puck: Puck) -> int:
        client = self._client
        half = (puck.width / 2, puck.width / 2, puck.height / 2)
        solid = client.createCollisionShape(client.GEOM_BOX, halfExtents=half)
        drawn = client.createVisualShape(client.GEOM_BOX, halfExtents=half, rgbaColor=_PUCK_COLOUR)
        body: int = client.createMultiBody(
            baseMass=puck.mass,
            baseCollisionShapeIndex=solid,
            baseVisualShapeIndex=drawn,
            basePosition=(0.0, 0.0, puck.height / 2),
        )
        client.changeDynamics(
            body,
            -1,
            lateralFriction=puck.friction,
            linearDamping=0.0,
            angularDamping=0.0,
        )
        return body

    def move_marker(self, position: list[float]) -> None:
        """Show the goal at ``position`` (3) m, world."""
        self._client.resetBasePositionAndOrientation(self._marker, position, UPRIGHT)

    def place_puck(self, pose: Pose, velocity: Pose) -> None:
        """Put the puck down with no memory of old contacts (the engine warm-starts them)."""
        if self.puck is None:
            return
        for place in (((0.0, 0.0, 5.0), UPRIGHT), pose):
            self._client.resetBasePositionAndOrientation(self.puck, *place)
            self._client.performCollisionDetection()
        self._client.resetBaseVelocity(self.puck, *velocity)

    def puck_pose(self) -> tuple[Pose | None, Pose | None]:
        """Pose of the puck, and its linear and angular velocity; None without a puck."""
        if self.puck is None:
            return None, None
        pose = self._client.getBasePositionAndOrientation(self.puck)
        return pose, self._client.getBaseVelocity(self.puck)

    def puck_state(self) -> tuple[Vector, Quaternion, Vector, Vector]:
        """Position, orientation, velocity, angular velocity; NaN without a puck."""
        pose, velocity = self.puck_pose()
        if pose is None or velocity is None:
            return _NOWHERE, (*_NOWHERE, math.nan), _NOWHERE, _NOWHERE
        return pose[0], pose[1], velocity[0], velocity[1]

    def alter_puck(self, mass: float, friction: float) -> None:
        """Make the puck ``mass`` times as heavy and ``friction`` times as rough as nominal."""
        if self.puck is None or self._nominal is None:
            return
        puck = replace(
            self._nominal,
            mass=mass * self._nominal.mass,
            friction=friction * self._nominal.friction,
        )
        self._client.changeDynamics(
            self.puck,
            -1,
            mass=puck.mass,
            localInertiaDiagonal=puck.inertia,
            lateralFriction=puck.friction,
        )

    def aim_window(self) -> None:
        """Point the camera of the engine's window like that of :meth:`picture`."""
        self._client.resetDebugVisualizerCamera(
            cameraDistance=0.7 * _DISTANCE,  # the window's field of view is wider
            cameraYaw=_YAW,
            cameraPitch=_PITCH,
            cameraTargetPosition=_TARGET,
        )

    def picture(self, width: int, height: int, renderer: int) -> NDArray[np.uint8]:
        """The scene as (height, width, 3) RGB."""
        client = self._client
        view = client.computeViewMatrixFromYawPitchRoll(
            cameraTargetPosition=_TARGET,
            distance=_DISTANCE,
            yaw=_YAW,
            pitch=_PITCH,
            roll=0.0,
            upAxisIndex=2,
        )
        projection = client.computeProjectionMatrixFOV(
            fov=42.0, aspect=width / height, nearVal=0.1, farVal=6.0
        )
        image = client.getCameraImage(
            width,
            height,
            viewMatrix=view,
            projectionMatrix=projection,
            lightDirection=(1.0, -1.2, 2.5),
            shadow=0,  # the software renderer blotches large faces with its shadow map
            renderer=renderer,
        )
        pixels = np.asarray(image[2], dtype=np.uint8).reshape(height, width, 4)
        return np.array(pixels[..., :3])
