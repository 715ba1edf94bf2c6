"""The zero sets as surfaces in space, made of polygons that are drawn back to front.

At constant (xC, zC) point P runs over the half circle on which link 7 carries it as beta turns.
All zero sets but that of leg 3 are curves in (xC, zC) swept along that half circle.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import contourpy
import numpy as np
from matplotlib.colors import to_rgb
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from figures.sections import MM
from figures.zero_sets import reach_margin
from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.kinematics.geometry import PAPER

STRETCH = 6.0  # y is drawn this many times too long: the workspace is a disc 100 mm thick
_LIGHT = np.array([-0.35, -0.75, 0.56])


_SPLIT = 6  # an edge cell of a swept surface is split into this many squared


@dataclass(frozen=True)
class Surface:
    """Polygons of one colour.

    Attributes:
        polygons: Each (n, 3) m; an array where all have as many corners.
        colour: Matplotlib colour.
        alpha: Opacity.
    """

    polygons: Sequence[FloatArray] | FloatArray
    colour: str
    alpha: float = 1.0


def levels(count: int = 25) -> FloatArray:
    """Return values of y, dense towards y = +-l7 where the half circle is steep."""
    return PAPER.l7 * np.sin(np.linspace(-np.pi / 2, np.pi / 2, count))


def sweep(line: FloatArray, y0: float, y: FloatArray, cos_beta_sign: int) -> FloatArray:
    """Move a line (n, 2) of (x, z) at ``y0`` to each y at constant (xC, zC).

    Returns:
        (len(y), n, 3) m.
    """
    circle = [np.sqrt(np.maximum(PAPER.l7**2 - at**2, 0.0)) for at in (y, np.array(y0))]
    x = line[None, :, 0] + cos_beta_sign * (circle[0] - circle[1])[:, None]
    return np.stack(
        [x, np.repeat(y[:, None], len(line), axis=1), np.repeat(line[None, :, 1], len(y), axis=0)],
        axis=-1,
    )


def sweep_leg3(line: FloatArray, y0: float, y: FloatArray) -> FloatArray:
    """Move an edge (n, 2) of leg 3's reach at ``y0`` to each y: P is on a circle about A3.

    Its radius is sqrt(l4^2 - y^2) +- l3, the projected rod and the arm in one line.
    """
    centre = np.array([PAPER.l1 - PAPER.l2, PAPER.l6])
    offset = line - centre
    radius = np.hypot(*offset.T)
    rods = [np.sqrt(PAPER.l4**2 - at**2) for at in (y, np.array(y0))]
    scale = 1 + (rods[0] - rods[1])[:, None] / radius
    plane = centre + offset * scale[..., None]
    across = np.broadcast_to(y[:, None], plane.shape[:2])
    return np.stack([plane[..., 0], across, plane[..., 1]], axis=-1)


def trimmed(mesh: FloatArray, keep: Callable[[FloatArray], BoolArray]) -> FloatArray:
    """Return cells (k, 4, 3) of a mesh (i, j, 3) where ``keep``; cells on its edge are divided."""
    inside = keep(mesh)
    count = sum(
        inside[i : len(mesh) - 1 + i, j : mesh.shape[1] - 1 + j] for i in (0, 1) for j in (0, 1)
    )
    cells = _cells(mesh)
    whole, edge = cells[count.ravel() == 4], cells[(count.ravel() > 0) & (count.ravel() < 4)]
    t = np.linspace(0, 1, _SPLIT + 1)
    weights = np.stack(
        [np.outer(1 - t, 1 - t), np.outer(1 - t, t), np.outer(t, t), np.outer(t, 1 - t)]
    )
    fine = [_cells(np.einsum("kij,kd->ijd", weights, cell)) for cell in edge]
    if not fine:
        return whole
    small = np.concatenate(fine)
    return np.concatenate([whole, small[keep(small.mean(axis=1))]])


def _cells(mesh: FloatArray) -> FloatArray:
    corners = [mesh[:-1, :-1], mesh[:-1, 1:], mesh[1:, 1:], mesh[1:, :-1]]
    return np.stack(corners, axis=2).reshape(-1, 4, 3)


def plate(y: float, cos_beta_sign: int, x: FloatArray, z: FloatArray) -> list[FloatArray]:
    """Return the reachable set at one y in quarters: polygons (n, 3) around the hole in it."""
    grid_x, grid_z = np.meshgrid(x, z)
    margin = reach_margin(np.stack([grid_x, np.full_like(grid_x, y), grid_z], -1), cos_beta_sign)
    generator = contourpy.contour_generator(
        x, z, margin, fill_type="OuterCode", chunk_size=((len(z) + 1) // 2, (len(x) + 1) // 2)
    )
    polygons, _ = generator.filled(0.0, np.inf)
    return [np.insert(np.asarray(polygon), 1, y, axis=1) for polygon in polygons]


def draw(axes: Axes3D, layers: Sequence[Sequence[Surface]]) -> None:
    """Add surfaces layer by layer, the farthest first; matplotlib sorts only within a layer."""
    axes.computed_zorder = False
    for order, layer in enumerate(layers):
        polygons, colours = [], []
        for surface in layer:
            for polygon in surface.polygons:
                polygons.append(polygon * MM)
                colours.append((*_shaded(surface.colour, polygon), surface.alpha))
        # Edges in the colour of the face close the seams, but would show on what is translucent.
        solid = all(surface.alpha == 1.0 for surface in layer)
        axes.add_collection3d(
            Poly3DCollection(
                polygons,
                facecolors=colours,
                edgecolors=colours if solid else "none",
                linewidths=0.3,
                zorder=order,
            )
        )


def halves(polygons: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the cells behind and in front of the plane y = 0, in the view of :func:`frame`."""
    behind = polygons[..., 1].mean(axis=1) > 0
    return polygons[behind], polygons[~behind]


def _shaded(colour: str, polygon: FloatArray) -> FloatArray:
    """Shade the colour: darker where the polygon is turned away from the light."""
    drawn = polygon * (1.0, STRETCH, 1.0)
    normal = np.cross(drawn[1] - drawn[0], drawn[-1] - drawn[0])
    length = np.linalg.norm(normal)
    lit = abs(normal @ _LIGHT) / length if length > 0 else 1.0
    return np.asarray(to_rgb(colour)) * (0.7 + 0.3 * lit)


def frame(axes: Axes3D, x: tuple[float, float], z: tuple[float, float]) -> None:
    """Set limits (mm), labels and view of a picture in space."""
    axes.set(xlim=x, ylim=(-50, 50), zlim=z)
    axes.set_box_aspect((x[1] - x[0], 100 * STRETCH, z[1] - z[0]), zoom=1.1)
    axes.view_init(elev=16, azim=-54)
    axes.set_proj_type("ortho")
    axes.set_xlabel("x (mm)", labelpad=-2)
    axes.set_ylabel("y (mm)", labelpad=-4)
    axes.set_zlabel("z (mm)", labelpad=5)
    axes.set_yticks([-50, 0, 50])
    axes.set_xticks(range(-500, 1000, 500))
    axes.set_zticks(range(-1000, 1001, 500))
    axes.tick_params(pad=-2)
    axes.tick_params(axis="z", pad=3)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color((1.0, 1.0, 1.0, 1.0))
        axis._axinfo["grid"].update(color="0.88", linewidth=0.5)
