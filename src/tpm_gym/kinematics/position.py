"""Forward and inverse kinematics of points and batches, on all branches or on a named one.

Frames are the paper's; units are m and rad. Branches are named and ordered in
:mod:`tpm_gym.kinematics.modes`. Torch tensors give tensors, on their device and in float64, that
can be differentiated. Where branches merge, the derivative is 0 instead of infinite.

All functions raise InputError for inputs that are no array (..., 3) of numbers. Functions on all
branches return invalid branches for entries that are not finite. Functions on one branch raise
InputError for them, and UnreachableError if the branch does not exist for some entry.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, finite_points, points
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
    PassiveAngles,
    WorkingMode,
)
from tpm_gym.kinematics.namespaces import Namespace, by_rows, namespace_of

# Which columns of _assemblies a slot holds: x, y, -y, z, beta, -beta, of both planar signs each
_PLANAR = np.array([(mode.planar + 1) // 2 for mode in ASSEMBLY_MODES])
_MIRRORED = np.array([2 * (mode.sin_beta < 0) for mode in ASSEMBLY_MODES])
_POSITION = np.stack([_PLANAR, _PLANAR + 2 + _MIRRORED, _PLANAR + 6], axis=-1)
_BETA = _PLANAR + 8 + _MIRRORED
# Which columns of _postures: for each leg, for each bend, both signs of cos(beta); then beta
_ANGLES = np.array(
    [
        [4 * leg + (bend + 1) + (mode.cos_beta + 1) // 2 for leg, bend in enumerate(mode.signs[1:])]
        for mode in WORKING_MODES
    ]
)
_ANGLE_BETA = np.array([12 + (mode.cos_beta + 1) // 2 for mode in WORKING_MODES])


def forward_all(theta: ArrayLike, geometry: Geometry = PAPER) -> ForwardSolutions:
    """Solve the forward kinematics on all 4 branches, at actuated angles theta (..., 3) rad.

    A branch keeps its slot as theta moves, and holds NaN where it is not real, but for z where
    beta is free. Link 3' translates; assemblies with link 3' turned are those of
    :func:`.rotated.forward_rotated`.
    """
    require_geometry(geometry)
    angles = points("theta", theta)
    position, beta = by_rows(lambda t, ns: _assemblies(t, geometry, ns), angles, _POSITION, _BETA)
    return ForwardSolutions(position, beta, beta == beta, geometry)


def inverse_all(position: ArrayLike, geometry: Geometry = PAPER) -> InverseSolutions:
    """Solve the inverse kinematics on all 16 branches, for point P at position (..., 3) m."""
    require_geometry(geometry)
    places = points("position", position)
    theta, beta = by_rows(lambda p, ns: _postures(p, geometry, ns), places, _ANGLES, _ANGLE_BETA)
    return InverseSolutions(theta, beta, beta == beta)


def forward(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> FloatArray:
    """Compute the position of P (..., 3) m at theta (..., 3) rad, on one named branch.

    The default branch gives y > 0; ``AssemblyMode(-1, -1)`` gives its mirror image.
    """
    return _assembled(points("theta", theta), branch, geometry).position[..., branch.index, :]


def inverse(
    position: ArrayLike, branch: WorkingMode = ELBOWS_OUT, geometry: Geometry = PAPER
) -> FloatArray:
    """Compute angles (..., 3) rad, in the ranges of :class:`.InverseSolutions`, on one branch."""
    places = points("position", position)
    solutions = inverse_all(finite_points("position", places), geometry)
    valid = solutions.valid[..., branch.index]
    if not valid.all():
        a, b, c = places[~valid][0].tolist()
        raise equations.no_posture((a, b, c), branch, geometry)
    return solutions.theta[..., branch.index, :]


def passive_angles(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> PassiveAngles:
    """Compute the directions of all passive links at theta (..., 3) rad, on one named branch."""
    angles = points("theta", theta)
    solutions, slot = _assembled(angles, branch, geometry), branch.index
    ns, beta, l4 = namespace_of(angles), solutions.beta[..., slot], geometry.l4
    x, y, z = (solutions.position[..., slot, axis] for axis in range(3))
    x_c, z_c = (solutions.link3[..., slot, axis] for axis in range(2))
    cos, sin = equations.arms((angles[..., 0], angles[..., 1], angles[..., 2]), geometry, ns)
    found = equations.Assembly(x, y, z, x_c, z_c, ns.cos(beta), ns.sin(beta))
    (r1x, r1y, r1z), (r2x, _, r2z), (r3x, r3y, r3z) = equations.rods(cos, sin, found, geometry)
    return PassiveAngles(
        beta=beta,
        rod4_swing=ns.arctan2(r1z, r1y),
        rod4_tilt=ns.arcsin(r1x / l4),
        rod6_swing=ns.arctan2(r2z, r2x),
        rod11_swing=ns.arctan2(r3z, r3x),
        rod11_tilt=ns.arcsin(r3y / l4),
    )


def _assembled(theta: FloatArray, branch: AssemblyMode, geometry: Geometry) -> ForwardSolutions:
    """Compute all solutions, where those of ``branch`` have to exist."""
    solutions = forward_all(finite_points("theta", theta), geometry)
    valid = solutions.valid[..., branch.index]
    if not valid.all():
        a, b, c = theta[~valid][0].tolist()
        raise equations.no_assembly((a, b, c), branch, geometry)
    return solutions


def _assemblies(theta: equations.Triple, g: Geometry, ns: Namespace) -> list[Any]:
    """Compute both planar signs; the other half is the mirror image."""
    cos, sin = equations.arms(theta, g, ns)
    planar = ns.signs(theta[0], (2, 1))
    found, real, (reached, *_) = equations.assembly_at(cos, sin, planar, 1.0, g, ns)
    x, y, cos_beta = (
        ns.where(real, values, math.nan) for values in (found.x, found.y, found.cos_beta)
    )
    z = ns.where(reached, found.z, math.nan)
    beta = ns.arccos(cos_beta)
    return [*x, *y, *-y, *z, *beta, *-beta]


def _postures(point: equations.Triple, g: Geometry, ns: Namespace) -> list[Any]:
    """Compute two bends of each leg, for both signs of cos(beta)."""
    sides, bends = ns.signs(point[0], (2, 1)), ns.signs(point[0], (2, 1, 1))
    theta, real, (*_, sin_beta), _ = equations.posture_at(
        point, (sides, bends, bends, bends), g, ns
    )
    acute = ns.arcsin(sin_beta)
    obtuse = ns.where(point[1] < 0, -math.pi - acute, math.pi - acute)
    angles = [row for leg in theta for both in ns.where(real, leg, math.nan) for row in both]
    return [*angles, ns.where(real[0], obtuse, math.nan), ns.where(real[1], acute, math.nan)]
