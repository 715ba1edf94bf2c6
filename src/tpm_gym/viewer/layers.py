"""Layers around the robot: singular surfaces, aspects, workspace, regions, slices."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from itertools import product
from typing import Any, Final, TypeAlias

import numpy as np
import trimesh
from numpy.typing import NDArray
from viser import SceneApi

from tpm_gym.analysis import delta
from tpm_gym.analysis.aspects import aspects, reachable_set
from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.kinematics import AssemblyMode
from tpm_gym.kinematics.jacobian import conditioning_at
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism import Delta
from tpm_gym.mechanism.tpm import TPM
from tpm_gym.viewer.meshes import SURFACES, cells_mesh, clipped, grid_mesh, surface
from tpm_gym.viewer.posture import Margin, Posture
from tpm_gym.viewer.scene import ROBOT

__all__ = ["BEST", "LAYERS", "Layers", "colours"]

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
_MAP: Final = np.array(
    [(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)], dtype=float
)
BEST: Final = 0.4
"""Conditioning at the end of the colour map."""
_STEPS: Final = 200
_FINE: Final = (96, 24, 128)
_ROUND: Final = (96, 96, 96)


def colours(values: FloatArray) -> NDArray[np.uint8]:
    """Return colours (..., 3) of conditionings (...,)."""
    place = np.clip(values / BEST, 0.0, 1.0) * (len(_MAP) - 1)
    parts = [np.interp(place, range(len(_MAP)), _MAP[:, k]) for k in range(3)]
    return np.stack(parts, axis=-1).astype(np.uint8)


class Layers:
    """Layers of a scene by name; each is built when it is shown, and rebuilt when it changes.

    Args:
        scene: Scene of a viser server.
        machine: The robot.
    """

    def __init__(self, scene: SceneApi, machine: TPM | Delta) -> None:
        """Start with no layer shown."""
        self._scene, self._machine = scene, machine
        self._geometry: Any = machine.geometry
        self._nodes: dict[str, list[Node]] = {}
        self._keys: dict[str, Any] = {}
        self.margin: Margin | None = None

    def show(self, names: Collection[str], posture: Posture) -> None:
        """Show these layers for a posture, and hide the others.

        Layers of the translating operation mode are hidden in rotated operation. A Delta has the
        task's region and the workspace.
        """
        possible: Collection[str] = ("region", "workspace")
        if isinstance(self._machine, TPM):
            possible = LAYERS if posture.operation == "translating" else ("region",)
        for name, (key, make) in LAYERS.items():
            wanted = key(posture) if name in names and name in possible else None
            if wanted == self._keys.get(name):
                continue
            for node in self._nodes.pop(name, []):
                node.remove()
            self._keys[name] = wanted
            if wanted is not None:
                self._nodes[name] = make(self, posture)

    # -- makers of layers ---------------------------------------------------------------------

    def _mesh(self, name: str, mesh: Any, paint: tuple[int, int, int], opacity: float) -> Node:
        return self._scene.add_mesh_simple(
            f"{ROBOT}/{name}", mesh.vertices, mesh.faces, color=paint, opacity=opacity,
            side="double", cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _singular(self, kind: str, posture: Posture) -> list[Node]:
        geometry, paint = self._geometry, _SINGULAR[kind]
        return [
            self._mesh(f"singular/{factor}", surface(factor, posture.working, geometry), paint, 0.4)
            for factor in SURFACES[kind]
        ]

    def _parallel(self, posture: Posture) -> list[Node]:
        return self._singular("parallel", posture)

    def _serial(self, posture: Posture) -> list[Node]:
        return self._singular("serial", posture)

    def _constraint(self, posture: Posture) -> list[Node]:
        return self._singular("constraint", posture)

    def _aspects(self, posture: Posture) -> list[Node]:
        """Draw the aspects on the side of P; those beyond y = 0 are their mirror images."""
        side = posture.assembly.sin_beta
        found = [
            aspect
            for aspect in aspects(posture.working, self._geometry)
            if aspect.assembly.sin_beta == side
        ]
        return [
            self._mesh(f"aspects/{index}", cells_mesh(aspect.cells), paint, 0.3)
            for index, (aspect, paint) in enumerate(zip(found, _ASPECTS, strict=False))
        ]

    def _workspace(self, posture: Posture) -> list[Node]:
        of_delta = isinstance(self._machine, Delta)
        find, shape = (delta.reachable_set, _ROUND) if of_delta else (reachable_set, _FINE)
        found = find(posture.working, self._geometry, shape)
        return [self._mesh("workspace", cells_mesh(found), (120, 144, 156), 0.22)]

    def _region(self, posture: Posture) -> list[Node]:
        del posture
        regions = {"region": self._machine.region, "goals": self._machine.goal_region}
        paints = {"region": (40, 40, 40), "goals": (30, 160, 70)}
        return [
            self._scene.add_line_segments(
                f"{ROBOT}/regions/{name}",
                _edges(region),
                paints[name],
                thickness=2.0,
                thickness_units="screen",
            )
            for name, region in regions.items()
        ]

    def _conditioning(self, posture: Posture) -> list[Node]:
        """Draw the slice of the workspace at the height y of P."""
        assert isinstance(posture.assembly, AssemblyMode)
        geometry, y = self._geometry, posture.position[1]
        reach = geometry.l3 + geometry.l4
        x, z = np.linspace(-reach, reach, _STEPS) + geometry.l2, np.linspace(-reach, reach, _STEPS)
        points = np.stack(np.broadcast_arrays(x, y, z[:, None]), axis=-1)
        branches = posture.working, posture.assembly, geometry

        def there(points: FloatArray) -> BoolArray:
            found: BoolArray = conditioning_at(points, *branches) > 0
            return found

        vertices, faces = grid_mesh(clipped(points[None], there))
        paints = colours(conditioning_at(vertices, *branches))
        painted = trimesh.Trimesh(vertices, faces, vertex_colors=paints, process=False)
        name = f"{ROBOT}/conditioning"
        return [
            self._scene.add_mesh_trimesh(name, painted, cast_shadow=False, receive_shadow=False)
        ]

    def _margin(self, posture: Posture) -> list[Node]:
        self.margin = margin = posture.singularity_margin()
        if margin is None:
            return []
        name, ends = f"{ROBOT}/margin", np.stack([posture.position, margin.point])
        text = f"{1000 * margin.distance:.1f} mm to {margin.factor} = 0"
        return [
            self._scene.add_line_segments(
                name, ends[None], (214, 48, 49), thickness=4.0, thickness_units="screen"
            ),
            self._scene.add_icosphere(
                f"{name}_foot", 0.008, (214, 48, 49), position=margin.point, cast_shadow=False
            ),
            self._scene.add_label(f"{name}_text", text, position=margin.point),
        ]


def _edges(region: Region) -> FloatArray:
    """Return the twelve edges (12, 2, 3) of a box."""
    corners = list(product((0, 1), repeat=3))
    pairs = [(a, b) for a in corners for b in corners if sum(b) - sum(a) == 1 and _joined(a, b)]
    low, high = np.array(region.low), np.array(region.high)
    edges: FloatArray = low + np.array(pairs) * (high - low)
    return edges


def _joined(a: tuple[int, ...], b: tuple[int, ...]) -> bool:
    return sum(abs(p - q) for p, q in zip(a, b, strict=True)) == 1


_Key: TypeAlias = Callable[[Posture], Any]
_Maker: TypeAlias = Callable[[Layers, Posture], list[Node]]


def _by_mode(posture: Posture) -> Any:
    return posture.working


LAYERS: Final[Mapping[str, tuple[_Key, _Maker]]] = {
    "parallel": (_by_mode, Layers._parallel),
    "serial": (_by_mode, Layers._serial),
    "constraint": (_by_mode, Layers._constraint),
    "aspects": (lambda posture: (posture.working, posture.assembly.sin_beta), Layers._aspects),
    "workspace": (_by_mode, Layers._workspace),
    "region": (lambda posture: "always", Layers._region),
    "conditioning": (
        lambda posture: (posture.working, posture.assembly, round(posture.position[1], 4)),
        Layers._conditioning,
    ),
    "margin": (lambda posture: tuple(posture.position), Layers._margin),
}
"""Layers by name: a function of the values each depends on, and a function that draws it."""
