"""Layers around the robot: singular surfaces, aspects, workspace, regions, slices."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import combinations
from operator import ne
from typing import Any, Final, TypeAlias

import numpy as np
import trimesh
from numpy.typing import NDArray
from viser import SceneApi

from tpm_gym.analysis.aspects import Cells
from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics.workspace import Region
from tpm_gym.viewer.kinds.kind import Found, Kind, Margin, Posture
from tpm_gym.viewer.meshes import Mesh, cells_mesh
from tpm_gym.viewer.scene import ROBOT

Node = Any
"""Node of a viser scene."""

_SINGULAR: Final = {
    "parallel": (214, 48, 49),
    "serial": (9, 105, 218),
    "constraint": (130, 60, 190),
}
_ASPECTS: Final = (
    (46, 160, 67), (219, 132, 0), (17, 138, 178), (191, 64, 160), (140, 150, 30), (99, 110, 250),
    (200, 80, 60), (0, 150, 136),
)  # fmt: skip
MAP: Final = np.array(
    [(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)], dtype=float
)
"""Colours of the conditioning, evenly spaced from 0 to :data:`BEST`."""
BEST: Final = 0.4
"""Conditioning at the end of the colour map."""


def colours(values: FloatArray) -> NDArray[np.uint8]:
    """Return colours (..., 3) of conditionings (...,)."""
    stops = np.linspace(0.0, BEST, len(MAP))
    return np.stack([np.interp(values, stops, part) for part in MAP.T], axis=-1).astype(np.uint8)


class Layers:
    """Layers of a scene by name; each is built when it is shown, and rebuilt when it changes.

    Args:
        scene: Scene of a viser server.
        kind: The machine with its modes. It computes what the layers show.
    """

    def __init__(self, scene: SceneApi, kind: Kind) -> None:
        """Start with no layer shown."""
        self._scene, self._kind = scene, kind
        self._nodes: dict[str, list[Node]] = {}
        self._keys: dict[str, Any] = {}

    def around(self, posture: Posture) -> Mapping[str, Found]:
        """Return the available layers of a posture, by name.

        These are the layer "region", with the boxes of the commands and of the goals, and the
        layers that :meth:`Kind.layers` returns.
        """
        machine = self._kind.machine
        regions = {"region": machine.region, "goals": machine.goal_region}
        return {"region": ("always", lambda: regions), **self._kind.layers(posture)}

    def show(self, names: Collection[str], posture: Posture) -> None:
        """Show the available layers in ``names`` for a posture, and hide all others."""
        there = self.around(posture)
        for name, (_, _, draw) in LAYERS.items():
            wanted, find = there[name] if name in names and name in there else (None, None)
            if wanted == self._keys.get(name):
                continue
            for node in self._nodes.pop(name, []):
                node.remove()
            self._keys[name] = wanted
            if find is not None:
                self._nodes[name] = draw(self, name, posture, find())

    # -- drawing of layers --------------------------------------------------------------------

    def _mesh(self, name: str, mesh: Mesh, paint: tuple[int, int, int], opacity: float) -> Node:
        # Without BLEND, parts of a sheet would hide the sheets behind it. viser's simple mesh does
        # not have this option.
        linear = [round(255 * (part / 255) ** 2.2) for part in paint]
        visual: Any = trimesh.visual
        material = visual.material.PBRMaterial(
            baseColorFactor=[*linear, round(255 * opacity)], metallicFactor=0.0,
            roughnessFactor=1.0, alphaMode="BLEND", doubleSided=True,
        )  # fmt: skip
        look = visual.TextureVisuals(material=material)
        painted = trimesh.Trimesh(*mesh, visual=look, process=False)
        _ = painted.vertex_normals  # exported only once computed; without them, shading is flat
        return self._scene.add_mesh_trimesh(
            f"{ROBOT}/{name}", painted, cast_shadow=False, receive_shadow=False
        )

    def _singular(self, name: str, posture: Posture, found: Mapping[str, Mesh]) -> list[Node]:
        return [
            self._mesh(f"singular/{factor}", mesh, _SINGULAR[name], 0.4)
            for factor, mesh in found.items()
        ]

    def _aspects(self, name: str, posture: Posture, found: Sequence[Cells]) -> list[Node]:
        return [
            self._mesh(f"{name}/{index}", cells_mesh(cells), paint, 0.3)
            for index, (cells, paint) in enumerate(zip(found, _ASPECTS, strict=False))
        ]

    def _workspace(self, name: str, posture: Posture, found: Cells) -> list[Node]:
        return [self._mesh(name, cells_mesh(found), (120, 144, 156), 0.22)]

    def _region(self, name: str, posture: Posture, found: Mapping[str, Region]) -> list[Node]:
        paints = {"region": (40, 40, 40), "goals": (30, 160, 70)}
        return [
            self._scene.add_line_segments(
                f"{ROBOT}/regions/{box}",
                _edges(region),
                paints[box],
                thickness=2.0,
                thickness_units="screen",
            )
            for box, region in found.items()
        ]

    def _conditioning(
        self, name: str, posture: Posture, found: tuple[Mesh, FloatArray]
    ) -> list[Node]:
        (vertices, faces), values = found
        painted = trimesh.Trimesh(vertices, faces, vertex_colors=colours(values), process=False)
        return [
            self._scene.add_mesh_trimesh(
                f"{ROBOT}/{name}", painted, cast_shadow=False, receive_shadow=False
            )
        ]

    def _margin(self, name: str, posture: Posture, found: Margin | None) -> list[Node]:
        if found is None:
            return []
        name, ends = f"{ROBOT}/{name}", np.stack([posture.position, found.point])
        text = f"{1000 * found.distance:.1f} mm to {found.factor} = 0"
        return [
            self._scene.add_line_segments(
                name, ends[None], (214, 48, 49), thickness=4.0, thickness_units="screen"
            ),
            self._scene.add_icosphere(
                f"{name}_foot", 0.008, (214, 48, 49), position=found.point, cast_shadow=False
            ),
            self._scene.add_label(f"{name}_text", text, position=found.point),
        ]


def _edges(region: Region) -> FloatArray:
    """Return the twelve edges (12, 2, 3) of a box."""
    return np.array([e for e in combinations(region.corners(), 2) if sum(map(ne, *e)) == 1])


_Draw: TypeAlias = Callable[[Layers, str, Posture, Any], list[Node]]

LAYERS: Final[Mapping[str, tuple[str, str, _Draw]]] = {
    "parallel": ("Parallel", "Parallel singularities of the working mode, red", Layers._singular),
    "serial": ("Serial", "Serial singularities of the working mode, blue", Layers._singular),
    "constraint": (
        "Constraint", "Constraint singularity of the working mode, purple", Layers._singular
    ),
    "aspects": (
        "Aspects", "Singularity-free regions of the working mode, on the side of P",
        Layers._aspects,
    ),
    "workspace": (
        "Workspace", "Points that the working mode reaches, ignoring the stops", Layers._workspace
    ),
    "region": (
        "Task region", "Box of the commands (black) and of the goals (green)", Layers._region
    ),
    "conditioning": (
        "Conditioning", "1/cond(J) in the plane of P parallel to xz, in the modes shown",
        Layers._conditioning,
    ),
    "margin": ("Margin", "Way from P to the nearest singularity", Layers._margin),
}  # fmt: skip
"""Layers by name: label, explanation, and a function that draws the layer of a machine."""
