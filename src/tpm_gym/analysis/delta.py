"""Topology, workspace and aspects of the Delta, computed by the same methods as for the TPM."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.analysis.aspects import Cells, Shape, regions, require_shape
from tpm_gym.analysis.poc import Chain, parallelogram_4r, parallelogram_4s, revolute
from tpm_gym.arrays import FloatArray, IntArray, vector
from tpm_gym.kinematics.equations import Triple
from tpm_gym.kinematics.namespaces import NUMPY
from tpm_gym.mechanism.delta.bodies import LEGS, build
from tpm_gym.mechanism.delta.equations import outwards, pose_at
from tpm_gym.mechanism.delta.geometry import (
    ELBOWS_OUT,
    IRB_360,
    WORKING_MODES,
    DeltaGeometry,
    require_bends,
    require_delta,
    require_side,
)
from tpm_gym.mechanism.delta.kinematics import factors_at, inverse_all, no_assembly


def chains(
    theta: ArrayLike, side: float = 1.0, geometry: DeltaGeometry = IRB_360, balls: bool = True
) -> tuple[list[Chain], FloatArray]:
    """Return the legs and P (3,) m at theta (3,) rad, for :func:`tpm_gym.analysis.poc.analyse`.

    Args:
        theta: Joint positions.
        side: Assembly mode, the sign of det A.
        balls: If True, each leg consists of a motor and a parallelogram with ball joints, as in the
            package's Delta. If False, it consists of a motor, a revolute, a parallelogram with
            revolutes, and another revolute.

    Raises:
        InputError: If theta is not three finite numbers.
        UnreachableError: If the Delta cannot be assembled at theta.
    """
    require_delta(geometry)
    require_side(side)
    angles, g = vector("theta", theta), geometry
    pose, real = pose_at(tuple(map(np.float64, angles)), side, g, NUMPY)
    if not real:
        raise no_assembly(angles, side, g)
    found = []
    rows = zip(LEGS.items(), pose.cos, pose.sin, pose.bars, strict=True)
    for (number, leg), cos, sin, rod in rows:
        here = (0.0, -1.0, 0.0), (g.l1, 0.0, 0.0), (g.l1 + cos, 0.0, sin)
        hinge, pivot, elbow = (np.array(outwards(leg, one)) for one in here)
        bar, units = np.array(rod), [revolute(f"R{number}", hinge, pivot, True)]
        if balls:
            units.append(parallelogram_4s("Pa(4S)", hinge, bar, elbow + bar))
        else:
            middle = parallelogram_4r("Pa(4R)", hinge, bar, elbow + bar)
            units += [revolute("R", hinge, elbow), middle, revolute("R", hinge, elbow + bar)]
        found.append(Chain(f"leg {number}", tuple(units)))
    return found, np.array(pose.position)


@dataclass(frozen=True)
class Aspect:
    """Connected region of one working mode without singularities.

    Attributes:
        assembly: Assembly mode, the sign of det A.
        constraint: Sign of det [n1 n2 n3], where n_i is the normal of the parallelogram of leg i.
        cells: Cells of the region.
    """

    assembly: int
    constraint: int
    cells: Cells


def reachable_set(
    bends: Triple = ELBOWS_OUT,
    geometry: DeltaGeometry = IRB_360,
    shape: Shape = (96, 96, 96),
    within_stops: bool = False,
) -> Cells:
    """Find the points that have a posture in a working mode; see :func:`aspects`."""
    low, spacing, codes = _codes(bends, geometry, shape, within_stops)
    return Cells(low, spacing, codes >= 0)


def aspects(
    bends: Triple = ELBOWS_OUT,
    geometry: DeltaGeometry = IRB_360,
    shape: Shape = (96, 96, 96),
    within_stops: bool = False,
    min_cells: int = 8,
) -> tuple[Aspect, ...]:
    """Find all aspects of a working mode, the largest first.

    :func:`tpm_gym.analysis.aspects.aspects` says what a grid can miss.

    Args:
        bends: Working mode.
        shape: Numbers of cells along x, y, z of a grid that holds every point in reach.
        within_stops: Whether to leave out points where a motor is beyond its stop.
        min_cells: Fewest cells of an aspect.

    Raises:
        ConfigurationError: ``shape`` is not three whole numbers of at least 2, or ``min_cells`` is
            not a positive whole number.
        InputError: ``bends`` is not three signs, each 1 or -1, or ``geometry`` is no DeltaGeometry.
    """
    grid = _codes(bends, geometry, shape, within_stops)
    return tuple(
        Aspect(2 * (code & 1) - 1, (code & 2) - 1, cells)
        for code, cells in regions(*grid, min_cells)
    )


def _codes(
    bends: Triple, geometry: DeltaGeometry, shape: Shape, within_stops: bool
) -> tuple[Triple, Triple, IntArray]:
    """Return corner and spacing of the grid, and an integer for each cell.

    The bits 1 and 2 are set where det A and det [n1 n2 n3] (see :class:`Aspect`) are positive at
    the centre of the cell. The integer is -1 if the centre is out of reach or, with
    ``within_stops``, beyond a stop.
    """
    require_delta(geometry)
    require_shape(shape, 2)
    far, aside = geometry.l3 + geometry.l4, abs(geometry.l1 - geometry.l2)
    low = -np.array([far + aside, far + aside, far])
    spacing = -2 * low / shape
    points = low + (np.moveaxis(np.indices(shape), 0, -1) + 0.5) * spacing
    found = factors_at(points, bends, geometry)
    values = np.stack([found.parallel, found.constraint], axis=-1)
    there = ~np.isnan(values[..., 0])
    if within_stops:
        theta = inverse_all(points, geometry)[..., WORKING_MODES.index(require_bends(bends)), :]
        low_stops, high_stops = np.array(build(geometry).stops).T
        there &= ((theta >= low_stops) & (theta <= high_stops)).all(axis=-1)
    codes: IntArray = np.where(there, (values > 0) @ (1, 2), -1)
    return tuple(low.tolist()), tuple(spacing.tolist()), codes
