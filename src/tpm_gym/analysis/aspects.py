"""The reachable set of a working mode, and its aspects: maximal regions free of singularities.

The platform can move between two points of one aspect without a singularity (Wenger and Chablat).
Between two aspects of one working mode, every path passes a singularity. Sets are grids of cells in
the paper's frame, in metres. The singular planes y = 0 and |y| = l7 are faces of cells, so only
curved surfaces run through cells. All factors of :mod:`tpm_gym.analysis.singularity` are taken
into account. Other limits, such as the stops of the motors, are taken into account only if they are
given (:mod:`tpm_gym.analysis.limits`).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tpm_gym.analysis.limits import Limit
from tpm_gym.analysis.singularity import factors_at
from tpm_gym.arrays import BoolArray, FloatArray, IntArray, Vector, is_number, is_whole
from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.kinematics.modes import ELBOWS_OUT, AssemblyMode, WorkingMode
from tpm_gym.kinematics.workspace import Region, conditioning_at

Shape = tuple[int, int, int]

DEFAULT_SHAPE: Shape = (64, 16, 96)
"""Numbers of cells along x, y, z. With the paper's lengths, a cell is about 27 x 6 x 24 mm."""
_BITS = (1, 2, 4, 8)


@dataclass(frozen=True)
class Cells:
    """Set of points, as cells of a grid: those cells whose centres belong to the set.

    Attributes:
        low: Corner of the grid with the smallest x, y, z, m.
        spacing: Edges of a cell, m.
        mask: (nx, ny, nz) bool, true for cells of the set; y = 0 is in the middle of the grid.
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
        """Bound of the error of the volume, m^3: half the volume of cells at the curved boundary.

        The cells just inside this boundary and the cells just outside it are counted, and the
        larger number is used. The bound is proportional to the spacing. The error is mostly far
        smaller, because cells that add too much volume and cells that add too little cancel.
        """
        halves = np.array_split(np.pad(self.mask, ((1, 1), (0, 0), (1, 1))), 2, axis=1)
        inside = sum((half & _grown(~half, corners=False)).sum() for half in halves)
        outside = sum((~half & _grown(half, corners=False)).sum() for half in halves)
        return 0.5 * math.prod(self.spacing) * int(max(inside, outside))

    def centres(self) -> FloatArray:
        """Return the centres of the cells of the set, (count, 3) m."""
        centres: FloatArray = np.asarray(self.low) + (np.argwhere(self.mask) + 0.5) * self.spacing
        return centres


@dataclass(frozen=True)
class Aspect:
    """Connected region of one working mode without singularities, within all limits.

    Attributes:
        branch: Working mode: the signs of the serial factors.
        assembly: Assembly mode: the signs of sin(beta) and the planar factor.
        level3: Sign of the parallel factor l1 + l3 cos(theta_3) - xC - 2 l2.
        elevation: Sign of z_C1 - z_B1, which is zero at a constraint singularity.
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
    """Result of :func:`largest_box`.

    Attributes:
        region: The box. Its corners are centres of cells.
        volume: Volume of the box, m^3.
        conditioning: Smallest 1/cond(J) at the centres of the cells in the box.
    """

    region: Region
    volume: float
    conditioning: float


def reachable_set(
    branch: WorkingMode = ELBOWS_OUT,
    geometry: Geometry = PAPER,
    shape: Shape = DEFAULT_SHAPE,
    limits: tuple[Limit, ...] = (),
) -> Cells:
    """Find the points that have a posture on ``branch`` and respect all ``limits``.

    Args:
        branch: Working mode.
        shape: Numbers of cells along x, y, z: at least 2 each, and even along y. The grid holds
            every point that the rods reach.
        limits: For example :func:`~tpm_gym.analysis.limits.within_stops`.

    Raises:
        ConfigurationError: ``shape`` is not three such numbers.
    """
    low, spacing, codes = _codes(branch, geometry, shape, limits)
    return Cells(low, spacing, codes >= 0)


def aspects(
    branch: WorkingMode = ELBOWS_OUT,
    geometry: Geometry = PAPER,
    shape: Shape = DEFAULT_SHAPE,
    min_cells: int = 8,
    limits: tuple[Limit, ...] = (),
) -> tuple[Aspect, ...]:
    """Find all aspects of a working mode, the largest first.

    Two cells belong to one aspect if they share a face and all factors have the same signs at their
    centres. So a neck narrower than a cell divides an aspect, and a singular wall thinner than a
    cell may be missed: compare two grids. Points that ``limits`` forbid divide aspects too. Regions
    of fewer than ``min_cells`` cells are left out: they are fragments along curved boundaries.

    Raises:
        ConfigurationError: ``shape`` is not valid for :func:`reachable_set`, or ``min_cells`` is
            not a positive whole number.
    """
    low, spacing, codes = _codes(branch, geometry, shape, limits)
    found = []
    for code, cells in regions(low, spacing, codes, min_cells):
        sin_beta, level3, planar, elevation = (1 if code & bit else -1 for bit in _BITS)
        assembly = AssemblyMode(planar=planar, sin_beta=sin_beta)
        found.append(Aspect(branch, assembly, level3, elevation, geometry, limits, cells))
    return tuple(found)


def regions(
    low: Vector, spacing: Vector, codes: IntArray, min_cells: int
) -> Iterator[tuple[int, Cells]]:
    """Find the connected regions of cells with equal codes, and yield the largest region first.

    Args:
        low: Corner of the grid with the smallest x, y, z, m.
        spacing: Edges of a cell, m.
        codes: (nx, ny, nz) code of each cell, such as the signs of its factors as bits; negative
            for cells that belong to no region.
        min_cells: Fewest cells of a region.

    Yields:
        The code and the cells of a region.

    Raises:
        ConfigurationError: min_cells is no positive whole number.
    """
    if not is_whole(min_cells, 1):
        raise ConfigurationError("min_cells", min_cells, "a whole number from 1 up")
    labels = components(codes)
    names, first, counts = np.unique(labels, return_index=True, return_counts=True)
    for index in np.argsort(-counts, kind="stable"):
        code = int(codes.flat[first[index]])
        if code >= 0 and counts[index] >= min_cells:
            yield code, Cells(low, spacing, labels == names[index])


def sample(rng: np.random.Generator, aspect: Aspect, count: int) -> FloatArray:
    """Sample points (count, 3) m, uniform over an aspect, not only over its cells.

    Points are drawn in the aspect's cells and their neighbours, and kept if all factors have the
    signs of the aspect. So parts of the aspect beyond the neighbouring cells are missing, and
    nearby points of other regions with the same signs are included. Apart from these two errors,
    the points fill the aspect exactly up to its boundary.

    Raises:
        ConfigurationError: count is negative, or the aspect has no cells.
    """
    cells = aspect.cells
    if not is_whole(count, 0):
        raise ConfigurationError("count", count, "a whole number, 0 or more")
    if not cells.mask.any():
        raise ConfigurationError("aspect", "without cells", "an aspect that aspects() returned")
    candidates = np.argwhere(_grown(cells.mask))
    where = aspect.branch, aspect.geometry, aspect.limits
    code = _signs(cells.centres()[0], *where)
    points = np.empty((0, 3))
    while len(points) < count:
        corner = candidates[rng.integers(len(candidates), size=count)]
        draws = np.asarray(cells.low) + (corner + rng.random((count, 3))) * cells.spacing
        points = np.concatenate([points, draws[_signs(draws, *where) == code]])
    return points[:count]


def largest_box(aspect: Aspect, threshold: float) -> Box:
    """Find the largest axis-aligned box in an aspect with 1/cond(J) >= threshold.

    The nodes of the grid are the centres of cells. The corners of a box are nodes, and all nodes in
    the box are in the aspect and have 1/cond(J) >= threshold. The largest such box is returned. The
    conditioning between nodes is not checked; it varies little from node to node.

    Raises:
        ConfigurationError: The threshold is not between 0 and 1, or no box of at least two nodes
            along each axis meets it.
    """
    if not is_number(threshold) or not 0 <= threshold <= 1:
        raise ConfigurationError("threshold", threshold, "between 0 and 1")
    cells = aspect.cells
    conditioning = np.full(cells.mask.shape, -1.0)
    conditioning[cells.mask] = conditioning_at(
        cells.centres(), aspect.branch, aspect.assembly, aspect.geometry
    )
    corners = largest_block(conditioning >= threshold)
    if corners is None:
        raise ConfigurationError("threshold", threshold, "a value that a box of this aspect meets")
    low, high = np.asarray(cells.low) + (np.array(corners) + 0.5) * cells.spacing
    inside = tuple(slice(a, b + 1) for a, b in zip(*corners, strict=True))
    region = Region(low=tuple(low.tolist()), high=tuple(high.tolist()))
    return Box(region, float((high - low).prod()), float(conditioning[inside].min()))


def require_shape(shape: object, least: int) -> None:
    """Raise ConfigurationError unless ``shape`` is three whole numbers of at least ``least``."""
    counts = list(shape) if isinstance(shape, (tuple, list, np.ndarray)) else []
    if len(counts) != 3 or not all(is_whole(count, least) for count in counts):
        raise ConfigurationError("shape", shape, f"three whole numbers from {least} up")


def _codes(
    branch: WorkingMode, geometry: Geometry, shape: Shape, limits: tuple[Limit, ...]
) -> tuple[Vector, Vector, IntArray]:
    """Return corner and spacing of the grid, and :func:`_signs` at the centres of its cells."""
    require_shape(shape, 2)
    if shape[1] % 2:
        raise ConfigurationError("shape", shape, "an even number along y")
    l1, l2, l3, l4, l5, l6, l7 = geometry.lengths
    reach = l3 + l4
    # Leg 2 stays in the plane of its arm, rod 1 spans x_C, and leg 3 stays within a torus.
    x_low = max(l2 - l7 - l4, l2 - l7 + 2 * l5 - l1 - reach, l1 - l2 - reach)
    x_high = min(l2 + l7 + l4, l2 + l7 + 2 * l5 - l1 + reach, l1 - l2 + reach)
    low, high = np.array([x_low, -l7, l6 - reach]), np.array([x_high, l7, 2 * l6 + reach])
    if x_low >= x_high:  # nothing is reachable; any grid shows this
        low[0], high[0] = l2 - l7 - l4, l2 + l7 + l4
    spacing = (high - low) / shape
    points = low + (np.moveaxis(np.indices(shape), 0, -1) + 0.5) * spacing
    corner, edges = tuple(low.tolist()), tuple(spacing.tolist())
    return corner, edges, _signs(points, branch, geometry, limits)


def _signs(
    points: FloatArray, branch: WorkingMode, geometry: Geometry, limits: tuple[Limit, ...]
) -> IntArray:
    """Return an integer for each point, whose bits are the signs of four singular factors.

    The bits 1, 2, 4 and 8 are set where ``sin_beta``, ``level3``, ``planar`` and ``elevation`` of
    :class:`~tpm_gym.kinematics.Factors` are positive. The integer is -1 for points that are out of
    reach or beyond a limit.
    """
    found = factors_at(points, branch, geometry)
    values = np.stack([found.sin_beta, found.level3, found.planar, found.elevation], axis=-1)
    codes: IntArray = np.where(np.isnan(values[..., 0]), -1, (values > 0) @ _BITS)
    for limit in limits:
        kept = codes >= 0
        codes[kept] = np.where(limit(points[kept], branch, geometry), codes[kept], -1)
    return codes


_NEIGHBOURS = [
    tuple((slice(None),) * axis + (part,) for part in (slice(None, -1), slice(1, None)))
    for axis in range(3)
]  # for each axis, two views of a grid; cells at equal indices share a face


def components(codes: IntArray) -> IntArray:
    """Label the connected sets of cells with equal codes.

    Two cells are connected if they have a common face and equal codes. The method is union-find,
    applied to all such pairs of cells at once.
    """
    parent = np.arange(codes.size)
    index = parent.reshape(codes.shape)
    joined = [(a, b, codes[a] == codes[b]) for a, b in _NEIGHBOURS]
    one = np.concatenate([index[before][same] for before, _, same in joined])
    other = np.concatenate([index[after][same] for _, after, same in joined])
    while True:
        roots = parent[one], parent[other]
        if (roots[0] == roots[1]).all():
            return parent.reshape(codes.shape)
        # The smaller root of each pair becomes the parent of the larger. Then all paths are halved
        # until every cell points at its root.
        np.minimum.at(parent, np.maximum(*roots), np.minimum(*roots))
        while (parent != parent[parent]).any():
            parent = parent[parent]


def _grown(mask: BoolArray, corners: bool = True) -> BoolArray:
    """Return a set of cells, extended by all cells that share a face with it.

    If ``corners``, it is extended by all cells that share at least a corner with it.
    """
    grown: BoolArray = mask.copy()
    for before, after in _NEIGHBOURS:
        reached = grown.copy() if corners else mask
        grown[before] |= reached[after]
        grown[after] |= reached[before]
    return grown


def largest_block(mask: BoolArray) -> tuple[Shape, Shape] | None:
    """Return the first and last node of the largest block in which all nodes are true.

    A block has at least two nodes along each axis. Return None if there is no block.
    """
    # For each range of y and each width in x, find the longest run along z that is true over both.
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
