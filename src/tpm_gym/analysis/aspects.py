"""The reachable set of a working mode, and its aspects: maximal regions free of singularities.

Between two points of one aspect (Wenger and Chablat) the platform can go without meeting a
singularity; between two aspects of one working mode it cannot. All sets are in Cartesian space, in
the paper frame, in metres, and held as cells of a grid whose cells have faces on the singular
planes y = 0 and |y| = l7, so that only curved surfaces are cut by cells.

Singularities are those of all factors of :mod:`tpm_gym.analysis.singularity`, the constraint's
among them. What the motors' stops and the links' own bodies forbid is left out only where
``limits`` ask for it, see :mod:`tpm_gym.analysis.limits`.
"""

import math
from dataclasses import dataclass

import numpy as np

from tpm_gym.analysis.limits import Limit
from tpm_gym.analysis.singularity import factors_at
from tpm_gym.arrays import BoolArray, FloatArray, IntArray, Vector
from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.kinematics.modes import ELBOWS_OUT, AssemblyMode, WorkingMode
from tpm_gym.kinematics.workspace import Region, conditioning_at

Shape = tuple[int, int, int]

DEFAULT_SHAPE: Shape = (64, 16, 96)
"""Cells along x, y, z; for the paper's lengths about 27 x 6 x 24 mm each."""
_BITS = (1, 2, 4, 8)


@dataclass(frozen=True)
class Cells:
    """A set of points, as the cells of a grid whose centres belong to it.

    Attributes:
        low: Corner of the grid with the smallest x, y, z, m.
        spacing: Edges of a cell, m.
        mask: (nx, ny, nz) bool, which cells belong to the set. The plane y = 0 runs between the
            cells ny / 2 - 1 and ny / 2.
    """

    low: Vector
    spacing: Vector
    mask: BoolArray

    @property
    def volume(self) -> float:
        """Volume of the cells, m^3."""
        return math.prod(self.spacing) * int(self.mask.sum())

    @property
    def volume_error(self) -> float:
        """What the grid can hide, m^3: half the volume of the cells along the curved boundary.

        It falls in proportion to the spacing; the actual error is mostly far smaller, since cells
        judged too full and too empty cancel. The planes y = 0 and |y| = l7 are faces of cells and
        add nothing.
        """
        halves = np.array_split(np.pad(self.mask, ((1, 1), (0, 0), (1, 1))), 2, axis=1)
        inside = sum((half & _grown(~half, corners=False)).sum() for half in halves)
        outside = sum((~half & _grown(half, corners=False)).sum() for half in halves)
        return 0.5 * math.prod(self.spacing) * int(max(inside, outside))

    def centres(self) -> FloatArray:
        """Centres of the cells of the set, (count, 3) m."""
        centres: FloatArray = np.asarray(self.low) + (np.argwhere(self.mask) + 0.5) * self.spacing
        return centres


@dataclass(frozen=True)
class ReachableSet:
    """Where point P can be on one working mode."""

    branch: WorkingMode
    geometry: Geometry
    cells: Cells


@dataclass(frozen=True)
class Aspect:
    """A connected region of one working mode without singularities.

    Attributes:
        branch: Names the signs of the serial factors.
        assembly: Names the signs of sin(beta) and the planar factor.
        level3: Sign of the third parallel factor, l1 + l3 c3 - xC - 2 l2.
        elevation: Sign of the constraint's factor, z_C1 - z_B1.
        limits: Within which all of it is.
    """

    branch: WorkingMode
    assembly: AssemblyMode
    level3: int
    elevation: int
    geometry: Geometry
    limits: tuple[Limit, ...]
    cells: Cells


@dataclass(frozen=True)
class Box:
    """What :func:`largest_box` returns.

    Attributes:
        region: The box; its corners are nodes of the grid.
        volume: Its volume, m^3.
        conditioning: The smallest 1/cond(J) over the nodes in it.
    """

    region: Region
    volume: float
    conditioning: float


def reachable_set(
    branch: WorkingMode = ELBOWS_OUT,
    geometry: Geometry = PAPER,
    shape: Shape = DEFAULT_SHAPE,
    limits: tuple[Limit, ...] = (),
) -> ReachableSet:
    """The points that have a posture on ``branch``, as cells of a grid over all that rods reach.

    ``shape`` counts cells along x, y, z: at least 2 each, along y an even number. ``limits`` such
    as :func:`~tpm_gym.analysis.limits.within_stops` have to allow the posture.

    Raises:
        ConfigurationError: If the shape is not possible.
    """
    low, spacing, codes = _codes(branch, geometry, shape, limits)
    return ReachableSet(branch, geometry, Cells(low, spacing, codes >= 0))


def aspects(
    branch: WorkingMode = ELBOWS_OUT,
    geometry: Geometry = PAPER,
    shape: Shape = DEFAULT_SHAPE,
    min_cells: int = 8,
    limits: tuple[Limit, ...] = (),
) -> tuple[Aspect, ...]:
    """All aspects of a working mode, the largest first.

    Cells belong together if they share a face and all factors have the same signs at their centres.
    So regions joined by a neck narrower than a cell come out as several, and a wall of singular
    points thinner than a cell may be overlooked: compare two grids. Regions of fewer than
    ``min_cells`` cells are dropped: crumbs along curved boundaries. What ``limits`` forbid divides
    them too.

    Raises:
        ConfigurationError: If the shape is not possible, or min_cells is not positive.
    """
    if min_cells < 1:
        raise ConfigurationError("min_cells", min_cells, "at least 1")
    low, spacing, codes = _codes(branch, geometry, shape, limits)
    labels = _components(codes)
    names, first, counts = np.unique(labels, return_index=True, return_counts=True)
    found = []
    for index in np.argsort(-counts, kind="stable"):
        code = int(codes.flat[first[index]])
        if code >= 0 and counts[index] >= min_cells:
            sin_beta, level3, planar, elevation = (1 if code & bit else -1 for bit in _BITS)
            found.append(
                Aspect(
                    branch=branch,
                    assembly=AssemblyMode(planar=planar, sin_beta=sin_beta),
                    level3=level3,
                    elevation=elevation,
                    geometry=geometry,
                    limits=limits,
                    cells=Cells(low, spacing, labels == names[index]),
                )
            )
    return tuple(found)


def sample(rng: np.random.Generator, aspect: Aspect, count: int) -> FloatArray:
    """Draw points (count, 3) m, uniform over an aspect, not only over its cells.

    Draws from the aspect's cells and those around them, and keeps the points whose factors have the
    aspect's signs. So the boundary is the true one, except that a part of it which strays more than
    a cell from the aspect's cells is missing, and that another region with the same signs less than
    a cell away would be let in.

    Raises:
        ConfigurationError: If count is negative, or if the aspect has no cells.
    """
    cells = aspect.cells
    if count < 0:
        raise ConfigurationError("count", count, "0 or more")
    if not cells.mask.any():
        raise ConfigurationError("aspect", "without cells", "an aspect that aspects() returned")
    candidates = np.argwhere(_grown(cells.mask))
    assembly = aspect.assembly
    signs = assembly.sin_beta, aspect.level3, assembly.planar, aspect.elevation
    code = sum(bit for sign, bit in zip(signs, _BITS, strict=True) if sign > 0)
    points = np.empty((0, 3))
    while len(points) < count:
        corner = candidates[rng.integers(len(candidates), size=count)]
        draws = np.asarray(cells.low) + (corner + rng.random((count, 3))) * cells.spacing
        kept = _signs(draws, aspect.branch, aspect.geometry, aspect.limits) == code
        points = np.concatenate([points, draws[kept]])
    return points[:count]


def largest_box(aspect: Aspect, threshold: float) -> Box:
    """The largest axis-aligned box in an aspect whose conditioning is good enough throughout.

    Exact on the grid: no box with nodes (centres of cells) as corners, all of whose nodes belong to
    the aspect and have 1/cond(J) >= threshold, is larger. The box ends at the outermost nodes, so
    every face was looked at; between the nodes the conditioning is not known, but it varies little
    from node to node.

    Raises:
        ConfigurationError: If the threshold is not between 0 and 1, or if no box of at least two
            nodes along every axis meets it.
    """
    if not 0 <= threshold <= 1:
        raise ConfigurationError("threshold", threshold, "between 0 and 1")
    cells = aspect.cells
    conditioning = np.full(cells.mask.shape, -1.0)
    conditioning[cells.mask] = conditioning_at(
        cells.centres(), aspect.branch, aspect.assembly, aspect.geometry
    )
    corners = _largest_block(conditioning >= threshold)
    if corners is None:
        raise ConfigurationError("threshold", threshold, "a value that a box of this aspect meets")
    first, last = corners
    low, high = (
        np.asarray(cells.low) + (np.asarray(corner) + 0.5) * cells.spacing for corner in corners
    )
    inside = tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))
    return Box(
        Region(low=tuple(low.tolist()), high=tuple(high.tolist())),
        volume=float((high - low).prod()),
        conditioning=float(conditioning[inside].min()),
    )


def _codes(
    branch: WorkingMode, geometry: Geometry, shape: Shape, limits: tuple[Limit, ...]
) -> tuple[Vector, Vector, IntArray]:
    """Corner and spacing of the grid, and the signs at the centres of its cells."""
    if len(shape) != 3 or any(int(n) != n or n < 2 for n in shape) or shape[1] % 2:
        raise ConfigurationError("shape", shape, "three integers from 2 up, that along y even")
    l1, l2, l3, l4, l5, l6, l7 = geometry.lengths
    reach = l3 + l4
    # Leg 2 is in the plane of its arm; rod 1 spans x_C and leg 3 is within a torus.
    x_low = max(l2 - l7 - l4, l2 - l7 + 2 * l5 - l1 - reach, l1 - l2 - reach)
    x_high = min(l2 + l7 + l4, l2 + l7 + 2 * l5 - l1 + reach, l1 - l2 + reach)
    low, high = np.array([x_low, -l7, l6 - reach]), np.array([x_high, l7, 2 * l6 + reach])
    if x_low >= x_high:  # nothing can be reached; any box will show it
        low[0], high[0] = l2 - l7 - l4, l2 + l7 + l4
    spacing = (high - low) / shape
    points = low + (np.moveaxis(np.indices(shape), 0, -1) + 0.5) * spacing
    corner, edges = tuple(low.tolist()), tuple(spacing.tolist())
    return corner, edges, _signs(points, branch, geometry, limits)


def _signs(
    points: FloatArray, branch: WorkingMode, geometry: Geometry, limits: tuple[Limit, ...]
) -> IntArray:
    """Signs of sin(beta), level3, planar, elevation as bits; -1 where P cannot be."""
    found = factors_at(points, branch, geometry)
    values = np.concatenate([found.parallel, found.constraint[..., None]], axis=-1)
    codes: IntArray = np.where(
        np.isnan(values[..., 0]), -1, ((values > 0) * np.array(_BITS)).sum(axis=-1)
    )
    for limit in limits:
        kept = codes >= 0
        codes[kept] = np.where(limit(points[kept], branch, geometry), codes[kept], -1)
    return codes


def _neighbours(shape: tuple[int, ...]) -> list[tuple[tuple[slice, ...], tuple[slice, ...]]]:
    """Pairs of views of a grid whose entries share a face, one pair an axis."""
    pairs = []
    for axis in range(len(shape)):
        before, after = [slice(None)] * len(shape), [slice(None)] * len(shape)
        before[axis], after[axis] = slice(None, -1), slice(1, None)
        pairs.append((tuple(before), tuple(after)))
    return pairs


def _components(codes: IntArray) -> IntArray:
    """Labels of the connected sets of equal codes: union-find on all faces at once."""
    parent = np.arange(codes.size)
    index = parent.reshape(codes.shape)
    first, second = [], []
    for before, after in _neighbours(codes.shape):
        joined = codes[before] == codes[after]
        first.append(index[before][joined])
        second.append(index[after][joined])
    one, other = np.concatenate(first), np.concatenate(second)
    while True:
        roots = parent[one], parent[other]
        if (roots[0] == roots[1]).all():
            return parent.reshape(codes.shape)
        # The larger root of each open pair is hung below the smaller, then all paths are halved
        # until everyone points at its root.
        np.minimum.at(parent, np.maximum(*roots), np.minimum(*roots))
        while (parent != parent[parent]).any():
            parent = parent[parent]


def _grown(mask: BoolArray, corners: bool = True) -> BoolArray:
    """The cells of a set and all that touch them: at a face, or be it at a corner."""
    grown: BoolArray = mask.copy()
    for before, after in _neighbours(mask.shape):
        reached = grown.copy() if corners else mask
        grown[before] |= reached[after]
        grown[after] |= reached[before]
    return grown


def _largest_block(mask: BoolArray) -> tuple[Shape, Shape] | None:
    """First and last node of the largest all-true block, by (nx - 1)(ny - 1)(nz - 1).

    For every range of y the nodes that are true throughout it; for every width in x the columns
    true throughout that width; in those the longest run along z. None if no block has a volume.
    """
    nx, ny, nz = mask.shape
    count = np.cumsum(np.pad(mask, ((0, 0), (1, 0), (0, 0))), axis=1)
    position = np.arange(nz)
    best, corners = 0, None
    for depth in range(ny - 1, 0, -1):
        for y in range(ny - depth):
            layer: BoolArray = count[:, y + depth + 1] - count[:, y] == depth + 1
            strip: BoolArray = layer
            for width in range(1, nx):
                strip = strip[:-1] & layer[width:]
                if not strip.any():
                    break
                if depth * width * (nz - 1) <= best:
                    continue
                ends = np.maximum.accumulate(np.where(strip, -1, position), axis=1)
                runs = position - ends
                x, z = np.unravel_index(int(runs.argmax()), runs.shape)
                run = int(runs[x, z])
                if depth * width * (run - 1) > best:
                    best = depth * width * (run - 1)
                    last = int(x) + width, y + depth, int(z)
                    corners = (int(x), y, int(z) - run + 1), last
    return corners
