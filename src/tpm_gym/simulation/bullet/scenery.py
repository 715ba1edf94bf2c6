"""Table, floor, objects and camera in PyBullet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import Vector
from tpm_gym.simulation.bullet.client import Client
from tpm_gym.simulation.engine import UPRIGHT, Pose, Twist
from tpm_gym.simulation.imaging import (
    BACKGROUND,
    CUP,
    FAR,
    NEAR,
    OBJECTS,
    ROBOT,
    TABLETOP,
    Picture,
    View,
    metres,
)
from tpm_gym.simulation.stage import FLOOR, FLOOR_EDGE, LIGHT, TABLE, Slab
from tpm_gym.simulation.state import Block, Scene

__all__ = ["Scenery"]

_SHADING = {"lightAmbientCoeff": 0.6, "lightDiffuseCoeff": 0.35, "lightSpecularCoeff": 0.05}


class Scenery:
    """Bodies in the client that do not belong to the robot.

    Args:
        client: Physics client.
        scene: Objects to load.
        table: Half edge lengths of the tables along x and y, m.

    Attributes:
        bodies: Body ids of the objects, in the order of the scene.
        tables: Body ids of the tables. Each object collides with its own table, because
            :class:`Friction` scales the friction of each table. All tables are in one place and
            have one colour. The first table exists also without objects.
    """

    def __init__(self, client: Client, scene: Scene, table: tuple[float, float]) -> None:
        """Load tables, floor and objects into the client."""
        self._client = client
        self._blocks = scene.objects
        self.tables = [self._add_slab(TABLE, table)]
        self.tables += [self._add_slab(TABLE, table) for _ in self._blocks[1:]]
        self._floor = self._add_slab(FLOOR, (FLOOR_EDGE, FLOOR_EDGE))
        self.bodies = [self._add_block(block) for block in self._blocks]
        for index, body in enumerate(self.bodies):
            for other, top in enumerate(self.tables):
                client.setCollisionFilterPair(body, top, -1, -1, int(index == other))

    def _add_slab(self, slab: Slab, edges: tuple[float, float]) -> int:
        """Add a static board with half edge lengths ``edges`` (m); return its body id."""
        height = slab.top - slab.half_height
        body = self._add_box((*edges, slab.half_height), height, slab.colour)
        # PyBullet multiplies the friction coefficients of both bodies.
        self._client.changeDynamics(body, -1, lateralFriction=slab.friction)
        return body

    def _add_block(self, block: Block) -> int:
        body = self._add_box(block.half, block.height / 2, block.colour, block.mass)
        self._client.changeDynamics(
            body, -1, lateralFriction=block.friction, linearDamping=0.0, angularDamping=0.0
        )
        return body

    def _add_box(
        self, half: Vector, height: float, colour: Sequence[float], mass: float = 0.0
    ) -> int:
        """Add a box at ``height`` (m), static without mass."""
        client = self._client
        solid = client.createCollisionShape(client.GEOM_BOX, halfExtents=half)
        shape = client.createVisualShape(client.GEOM_BOX, halfExtents=half, rgbaColor=colour)
        place = (0.0, 0.0, height)
        return int(client.createMultiBody(mass, solid, shape, basePosition=place))

    def place(self, placed: Sequence[tuple[Pose, Twist]]) -> None:
        """Set poses and velocities of the objects, and clear their old contacts."""
        # Old contacts would warm-start the solver. Detection with distant objects removes them.
        for far, body in enumerate(self.bodies):
            self._client.resetBasePositionAndOrientation(body, (far, 0.0, 5.0), UPRIGHT)
        if self.bodies:
            self._client.performCollisionDetection()
        for body, (pose, _) in zip(self.bodies, placed, strict=True):
            self._client.resetBasePositionAndOrientation(body, *pose)
        if self.bodies:
            self._client.performCollisionDetection()
        for body, (_, twist) in zip(self.bodies, placed, strict=True):
            self._client.resetBaseVelocity(body, *twist)

    def alter(self, mass: float, friction: float) -> None:
        """Scale the nominal masses and friction coefficients of the objects by these factors."""
        for body, nominal in zip(self.bodies, self._blocks, strict=True):
            block = replace(nominal, mass=mass * nominal.mass, friction=friction * nominal.friction)
            moments, rough = block.inertia, block.friction
            self._client.changeDynamics(
                body, -1, mass=block.mass, localInertiaDiagonal=moments, lateralFriction=rough
            )

    def picture(self, view: View, tool: tuple[int, int]) -> Picture:
        """Draw the scene; ``tool`` is the address of the link with the vacuum cup."""
        client, camera = self._client, view.camera
        looking = client.computeViewMatrixFromYawPitchRoll(
            camera.target, camera.distance, camera.yaw, camera.pitch, 0.0, 2
        )
        aspect = view.width / view.height
        projection = client.computeProjectionMatrixFOV(view.opening, aspect, NEAR, FAR)
        flags = client.ER_NO_SEGMENTATION_MASK
        if view.segmented:
            flags = client.ER_SEGMENTATION_MASK_OBJECT_AND_LINKINDEX
        _, _, colour, depth, bodies = client.getCameraImage(
            view.width,
            view.height,
            viewMatrix=looking,
            projectionMatrix=projection,
            lightDirection=LIGHT,
            shadow=0,  # the software renderer's shadows leave blotches on large faces
            renderer=client.renderer,
            flags=flags,
            **_SHADING,
        )
        size = view.height, view.width
        pixels = np.asarray(colour, dtype=np.uint8).reshape(*size, 4)
        ids = None
        if view.segmented:
            ids = self._ids(np.asarray(bodies, dtype=np.int32).reshape(size), tool)
        return Picture(np.array(pixels[..., :3]), metres(1 - np.asarray(depth).reshape(size)), ids)

    def _ids(self, bodies: NDArray[np.int32], tool: tuple[int, int]) -> NDArray[np.int32]:
        """Convert PyBullet's mask to the ids of a segmentation."""
        body = np.where(bodies < 0, -1, bodies & 0xFFFFFF)
        ids = np.full(body.shape, ROBOT, dtype=np.int32)
        ids[(body == tool[0]) & (bodies >> 24 == tool[1] + 1)] = CUP
        ids[np.isin(body, [-1, self._floor])] = BACKGROUND
        ids[np.isin(body, self.tables)] = TABLETOP
        for index, block in enumerate(self.bodies):
            ids[body == block] = OBJECTS + index
        return ids
