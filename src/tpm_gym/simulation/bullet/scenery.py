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
from tpm_gym.simulation.stage import FLOOR, FLOOR_EDGE, LIGHT, PATCH_HEIGHT, Slab, boards, painted
from tpm_gym.simulation.state import Block, Scene

_SHADING = {"lightAmbientCoeff": 0.6, "lightDiffuseCoeff": 0.35, "lightSpecularCoeff": 0.05}


class Scenery:
    """Bodies in the client that do not belong to the robot.

    The argument ``table`` has the half edge lengths of the tables along x and y, m.

    Attributes:
        bodies: Body ids of the objects, in the order of the scene.
        tables: Body ids of the tables. Each object collides with its own table, because
            :class:`Friction` scales the friction of each table. All tables are in one place and
            have one colour. The first table exists also without objects.
        belts: Body ids of the belts, one for each table; empty without a belt.
        belt_speed: Speed of the belts along x, m/s.
    """

    def __init__(self, client: Client, scene: Scene, table: tuple[float, float]) -> None:
        """Load tables, floor and objects into the client."""
        self._client, self.belt_speed = client, 0.0
        self._blocks = scene.objects
        still, *moving = boards(table, scene.belt)
        copies, width = range(max(1, len(self._blocks))), table[1]
        self.tables = [self._add_slab(*still, width) for _ in copies]
        self.belts = [self._add_slab(*board, width) for board in moving for _ in copies]
        self._floor = self._add_slab(FLOOR, -FLOOR_EDGE, FLOOR_EDGE, FLOOR_EDGE)
        pose = client.getBasePositionAndOrientation
        self._belt_places = [pose(belt) for belt in self.belts]
        self._paint(scene)
        self.bodies = [self._add_block(block) for block in self._blocks]
        for index, body in enumerate(self.bodies):
            for tops in (self.tables, self.belts):
                for other, top in enumerate(tops):
                    client.setCollisionFilterPair(body, top, -1, -1, int(index == other))

    def _add_slab(self, slab: Slab, low: float, high: float, width: float) -> int:
        """Add a static board, and return its body id.

        Args:
            slab: Thickness, height, colour and friction of the board.
            low: Lower end along x, m.
            high: Upper end along x, m.
            width: Half the width along y, m.
        """
        half, height = ((high - low) / 2, width, slab.half_height), slab.top - slab.half_height
        body = self._add_box(half, ((low + high) / 2, 0.0, height), slab.colour)
        # PyBullet multiplies the friction coefficients of both bodies.
        self._client.changeDynamics(body, -1, lateralFriction=slab.friction)
        return body

    def _add_block(self, block: Block) -> int:
        place = (0.0, 0.0, block.height / 2)
        body = self._add_box(block.half, place, block.colour, block.mass)
        self._client.changeDynamics(
            body, -1, lateralFriction=block.friction, linearDamping=0.0, angularDamping=0.0
        )
        return body

    def _add_box(
        self, half: Vector, place: Vector, colour: Sequence[float], mass: float = 0.0
    ) -> int:
        """Add a box with its centre at ``place`` (m); a box without mass is static."""
        client = self._client
        solid = client.createCollisionShape(client.GEOM_BOX, halfExtents=half)
        shape = client.createVisualShape(client.GEOM_BOX, halfExtents=half, rgbaColor=colour)
        return int(client.createMultiBody(mass, solid, shape, basePosition=place))

    def _paint(self, scene: Scene) -> None:
        """Add the scene's painted rectangles as bodies that touch nothing."""
        client, self._patches = self._client, list[int]()
        for patch in painted(scene):
            (x, y), (u, v) = patch.low, patch.high
            half = ((u - x) / 2, (v - y) / 2, PATCH_HEIGHT)
            shape = client.createVisualShape(
                client.GEOM_BOX, halfExtents=half, rgbaColor=patch.colour
            )
            middle = ((x + u) / 2, (y + v) / 2, 0.0)
            self._patches.append(client.createMultiBody(0.0, -1, shape, basePosition=middle))

    def run_belts(self) -> None:
        """Set place and velocity of the belts; call before each time step.

        A belt is a static body with a velocity, so that contacts carry blocks along. Bullet also
        moves the body by this velocity; therefore the place is set each time.
        """
        self._place_belts()
        for belt in self.belts:
            self._client.resetBaseVelocity(belt, (self.belt_speed, 0.0, 0.0))

    def _place_belts(self) -> None:
        for belt, place in zip(self.belts, self._belt_places, strict=True):
            self._client.resetBasePositionAndOrientation(belt, *place)

    def place(self, placed: Sequence[tuple[Pose, Twist]]) -> None:
        """Set poses and velocities of the objects, and clear their old contacts."""
        # After a time step, belts are ahead by its motion. Contacts at their ends would be others.
        self._place_belts()
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
        ids[np.isin(body, self.tables + self.belts + self._patches)] = TABLETOP
        for index, block in enumerate(self.bodies):
            ids[body == block] = OBJECTS + index
        return ids
