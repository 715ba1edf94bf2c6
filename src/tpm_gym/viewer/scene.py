"""Robot, table and objects as nodes of a viser scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike
from viser import SceneApi, ViserServer
from viser.transforms import SO3

from tpm_gym.arrays import FloatArray
from tpm_gym.mechanism.bodies import Place, Solid
from tpm_gym.mechanism.machine import Machine
from tpm_gym.mechanism.tpm import PAPER_TPM
from tpm_gym.mechanism.urdf import COLOURS
from tpm_gym.simulation.stage import BELT, FLOOR, PATCH_HEIGHT, TABLE, painted
from tpm_gym.simulation.state import Patch, Scene, State

ROBOT: Final = "/robot"
"""Node whose frame is the machine's frame; everything in that frame hangs below it."""

_TASK: Final = "/objects", "/goals", "/paint"
"""Nodes below which objects, goal markers, belt and paint of a task hang; world frame."""
_GOAL: Final = (30, 160, 70)


def colour(rgba: Sequence[float]) -> tuple[int, int, int]:
    """Convert red, green and blue of a colour, in [0, 1], to whole numbers in [0, 255]."""
    red, green, blue = (round(255 * part) for part in rgba[:3])
    return red, green, blue


def set_camera(server: ViserServer, machine: Machine) -> None:
    """Place the camera of new pages, so that the robot fills the picture."""
    middle = machine.mount.to_world(machine.home) * [1, 0.5, 0]
    middle[2] = 0.55 * machine.mount.height
    server.initial_camera.look_at = middle
    # The camera's distance was chosen for the paper's machine.
    longer = max(machine.table) - max(PAPER_TPM.table)
    size = max(1 + longer, machine.mount.height / PAPER_TPM.mount.height)
    server.initial_camera.position = middle + np.array([1.1, -1.65, 0.45]) * size
    server.initial_camera.fov = math.radians(38)


class RobotScene:
    """Robot over its table, with the objects and goal markers of a task.

    Args:
        scene: Scene of a viser server or client.

    Attributes:
        links: Nodes of the links by name, below :data:`ROBOT`.
    """

    def __init__(self, scene: SceneApi, machine: Machine) -> None:
        """Replace the robot, its table and the task of the scene."""
        self._scene, self._machine = scene, machine
        for name in (ROBOT, *_TASK):
            scene.remove_by_name(name)
        turn = _first(machine.mount.quaternion)
        origin = machine.mount.to_world(np.zeros(3))
        scene.add_frame(ROBOT, show_axes=False, wxyz=turn, position=origin)
        self.links = {}
        for link in machine.mechanism.links:
            name = f"{ROBOT}/{link.name}"
            self.links[link.name] = scene.add_frame(name, show_axes=False)
            for index, solid in enumerate(link.solids):
                _add_solid(scene, f"{name}/{index}", solid)
        self._poses = np.full((len(self.links), 7), np.nan)  # m; quaternion (w, x, y, z)
        self._add_table()
        self._objects: list[Any] = []
        self._markers: list[Any] = []

    def _add_table(self) -> None:
        length, width = (2 * half for half in self._machine.table)
        half = TABLE.half_height
        size, place = (length, width, 2 * half), (0.0, 0.0, TABLE.top - half)
        self._scene.add_box("/table", colour(TABLE.colour), size, position=place, cast_shadow=False)
        self._scene.add_grid(
            "/floor", 6.0, 6.0, position=(0, 0, FLOOR.top), infinite_grid=True, fade_distance=8.0,
            cell_color=(225, 228, 232), section_color=(208, 212, 218), shadow_opacity=0.12,
        )  # fmt: skip

    def draw(self, places: Mapping[str, Place]) -> None:
        """Move the links to ``places`` in the base's frame.

        Setting a pose takes 0.2 ms in viser, so only poses that have changed are set.
        """
        found = [places[name] for name in self.links]
        turns = SO3.from_matrix(np.stack([place.rotation for place in found])).wxyz
        poses = np.hstack([[place.origin for place in found], turns])
        moved = poses != self._poses
        for node, pose, new in zip(self.links.values(), poses, moved, strict=True):
            if new[:3].any():
                node.position = pose[:3]
            if new[3:].any():
                node.wxyz = pose[3:]
        self._poses = poses

    def set_objects(self, scene: Scene, tolerance: float) -> None:
        """Replace the objects, goal markers, belt and paint by those of ``scene``.

        The goal markers have the radius ``tolerance``, m.
        """
        for name in _TASK:
            self._scene.remove_by_name(name)
        patches = painted(scene)
        if scene.belt is not None:
            half = self._machine.table[1]
            ends = (scene.belt.start, -half), (scene.belt.end, half)
            patches.insert(0, Patch(*ends, BELT.colour))
        for index, patch in enumerate(patches):
            self._add_patch(index, patch)
        self._objects = [
            self._scene.add_box(
                f"/objects/{block.name}", colour(block.colour), 2 * np.array(block.half)
            )
            for block in scene.objects
        ]
        self._markers = [
            self._scene.add_icosphere(
                f"/goals/{index}", tolerance, _GOAL, opacity=0.45, cast_shadow=False
            )
            for index in range(scene.markers)
        ]

    def _add_patch(self, index: int, patch: Patch) -> None:
        """Add a painted rectangle; a later one lies above the earlier ones."""
        low, high = np.array(patch.low), np.array(patch.high)
        size, place = (*(high - low), PATCH_HEIGHT), (*(low + high) / 2, min(index, 1) * 1e-4)
        self._scene.add_box(
            f"/paint/{index}", colour(patch.colour), size, position=place, cast_shadow=False
        )

    def draw_objects(self, state: State, markers: FloatArray) -> None:
        """Move the objects and the goal markers.

        Args:
            state: State of one robot, with the poses of the objects.
            markers: Places of the goal markers, (k, 3) m, world.
        """
        for index, node in enumerate(self._objects):
            node.position = state.object_position[index]
            node.wxyz = _first(state.object_quaternion[index])
        for node, place in zip(self._markers, markers, strict=True):
            node.position = place


def _first(quaternion: ArrayLike) -> FloatArray:
    """Convert a quaternion (x, y, z, w) to viser's order (w, x, y, z)."""
    return np.roll(np.asarray(quaternion, dtype=np.float64), 1)


def _add_solid(scene: SceneApi, name: str, solid: Solid) -> None:
    paint = colour(COLOURS[solid.colour])
    turn = SO3.from_matrix(solid.rotation).wxyz
    if solid.kind == "box":
        scene.add_box(name, paint, solid.size, wxyz=turn, position=solid.centre)
        return
    radius, length, _ = solid.size
    scene.add_cylinder(name, radius, length, paint, wxyz=turn, position=solid.centre)
