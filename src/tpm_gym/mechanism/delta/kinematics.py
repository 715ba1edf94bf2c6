"""Kinematics of the Delta for arrays and tensors.

Points (m) and joint positions (rad) are arrays (..., 3), or tensors, which can be differentiated.
Results are NaN where there is no solution. All functions raise InputError for arrays of another
shape, and for numbers that are not finite.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import BoolArray, FloatArray, Vector, finite_points
from tpm_gym.errors import SingularityError, UnreachableError
from tpm_gym.kinematics.equations import LEAST, Triple, leg_margin
from tpm_gym.kinematics.equations import arms as arms_at
from tpm_gym.kinematics.equations import conditioning as conditioning_of
from tpm_gym.kinematics.namespaces import NUMPY, Namespace, Numbers, by_rows
from tpm_gym.mechanism.delta.equations import (
    ONE,
    THREE,
    TWO,
    Pose,
    assembly_at,
    inwards,
    pose_at,
    pose_of,
    posture_at,
    regular,
    velocity,
)
from tpm_gym.mechanism.delta.geometry import (
    ASSEMBLY_MODES,
    ELBOWS_OUT,
    IRB_360,
    WORKING_MODES,
    AnyDelta,
    DeltaGeometry,
    require_bends,
    require_delta,
    require_side,
)


class Factors(NamedTuple):
    """Factors without a unit; each factor is zero at the singularities of its kind.

    Attributes:
        parallel: (...,) det A divided by l4^3; zero where the rods are parallel to one plane.
        serial: (..., 3) B_iC_i . dB_i/dtheta_i divided by l3 l4; zero where a leg is stretched or
            folded.
        constraint: (...,) volume that the normals of the parallelograms span, divided by l4^3; zero
            where the normals are parallel to one plane.
    """

    parallel: FloatArray
    serial: FloatArray
    constraint: FloatArray


def forward_all(theta: ArrayLike, geometry: AnyDelta = IRB_360) -> FloatArray:
    """Compute P (..., 2, 3) m in both assembly modes, in the order of ASSEMBLY_MODES."""
    require_delta(geometry)

    def text(angles: Triple, ns: Namespace) -> list[Numbers]:
        cos, sin = arms_at(angles, geometry, ns)
        found = [assembly_at(cos, sin, side, geometry, ns) for side in ASSEMBLY_MODES]
        return [tuple(_or_nan(real, point, ns) for point, real, _ in found)]

    return by_rows(text, finite_points("theta", theta))[0]


def inverse_all(position: ArrayLike, geometry: AnyDelta = IRB_360) -> FloatArray:
    """Compute theta (..., 8, 3) rad in (-pi, pi], in the order of WORKING_MODES."""
    require_delta(geometry)

    def text(point: Triple, ns: Namespace) -> list[Numbers]:
        found = [posture_at(point, bends, geometry, ns) for bends in WORKING_MODES]
        return [tuple(_or_nan(real, angles, ns) for angles, real in found)]

    return by_rows(text, finite_points("position", position))[0]


def jacobian(theta: ArrayLike, side: float = 1.0, geometry: AnyDelta = IRB_360) -> FloatArray:
    """Compute J (v = J theta_dot), (..., 3, 3) m/rad, in the assembly mode ``side``."""
    require_delta(geometry)
    require_side(side)

    def text(angles: Triple, ns: Namespace) -> list[Numbers]:
        pose, real = pose_at(angles, side, geometry, ns)
        real = real & regular(pose, geometry)
        return [tuple(_or_nan(real, row, ns) for row in velocity(_regular(pose, real, ns)))]

    return by_rows(text, finite_points("theta", theta))[0]


def factors(theta: ArrayLike, side: float = 1.0, geometry: AnyDelta = IRB_360) -> Factors:
    """Compute the factors that are zero at singularities; the factors have no unit."""
    require_delta(geometry)
    require_side(side)

    def text(angles: Triple, ns: Namespace) -> list[Numbers]:
        return _factors(*pose_at(angles, side, geometry, ns), geometry, ns)

    return Factors(*by_rows(text, finite_points("theta", theta)))


def factors_at(
    position: ArrayLike, bends: Triple = ELBOWS_OUT, geometry: AnyDelta = IRB_360
) -> Factors:
    """Compute the factors of :func:`factors` at points (..., 3) m in a working mode."""
    require_delta(geometry)
    modes = require_bends(bends)

    def text(point: Triple, ns: Namespace) -> list[Numbers]:
        return _factors(*_pose_at(point, modes, geometry, ns), geometry, ns)

    return Factors(*by_rows(text, finite_points("position", position)))


def _pose_at(point: Triple, bends: Triple, g: AnyDelta, ns: Namespace) -> tuple[Pose, Numbers]:
    angles, real = posture_at(point, bends, g, ns)
    return pose_of(*arms_at(angles, g, ns), point, g), real


def _factors(pose: Pose, real: Numbers, g: AnyDelta, ns: Namespace) -> list[Numbers]:
    values = pose.parallel, *pose.serial, pose.constraint
    parallel, *serial, constraint = _or_nan(real, values, ns)
    cube = g.l4**3
    return [parallel / cube, tuple(leg / (g.l3 * g.l4) for leg in serial), constraint / cube]


def conditioning_at(
    position: ArrayLike, bends: Triple = ELBOWS_OUT, geometry: AnyDelta = IRB_360
) -> FloatArray:
    """Compute 1/cond(J) (...,) at points (..., 3) m in a working mode; NaN out of reach."""
    require_delta(geometry)
    modes = require_bends(bends)

    def text(point: Triple, ns: Namespace) -> list[Numbers]:
        pose, real = _pose_at(point, modes, geometry, ns)
        exists = abs(pose.parallel) > LEAST
        found = conditioning_of(velocity(_regular(pose, exists, ns)), ns)
        return list(_or_nan(real, (ns.where(exists, found, 0.0),), ns))

    return by_rows(text, finite_points("position", position))[0]


def reachable(
    position: ArrayLike, bends: Triple = ELBOWS_OUT, geometry: AnyDelta = IRB_360
) -> BoolArray:
    """Return whether points (..., 3) m have a posture in a working mode, as (...,)."""
    slot = WORKING_MODES.index(require_bends(bends))
    return inverse_all(position, geometry)[..., slot, 0] < 4.0


def no_posture(point: Vector, geometry: DeltaGeometry) -> UnreachableError:
    """Explain which leg does not reach a point (3,) m, and by how much."""
    legs, inner = [inwards(leg, point) for leg in (ONE, TWO, THREE)], geometry.l2 - geometry.l1
    margins = [leg_margin(level + inner, up, out, geometry) for level, out, up in legs]
    worst = margins.index(min(margins))
    hint = "choose a point of its workspace (tpm_gym.mechanism.delta.kinematics.reachable)"
    return UnreachableError(point, f"leg {worst + 1}", margins[worst], hint)


def no_assembly(
    theta: Vector, side: float, geometry: DeltaGeometry
) -> UnreachableError | SingularityError:
    """Explain why the Delta has no solution at theta (3,) rad.

    Either there is no assembly, or J does not exist, or the working mode is not the machine's.
    """
    with np.errstate(all="ignore"):
        cos, sin = arms_at(tuple(map(np.float64, theta)), geometry, NUMPY)
        position, real, height2 = assembly_at(cos, sin, side, geometry, NUMPY)
    if not real:
        part, hint = "three spheres about the elbows", "choose joint angles within reach"
        margin = float(height2) / geometry.l4
        return UnreachableError(theta, part, margin if margin < 0 else 0.0, hint)
    pose = pose_of(cos, sin, position, geometry)
    if not regular(pose, geometry):
        return SingularityError("det A (the rods are coplanar)", float(pose.parallel))
    return UnreachableError(theta, "working mode", 0.0, "choose joint angles of the working mode")


def _regular(pose: Pose, regular: Numbers, ns: Namespace) -> Pose:
    """Set det A to 1 in the rows where J does not exist.

    The lengths are shared by all rows. So without this change, one row without J would make the
    derivatives with respect to the lengths NaN for all rows.
    """
    return pose._replace(parallel=ns.where(regular, pose.parallel, 1.0))


def _or_nan(real: Numbers, values: tuple[Numbers, ...], ns: Namespace) -> tuple[Numbers, ...]:
    return tuple(ns.where(real, value, float("nan")) for value in values)
