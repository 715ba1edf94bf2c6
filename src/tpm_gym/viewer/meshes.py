"""Triangle meshes of singular surfaces and of sets of cells; machine's frame, m."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tpm_gym.analysis import sheets
from tpm_gym.analysis.aspects import Cells
from tpm_gym.arrays import BoolArray, FloatArray, Vector
from tpm_gym.kinematics import WorkingMode
from tpm_gym.kinematics.geometry import Geometry
from tpm_gym.kinematics.workspace import reachable

_AROUND = 33  # points along the half circle of link 7
_SLACK = 1e-9  # fraction of l4 by which a leg may miss a point at the boundary of its reach
_SMOOTHING = 4  # rounds
_HALVINGS = 8
_STEPS = 200  # points along each edge of a slice


class Mesh(NamedTuple):
    """Triangle mesh: vertices (v, 3) m, and faces (f, 3), three indices of vertices each."""

    vertices: FloatArray
    faces: NDArray[np.int64]


def surface(factor: str, mode: WorkingMode, geometry: Geometry) -> Mesh:
    """Return the part of the singular surface of a factor that a working mode reaches.

    ``factor`` is one of :data:`tpm_gym.analysis.singularity.FACTORS`.
    """
    flat = factor in ("sin_beta", "cos_beta")
    if flat:
        points = _planes(factor, geometry)
    elif factor == "leg3":
        points = _torus(geometry)
    else:
        points = _swept(factor, mode, geometry)
    # On the surface, rounding may put a point out of reach. A stretched leg then reaches it with a
    # longer rod, a folded leg with a shorter rod.
    longer, shorter = (replace(geometry, l4=geometry.l4 * (1 + sign * _SLACK)) for sign in (1, -1))

    def there(points: FloatArray) -> BoolArray:
        found: BoolArray = reachable(points, mode, longer) | reachable(points, mode, shorter)
        return found

    if flat:
        return grid_mesh(clipped(points, there))
    return grid_mesh(np.where(there(points)[..., None], points, np.nan))


def clipped(points: FloatArray, inside: Callable[[FloatArray], BoolArray]) -> FloatArray:
    """Cut k flat grids of points at the boundary of a region.

    A point outside the region moves to the boundary if a neighbour in the grid is inside. The other
    points outside become NaN.

    Args:
        points: (k, u, v, 3) m; each grid has u x v points.
        inside: Function of points (..., 3) m that returns an array (...,): whether each point is in
            the region.
    """
    there = inside(points)
    found = np.where(there[..., None], points, np.nan)
    for axis, step in ((1, 1), (1, -1), (2, 1), (2, -1)):
        beside = np.roll(there, step, axis) & np.isnan(found[..., 0])
        beside[(slice(None),) * axis + (0 if step > 0 else -1,)] = False
        within = np.roll(points, step, axis)[beside]
        beyond = points[beside]
        for _ in range(_HALVINGS):
            middle = (within + beyond) / 2
            kept = inside(middle)[:, None]
            within, beyond = np.where(kept, middle, within), np.where(kept, beyond, middle)
        found[beside] = within
    return found


def _swept(factor: str, mode: WorkingMode, g: Geometry) -> FloatArray:
    """Return k grids of u x v positions of P, (k, u, v, 3) m, at which a factor is zero.

    The factor is zero only if point C1 is on one of k curves. On each curve, C1 has u positions.
    For each position of C1, link 7 can turn P along a half circle, on which P has v positions.
    Positions of P in other working modes are NaN.
    """
    x, z, p, q = (part[..., None] for part in sheets.curves(factor, mode, g))
    beta = np.linspace(-np.pi / 2, np.pi / 2, _AROUND)
    cos, sin = mode.cos_beta * np.cos(beta), np.sin(beta)
    points = np.broadcast_arrays(x + g.l2 + g.l7 * cos, g.l7 * sin, z + 2 * g.l6)
    ours = p + q * cos > 0
    return np.where(ours[..., None], np.stack(points, axis=-1), np.nan)


def _planes(factor: str, g: Geometry) -> FloatArray:
    """Return grids of u x v points, (k, u, v, 3) m, on the k planes on which a factor is zero.

    For the factor "sin_beta", this is the plane y = 0. For "cos_beta", these are the two planes
    |y| = l7.
    """
    reach = g.l3 + g.l4
    x = np.linspace(-g.l1 - reach - g.l7, g.l1 + reach + g.l7, 241)
    z = np.linspace(-reach, reach + 2 * g.l6, 181)
    heights = [0.0] if factor == "sin_beta" else [-g.l7, g.l7]
    points = np.meshgrid(np.array(heights), x, z, indexing="ij")
    return np.stack([points[1], points[0], points[2]], axis=-1)


def _torus(g: Geometry) -> FloatArray:
    """Return two grids of u x v positions of P, (2, u, v, 3) m, on a torus.

    In the first grid, leg 3 is stretched. In the second grid, leg 3 is folded.
    """
    turn = np.linspace(0, 2 * np.pi, 257)[:, None]
    tilt = np.arcsin(min(1.0, g.l7 / g.l4)) * np.linspace(-1, 1, _AROUND)
    parts = []
    for side in (1, -1):
        radius = g.l3 + side * g.l4 * np.cos(tilt)
        x, z = g.l1 - g.l2 + radius * np.cos(turn), g.l6 + radius * np.sin(turn)
        parts.append(np.stack(np.broadcast_arrays(x, g.l4 * np.sin(tilt), z), axis=-1))
    return np.stack(parts)


SURFACES: Final = {
    "parallel": ("sin_beta", "level3", "planar"),
    "serial": ("cos_beta", "leg1", "leg2", "leg3"),
    "constraint": ("elevation",),
}
"""Names of the factors by kind of singularity; each factor is zero on a singular surface."""


def grid_mesh(points: FloatArray) -> Mesh:
    """Join neighbouring points of k grids to triangles, and leave out NaN points.

    Args:
        points: (k, u, v, 3) m; each grid has u x v points.
    """
    real = ~np.isnan(points[..., 0])
    index = np.arange(real.size).reshape(real.shape)
    corners = index[:, :-1, :-1], index[:, 1:, :-1], index[:, 1:, 1:], index[:, :-1, 1:]
    quads = np.stack(corners, axis=-1).reshape(-1, 4)
    there = real.ravel()[quads]
    # A square with one missing corner gives one triangle, so that oblique boundaries have no teeth.
    missing = np.argmin(there, axis=1)[:, None]
    rest = np.take_along_axis(quads, (missing + [1, 2, 3]) % 4, axis=1)[there.sum(axis=1) == 3]
    faces = np.concatenate([_triangles(quads[there.all(axis=1)]), rest])
    return _compact(points.reshape(-1, 3), faces)


def slice_mesh(
    middle: Vector, reach: float, quality: Callable[[FloatArray], FloatArray]
) -> tuple[Mesh, FloatArray]:
    """Return the mesh of a square parallel to xz, and the quality at the mesh's vertices.

    The mesh has only the part of the square where the quality is positive.

    Args:
        middle: Middle of the square, m.
        reach: Half an edge of the square, m.
        quality: Function of points (..., 3) m with values (...,); NaN counts as 0.
    """
    steps, (x, y, z) = np.linspace(-reach, reach, _STEPS), middle
    points = np.stack(np.broadcast_arrays(x + steps, y, (z + steps)[:, None]), axis=-1)
    mesh = grid_mesh(clipped(points[None], lambda points: quality(points) > 0))
    return mesh, quality(mesh.vertices)


def cells_mesh(cells: Cells) -> Mesh:
    """Return the boundary of a set of cells, smoothed: corners move by less than a cell."""
    mask = np.pad(cells.mask, 1).astype(np.int8)
    nx, ny, nz = (n + 1 for n in mask.shape)
    index = np.arange(nx * ny * nz).reshape(nx, ny, nz)
    quads = []
    for axis in range(3):
        change = np.diff(mask, axis=axis)
        one, other = (np.eye(3, dtype=np.intp)[k] for k in range(3) if k != axis)
        around = [0 * one, one, one + other, other]
        for sign in (1, -1):
            start = np.argwhere(change == sign)
            start[:, axis] += 1
            # Corners run counter-clockwise as seen from outside; axis 1 needs the reverse order.
            forwards = (sign > 0) == (axis == 1)
            ring = around if forwards else around[::-1]
            quads.append(np.stack([index[tuple((start + step).T)] for step in ring], axis=1))
    corners = (np.moveaxis(np.indices(index.shape), 0, -1) - 1.0).reshape(-1, 3)
    faces = _triangles(np.concatenate(quads))
    mesh = _compact(np.asarray(cells.low) + corners * cells.spacing, faces)
    return Mesh(_smooth(mesh), mesh.faces)


def _triangles(quads: NDArray[Any]) -> NDArray[Any]:
    """Split each quadrilateral into two triangles."""
    return quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def _compact(points: FloatArray, faces: NDArray[Any]) -> Mesh:
    """Drop the points that no face uses, and renumber the faces."""
    used, renamed = np.unique(faces, return_inverse=True)
    return Mesh(points[used], renamed.reshape(faces.shape))


def _smooth(mesh: Mesh) -> FloatArray:
    """Move each vertex to the mean of its neighbours, a few times; return the vertices."""
    points, faces = mesh
    one = faces[:, [0, 1, 2]].ravel()
    other = faces[:, [1, 2, 0]].ravel()
    ends, starts = np.concatenate([one, other]), np.concatenate([other, one])
    count = np.bincount(ends, minlength=len(points))[:, None]
    for _ in range(_SMOOTHING):
        total = np.zeros_like(points)
        np.add.at(total, ends, points[starts])
        points = total / count
    return points
