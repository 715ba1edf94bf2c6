"""Forward and inverse kinematics of points and batches, in all modes or in one mode.

Positions are in the paper's frame; units are m and rad. :mod:`tpm_gym.kinematics.modes` names and
orders the modes. Torch tensors give tensors on the same device, in float64, which can be
differentiated. Where solutions merge, the derivative is 0 instead of infinite.

All functions raise InputError for inputs that are no array (..., 3) of numbers. If a vector (3,) of
the array is not finite, functions of all modes return invalid solutions for this vector, and
functions of one mode raise InputError. Functions of one mode raise UnreachableError if some vector
has no solution in this mode.
"""

import math
from typing import Any

from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, explained, finite_points, points
from tpm_gym.kinematics import equations
from tpm_gym.kinematics.geometry import PAPER, Geometry, require_geometry
from tpm_gym.kinematics.modes import (
    ASSEMBLY_MODES,
    DEFAULT_ASSEMBLY,
    ELBOWS_OUT,
    WORKING_MODES,
    AssemblyMode,
    ForwardSolutions,
    InverseSolutions,
    WorkingMode,
    require_mode,
)
from tpm_gym.kinematics.namespaces import Namespace, by_rows


def forward_all(theta: ArrayLike, geometry: Geometry = PAPER) -> ForwardSolutions:
    """Solve the forward kinematics in all 4 assembly modes, at actuated angles theta (..., 3) rad.

    A mode keeps its slot as theta changes. Its results are NaN where it has no solution; but
    where the mechanism closes for every beta, z is not NaN. For assemblies with link 3' turned, see
    :func:`.rotated.forward_rotated`.
    """
    require_geometry(geometry)
    angles = points("theta", theta)
    position, beta = by_rows(lambda t, ns: _assemblies(t, geometry, ns), angles)
    return ForwardSolutions(position, beta, beta == beta, geometry)


def inverse_all(position: ArrayLike, geometry: Geometry = PAPER) -> InverseSolutions:
    """Solve the inverse kinematics in all 16 working modes, for P at position (..., 3) m."""
    require_geometry(geometry)
    places = points("position", position)
    theta, beta = by_rows(lambda p, ns: _postures(p, geometry, ns), places)
    return InverseSolutions(theta, beta, beta == beta)


def forward(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> FloatArray:
    """Compute the position of P (..., 3) m at theta (..., 3) rad, in the assembly mode ``branch``.

    The default mode gives y > 0. ``AssemblyMode(-1, -1)`` gives the mirror image at y < 0. So
    ``forward(inverse(point))`` is the point only if the point is in the default mode. The mode of
    any point is ``ASSEMBLY_MODES[assembly_of(point)]``; see :func:`.workspace.assembly_of`.
    """
    return assembled(theta, branch, geometry).position[..., branch.index, :]


def inverse(
    position: ArrayLike, branch: WorkingMode = ELBOWS_OUT, geometry: Geometry = PAPER
) -> FloatArray:
    """Compute angles (..., 3) rad for P at position (..., 3) m, in the working mode ``branch``.

    :class:`.InverseSolutions` states the ranges of the angles.
    """
    require_mode(branch, WorkingMode)
    places = finite_points("position", position)
    solutions = inverse_all(places, geometry)
    valid = solutions.valid[..., branch.index]
    if not valid.all():
        raise explained(lambda p: equations.no_posture(p, branch, geometry), places, ~valid)
    return solutions.theta[..., branch.index, :]


def assembled(theta: ArrayLike, branch: AssemblyMode, geometry: Geometry) -> ForwardSolutions:
    """Compute all solutions; raise UnreachableError where ``branch`` has none."""
    require_mode(branch, AssemblyMode)
    angles = finite_points("theta", theta)
    solutions = forward_all(angles, geometry)
    valid = solutions.valid[..., branch.index]
    if not valid.all():
        raise explained(lambda a: equations.no_assembly(a, branch, geometry), angles, ~valid)
    return solutions


def _assemblies(theta: equations.Triple, g: Geometry, ns: Namespace) -> list[Any]:
    """Compute position and beta in all slots: solve for y > 0, and mirror the results to y < 0."""
    cos, sin = equations.arms(theta, g, ns)
    planar = ns.signs(theta[0], (2, 1))
    found, real, (reached, *_) = equations.assembly_at(cos, sin, planar, 1.0, g, ns)
    x, y, cos_beta = (
        ns.where(real, values, math.nan) for values in (found.x, found.y, found.cos_beta)
    )
    z = ns.where(reached, found.z, math.nan)
    beta = ns.arccos(cos_beta)
    slots = [((mode.planar + 1) // 2, (mode.sin_beta + 1) // 2) for mode in ASSEMBLY_MODES]
    y, beta = (-y, y), (-beta, beta)
    return [
        tuple((x[planar], y[side][planar], z[planar]) for planar, side in slots),
        tuple(beta[side][planar] for planar, side in slots),
    ]


def _postures(point: equations.Triple, g: Geometry, ns: Namespace) -> list[Any]:
    """Compute angles and beta in all slots: two bends of each leg, for both signs of cos(beta)."""
    sides, bends = ns.signs(point[0], (2, 1)), ns.signs(point[0], (2, 1, 1))
    theta, real, (*_, sin_beta), _ = equations.posture_at(
        point, (sides, bends, bends, bends), g, ns
    )
    acute = ns.arcsin(sin_beta)
    obtuse = ns.where(point[1] < 0, -math.pi - acute, math.pi - acute)
    beta = ns.where(real[0], obtuse, math.nan), ns.where(real[1], acute, math.nan)
    legs = [ns.where(real, leg, math.nan) for leg in theta]
    slots = [[(sign + 1) // 2 for sign in mode.signs] for mode in WORKING_MODES]
    return [
        tuple(
            tuple(leg[bend][side] for leg, bend in zip(legs, bent, strict=True))
            for side, *bent in slots
        ),
        tuple(beta[side] for side, *_ in slots),
    ]
