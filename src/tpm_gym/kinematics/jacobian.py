"""Jacobians, their singular factors, and conditioning, for batches, in the paper's frame.

The closures are f_i = |B_iC_i|^2 - l4^2 = 0. Their derivatives by time are A v = B theta_dot, with
the platform's velocity v (section "Singularity analysis"). Configurations are given by the actuated
angles ``theta`` (..., 3) in rad and the assembly mode, or by points ``position`` (..., 3) in m and
the working mode. Torch tensors give tensors, as in :mod:`tpm_gym.kinematics.position`.

All functions raise InputError for inputs that are no array (..., 3) of numbers. Functions of angles
also raise InputError if theta is not finite, and UnreachableError if the assembly mode does not
exist at some theta.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, explained, finite_points, points
from tpm_gym.errors import SingularityError
from tpm_gym.kinematics import equations
from tpm_gym.kinematics.equations import Factors as Factors
from tpm_gym.kinematics.geometry import PAPER, AnyLengths, Geometry
from tpm_gym.kinematics.modes import (
    DEFAULT_ASSEMBLY,
    ELBOWS_OUT,
    AssemblyMode,
    WorkingMode,
    require_mode,
)
from tpm_gym.kinematics.namespaces import Namespace, Numbers, by_rows


@dataclass(frozen=True)
class Evaluation:
    """Result of :func:`evaluate`.

    Attributes:
        position: (..., 3) m, point P.
        velocity: (..., 3, 3) m/rad, J.
        conditioning: (...,) 1/cond(J).
    """

    position: FloatArray
    velocity: FloatArray
    conditioning: FloatArray


class _Configuration(NamedTuple):
    position: equations.Triple
    rods: tuple[equations.Triple, equations.Triple, equations.Triple]
    factors: equations.Factors
    ns: Namespace


_Results = Callable[[_Configuration], Sequence[Numbers]]


def parallel(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> FloatArray:
    """Compute the parallel Jacobian A of A v = B theta_dot, (..., 3, 3) m.

    Point P is (x, y, z), and xC is the x coordinate of point C1 of link 3'. The equation
    y = l7 sin(beta) eliminates the passive angle beta: dxC = dx + tan(beta) dy. At y = +-l7,
    tan(beta) is infinite. To keep A finite, rows 1 and 2 are multiplied by cos(beta). With these
    rows, det A is -cos(beta) times the product of the factors of Eq. (16).
    """

    def results(c: _Configuration) -> list[Numbers]:
        (r1x, _, r1z), (r2x, _, r2z), r3 = c.rods
        cos, sin = c.factors.cos_beta, c.factors.sin_beta
        # C1 and C2 move with (dx + tan(beta) dy, 0, dz)
        return [((cos * r1x, sin * r1x, cos * r1z), (cos * r2x, sin * r2x, cos * r2z), r3)]

    return _from_angles(results, theta, branch, geometry)[0]


def serial(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> FloatArray:
    """Compute the serial Jacobian B of A v = B theta_dot, (..., 3, 3) m^2/rad, diagonal.

    Rows 1 and 2 are multiplied by cos(beta), as in :func:`parallel`. With these rows, det B is
    cos(beta) times the product of the factors of Eq. (17).
    """

    def results(c: _Configuration) -> list[Numbers]:
        f, no = c.factors, 0 * c.factors.leg3
        return [((f.cos_beta * f.leg1, no, no), (no, f.cos_beta * f.leg2, no), (no, no, f.leg3))]

    return _from_angles(results, theta, branch, geometry)[0]


def velocity(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> FloatArray:
    """Compute the velocity Jacobian J with v = J theta_dot, (..., 3, 3) m/rad.

    J = A^-1 B wherever A can be inverted. J also exists at serial singularities, even where
    cos(beta) = 0 and so both A and B are singular.

    Raises:
        SingularityError: If theta is a parallel singularity, where J does not exist.
    """
    return _regular(lambda c: [_velocity(c)], theta, branch, geometry)[0]


def link_velocity(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> FloatArray:
    """Compute the derivatives of link coordinates by the joint positions, (..., 3, 3) m/rad.

    The rows belong to xC, zC and l7 beta, the columns to theta_1, theta_2 and theta_3. (xC, zC) is
    point C1 of link 3', and beta is the passive angle of link 7.

    Raises:
        SingularityError: If theta is a parallel singularity.
    """

    def results(c: _Configuration) -> list[Numbers]:
        x, z, turn = equations.link_velocity(c.rods, c.factors)
        return [((*x, 0 * x[0]), (*z, 0 * z[0]), turn)]

    return _regular(results, theta, branch, geometry)[0]


def conditioning(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> FloatArray:
    """Compute 1/cond(J), an array (...,).

    The result is 0 at a singularity (up to rounding) and 1 where J is isotropic.
    """
    return _from_angles(lambda c: [_conditioning(c)], theta, branch, geometry)[0]


def conditioning_at(
    position: ArrayLike,
    branch: WorkingMode = ELBOWS_OUT,
    assembly: AssemblyMode = DEFAULT_ASSEMBLY,
    geometry: AnyLengths = PAPER,
) -> FloatArray:
    """Compute 1/cond(J) at points, an array (...,).

    The result is 0 at points that are not reachable in the working mode ``branch`` and the assembly
    mode ``assembly``.

    To differentiate by the lengths, pass points as a tensor and the lengths as tensors in a
    :class:`tpm_gym.kinematics.geometry.Lengths`.
    """
    require_mode(assembly, AssemblyMode)

    def results(c: _Configuration) -> list[Numbers]:
        planar, side = (2.0 * (f > 0) - 1.0 for f in (c.factors.planar, c.factors.sin_beta))
        here = (planar == assembly.planar) & (side == assembly.sin_beta)
        return [c.ns.where(here, _conditioning(c), 0.0)]

    return _from_points(results, position, branch, geometry, 0.0)[0]


def evaluate(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> Evaluation:
    """Compute P, J and conditioning at theta; the forward kinematics are solved only once.

    Raises:
        SingularityError: If theta is a parallel singularity.
    """

    def results(c: _Configuration) -> list[Numbers]:
        return [c.position, _velocity(c), _conditioning(c)]

    return Evaluation(*_regular(results, theta, branch, geometry))


def factors(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> Factors:
    """Compute the factors of det A and det B (Eqs. 16 and 17, corrected), (...,) each."""
    return Factors(*_from_angles(lambda c: c.factors, theta, branch, geometry))


def factors_at(
    position: ArrayLike, branch: WorkingMode = ELBOWS_OUT, geometry: AnyLengths = PAPER
) -> Factors:
    """Compute the factors of det A and det B at points; NaN where a point is out of reach.

    The factors are accurate at singularities too.
    """
    return Factors(*_from_points(lambda c: c.factors, position, branch, geometry, math.nan))


def _regular(
    results: _Results, theta: ArrayLike, branch: AssemblyMode, g: Geometry
) -> list[FloatArray]:
    """Compute results for configurations in which J exists.

    Raises:
        SingularityError: If J does not exist in a configuration; the error names the smallest
            factor of det A.
    """
    singular, *found = _from_angles(lambda c: [c.factors[:3], *results(c)], theta, branch, g)
    names = "sin(beta)", "(l1 + l3 cos(theta_3) - xC - 2 l2) / l4", "planar factor / l4^2"
    scaled = [singular[..., i].reshape(-1) / (1.0, g.l4, g.l4**2)[i] for i in range(3)]
    if len(scaled[0]):
        least = [some[abs(some).argmin()].item() for some in scaled]
        smallest, name = min(zip(least, names, strict=True), key=lambda pair: abs(pair[0]))
        if abs(smallest) < equations.SINGULAR:
            raise SingularityError(name, smallest)
    return found


def _from_angles(
    results: _Results, theta: ArrayLike, branch: AssemblyMode, g: Geometry
) -> list[FloatArray]:
    """Compute results for configurations at joint angles."""

    def text(angles: equations.Triple, ns: Namespace) -> list[Numbers]:
        cos, sin = equations.arms(angles, g, ns)
        found, real, _ = equations.assembly_at(cos, sin, branch.planar, branch.sin_beta, g, ns)
        return [ns.where(real, 0.0, 1.0), *results(_configuration(cos, sin, found, g, ns))]

    require_mode(branch, AssemblyMode)
    angles = finite_points("theta", theta)
    missing, *found = by_rows(text, angles)
    if missing.any():
        raise explained(lambda a: equations.no_assembly(a, branch, g), angles, missing != 0)
    return found


def _from_points(
    results: _Results, position: ArrayLike, branch: WorkingMode, g: AnyLengths, missing: float
) -> list[FloatArray]:
    """Compute results for configurations at points; ``missing`` where a point is out of reach."""

    def text(point: equations.Triple, ns: Namespace) -> list[Numbers]:
        theta, real, link7, _ = equations.posture_at(point, branch.signs, g, ns)
        cos, sin = equations.arms(theta, g, ns)
        found = _configuration(cos, sin, equations.Assembly(*point, *link7), g, ns)
        return [ns.where(real, column, missing) for column in results(found)]

    require_mode(branch, WorkingMode)
    return by_rows(text, points("position", position))


def _configuration(
    cos: equations.Triple,
    sin: equations.Triple,
    found: equations.Assembly,
    g: AnyLengths,
    ns: Namespace,
) -> _Configuration:
    bars = equations.rods(cos, sin, found, g)
    return _Configuration(found[:3], bars, equations.factors(cos, sin, found, bars, g), ns)


def _velocity(c: _Configuration) -> Numbers:
    first, second, (z1, z2, _) = equations.velocity(c.rods, c.factors)
    return first, second, (z1, z2, 0 * z1)


def _conditioning(c: _Configuration) -> Numbers:
    """Compute the conditioning; 0 where J does not exist."""
    values, ns = c.factors, c.ns
    exists = abs(values.planar * values.sin_beta * values.level3) > equations.LEAST
    # Otherwise, the derivatives of all rows by the lengths would be NaN.
    sin_beta, level3, planar = (ns.where(exists, value, 1.0) for value in values[:3])
    values = values._replace(sin_beta=sin_beta, level3=level3, planar=planar)
    found = equations.conditioning(equations.velocity(c.rods, values), ns)
    return ns.where(exists & (found <= 1.0), found, 0.0)
