"""The second operation mode: link 3' and the platform turned about y, in closed form.

The two rods of branch I keep one distance each. Seen along y they are opposite sides of a four-bar
linkage whose other two sides, links 3 and 3', are equal too: a parallelogram, in which link 3' only
translates, as the paper has it; or an antiparallelogram, in which it is turned. Then B1C1, seen
along y, halves the angle between links 3 and 3'. Nothing else changes: branch II lets link 3' turn
about y, and branch III turns the platform with it.

Both modes meet where z_C1 = z_B1, the constraint singularity: seen along y all four sides of the
linkage then lie on one line, and it can leave that posture either way.

The paper's frame, m and rad; numpy arrays only. A tilt phi is a right-handed turn about y: link 3'
points along (cos phi, 0, -sin phi). Seen along y, vectors are complex numbers x + i z here, so link
3' is exp(-i phi).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.arrays import BoolArray, FloatArray, numbers, points
from tpm_gym.kinematics import equations
from tpm_gym.kinematics.geometry import PAPER, Geometry, require_geometry
from tpm_gym.kinematics.jacobian import Factors
from tpm_gym.kinematics.namespaces import NUMPY

_Planar = NDArray[np.complex128]

_NEAR = 1e-5  # eigenvalues so far from the unit circle, or nearer, may be on it
_STEPS = 4  # of Newton's method, from eigenvalues good to half of the digits or better
_CLOSED = 1e-13  # of l4^2: what rounding leaves of a closure |rod|^2 - l4^2


@dataclass(frozen=True)
class RotatedSolutions:
    """All assemblies with link 3' turned, one slot per :data:`.modes.ROTATED_MODES` entry.

    Attributes:
        theta: (..., 3) rad, the actuated angles that they were solved for.
        link3: (..., 8, 2) m, (xC, zC) of point C1 of link 3'; NaN where not real.
        tilt: (..., 8) rad, in (-pi, pi], the turn of link 3' and the platform about y.
        beta: (..., 8) rad, in (-pi, pi], the passive angle of link 7, in the plane of link 3'.
        geometry: The lengths they were solved for.
    """

    theta: FloatArray
    link3: FloatArray
    tilt: FloatArray
    beta: FloatArray
    geometry: Geometry

    @property
    def valid(self) -> BoolArray:
        """(..., 8) bool, which branches are real."""
        return ~np.isnan(self.beta)

    @property
    def orientation(self) -> FloatArray:
        """(..., 8, 3, 3), the rotation of link 3' and the platform: about y, by the tilt."""
        cos, sin, zero = np.cos(self.tilt), np.sin(self.tilt), 0 * self.tilt
        rows = [cos, zero, sin, zero, zero + 1, zero, -sin, zero, cos]
        return np.stack(rows, axis=-1).reshape(*self.tilt.shape, 3, 3)

    @property
    def position(self) -> FloatArray:
        """(..., 8, 3) m, point P."""
        g, (cos, sin) = self.geometry, (np.cos(self.beta), np.sin(self.beta))
        return self._moved([g.l7 * cos + g.l2, g.l7 * sin, 2 * g.l6])

    @property
    def ends(self) -> FloatArray:
        """(..., 8, 4, 3) m, the far ends of rods 4a, 4b and 6 on link 3', and C3."""
        g, (cos, sin) = self.geometry, (np.cos(self.beta), np.sin(self.beta))
        on_link3 = [self._moved([along, 0.0, 0.0]) for along in (g.l5, -g.l5, -2 * g.l5)]
        c3 = self._moved([g.l7 * cos + 2 * g.l2, g.l7 * sin, g.l6])
        return np.stack([*on_link3, c3], axis=-2)

    @property
    def rods(self) -> FloatArray:
        """(..., 8, 4, 3) m, along rods 4a, 4b and 6, and B3C3, which rods 11 are parallel to."""
        half = np.array([self.geometry.l5, 0.0, 0.0])
        b1, b2, b3 = np.moveaxis(_elbows(self.theta, self.geometry), -2, 0)
        feet = np.stack([b1 + half, b1 - half, b2, b3], axis=-2)
        return self.ends - feet[..., None, :, :]

    def _moved(self, offset: Sequence[FloatArray | float]) -> FloatArray:
        """C1 (..., 8, 3) m, displaced by an offset in the frame of link 3', x, y and z in m."""
        x, y, z = offset
        cos, sin = np.cos(self.tilt), np.sin(self.tilt)
        along, up = x * cos + z * sin, z * cos - x * sin
        x_c, z_c = self.link3[..., 0], self.link3[..., 1]
        return np.stack([x_c + along, 0 * x_c + y, z_c + up], axis=-1)


def forward_rotated(theta: ArrayLike, geometry: Geometry = PAPER) -> RotatedSolutions:
    """All assemblies with link 3' turned at actuated angles theta (..., 3) rad: 8 at most.

    Link 3' depends on theta_1 and theta_2 alone: tan(phi / 2) is a root of a quartic, so that there
    are 4 postures of it at most, and 2 of link 7 for each. Signs name the branches as far as signs
    can: see :class:`.modes.RotatedMode`. Where both modes meet (phi = 0) the assembly is returned,
    too. Entries that are not finite give no valid branch.

    Raises:
        InputError: If theta is no array (..., 3) of numbers.
    """
    require_geometry(geometry)
    angles = points("theta", numbers("theta", theta))
    with np.errstate(all="ignore"):
        link3, tilt = _link3(angles, geometry)
        cos_beta, real = _link7(angles, link3, tilt, geometry)
    beta = np.where(real, np.arccos(cos_beta), np.nan)
    tilt = np.where(real, tilt, np.nan)
    # Slots of link 3', then both signs of sin(beta)
    return RotatedSolutions(
        angles,
        np.repeat(np.stack([link3.real, link3.imag], axis=-1) + 0 * beta[..., None], 2, axis=-2),
        np.repeat(tilt, 2, axis=-1),
        np.stack([-beta, beta], axis=-1).reshape(*beta.shape[:-1], 8),
        geometry,
    )


def _dot(a: _Planar, b: _Planar) -> FloatArray:
    product: FloatArray = (a * b.conj()).real
    return product


def _elbows(theta: FloatArray, g: Geometry) -> FloatArray:
    """B1, B2, B3 as rows (..., 3, 3) m."""
    one, two, three = np.moveaxis(theta, -1, 0)
    level, rise = equations.arms((one, two, three), g, NUMPY)
    zero = 0 * one
    elbows = [
        np.stack([zero, g.l1 + level[0], rise[0]], axis=-1),
        np.stack([level[1] - g.l1, zero, rise[1]], axis=-1),
        np.stack([level[2] + g.l1, zero, rise[2]], axis=-1),
    ]
    return np.stack(elbows, axis=-2)


def _link3(theta: FloatArray, g: Geometry) -> tuple[_Planar, FloatArray]:
    """Point C1 and tilt in all postures of link 3', (..., 4), in their slots.

    Seen along y and from B1, with n = exp(-i phi / 2): C1 = rho n, since B1C1 halves the angle. The
    closures of rods 4a and 4b are then one, rho^2 = reach2 - 4 l5^2 sin^2(phi / 2); that of rod 6
    is linear in rho, 2 rho (kappa . n) = q(phi). Squared, it is a quartic in tan(phi / 2).
    """
    l5 = g.l5
    b1, b2, _ = np.moveaxis(_elbows(theta, g), -2, 0)
    reach2 = g.l4**2 - b1[..., 1, None] ** 2
    kappa = (b2 - b1)[..., 0, None] + 2 * l5 + 1j * (b2 - b1)[..., 2, None]
    # q = q0 + 2 Re(q1 w), with w = exp(i phi)
    q0 = abs(kappa) ** 2 + reach2 - g.l4**2 - 4 * l5 * kappa.real + 6 * l5**2
    q1 = l5 * (2 * kappa - 3 * l5)
    w = _roots(reach2 - 2 * l5**2, kappa, q0, q1, l5)
    tilt, near = np.angle(w), abs(np.log(abs(w))) < _NEAR
    n = np.exp(-0.5j * tilt)
    p, q = _dot(kappa, n), q0 + 2 * (q1 * np.exp(1j * tilt)).real
    # Where p = q = 0, rho has both signs, and two neighbouring roots are one.
    side = np.where(abs(p) < _NEAR * g.l4, [1, -1, 1, -1], np.sign(p * q))
    rho = side * np.sqrt(np.maximum(reach2 - (2 * l5 * n.imag) ** 2, 0.0))
    for _ in range(_STEPS):
        gaps, slopes = _closures(rho, tilt, kappa, reach2, g)
        first, second = _solved(gaps, slopes)
        small = near & (abs(second) < 0.01)
        rho, tilt = rho - np.where(small, first, 0.0), tilt - np.where(small, second, 0.0)
    gaps, slopes = _closures(rho, tilt, kappa, reach2, g)
    real = near & (np.maximum(*map(abs, gaps)) < _CLOSED * g.l4**2)
    # Along the curve rho(phi) the closure of rod 6 changes its sign at every root.
    sign = _determinant(slopes) * np.where(reach2 > 4 * l5**2, rho, 1.0)
    c1 = 1j * b1[..., 2, None] + rho * np.exp(-0.5j * tilt)
    return _in_slots(c1, np.angle(np.exp(1j * tilt)), np.where(real, sign, np.nan))


def _roots(m0: FloatArray, kappa: _Planar, q0: FloatArray, q1: _Planar, l5: float) -> _Planar:
    """Roots w = exp(i phi) of 4 rho^2 (kappa . n)^2 = q^2, (..., 4), by angle.

    With rho^2 = m0 + 2 l5^2 Re(w) and 2 (kappa . n)^2 = |kappa|^2 + Re(kappa^2 w); eigenvalues of
    the companion matrix. A real phi is on the unit circle.
    """
    square, size = kappa**2, abs(kappa) ** 2
    second = l5**2 * square - q1**2
    first = m0 * square + 2 * l5**2 * size - 2 * q0 * q1
    middle = 2 * m0 * size + 2 * l5**2 * square.real - q0**2 - 2 * abs(q1) ** 2
    scale = abs(first) + abs(middle)  # where second is 0, one root is at infinity, out of the way
    second = np.where(abs(second) < 1e-14 * scale, 1e-14 * scale, second)
    companion = np.zeros((*kappa.shape[:-1], 4, 4), dtype=complex)
    companion[..., 1:, :-1] = np.eye(3)
    lower = np.concatenate([second.conj(), first.conj(), middle, first], axis=-1)
    companion[..., -1] = -lower / second
    known = np.isfinite(companion).all(axis=(-2, -1), keepdims=True)
    w = np.linalg.eigvals(np.where(known, companion, 0.0))
    return np.take_along_axis(w, np.angle(w).argsort(axis=-1), axis=-1)


def _closures(
    rho: FloatArray, tilt: FloatArray, kappa: _Planar, reach2: FloatArray, g: Geometry
) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, ...]]:
    """Closures of rods 4a and 4b, and of rod 6, m^2, and their slopes by rho and tilt."""
    n, u = np.exp(-0.5j * tilt), np.exp(-1j * tilt)
    rod6 = rho * n - 2 * g.l5 * (u - 1) - kappa
    gaps = (
        rho**2 + (2 * g.l5 * n.imag) ** 2 - reach2,
        abs(rod6) ** 2 - g.l4**2,
    )
    slopes = (
        2 * rho,
        2 * g.l5**2 * np.sin(tilt),
        2 * _dot(rod6, n),
        2 * _dot(rod6, 2j * g.l5 * u - 0.5j * rho * n),
    )
    return gaps, slopes


def _determinant(slopes: tuple[FloatArray, ...]) -> FloatArray:
    a, b, c, d = slopes
    return a * d - b * c


def _solved(
    gaps: tuple[FloatArray, ...], slopes: tuple[FloatArray, ...]
) -> tuple[FloatArray, FloatArray]:
    a, b, c, d = slopes
    one, two = gaps
    return (d * one - b * two) / (a * d - b * c), (a * two - c * one) / (a * d - b * c)


def _in_slots(c1: _Planar, tilt: FloatArray, sign: FloatArray) -> tuple[_Planar, FloatArray]:
    """Half of the real ones have a negative sign; those of one sign are in order of their turn."""
    real = ~np.isnan(sign)
    count = real.sum(axis=-1, keepdims=True)
    half = count // 2
    positive = sign.argsort(axis=-1).argsort(axis=-1) >= half
    order = np.lexsort((np.mod(tilt, 2 * np.pi), positive, ~real), axis=-1)
    # Half go to the first two slots, the others to the last two.
    place = np.concatenate([0 * half, 0 * half + 1, half, half + 1], axis=-1)
    filled = place < np.concatenate([half, half, count, count], axis=-1)
    source = np.take_along_axis(order, np.minimum(place, 3), axis=-1)
    found, turns = (np.take_along_axis(values, source, axis=-1) for values in (c1, tilt))
    return np.where(filled, found, np.nan), np.where(filled, turns, np.nan)


def _link7(
    theta: FloatArray, link3: _Planar, tilt: FloatArray, g: Geometry
) -> tuple[FloatArray, BoolArray]:
    """cos(beta), and whether rod 11 closes: Eqs. (9) and (10) in the frame of link 3'."""
    b3 = _elbows(theta, g)[..., 2, :]
    to_c1 = (link3 - (b3[..., 0, None] + 1j * b3[..., 2, None])) * np.exp(1j * tilt)
    u, w = to_c1.real + 2 * g.l2, to_c1.imag + g.l6
    numerator, denominator = g.l4**2 - g.l7**2 - u**2 - w**2, 2 * g.l7 * u
    real = abs(numerator) <= abs(denominator) + equations.ROUNDING * g.l4**2
    return np.clip(numerator / denominator, -1.0, 1.0), real


def factors(solutions: RotatedSolutions) -> Factors:
    """What vanishes where a rotated assembly is singular, in :class:`.jacobian.Factors`' order.

    * parallel (..., 8, 3): sin(beta); level3 = l7 cos(beta) - B3C3 . u (m), with u along link 3';
      planar = B2C2 . dC2/dphi with motor 1 locked (m^2/rad), zero where the lines of rods 4a, 4b
      and 6, seen along y, meet in one point.
    * serial (..., 8, 4): cos(beta); leg 1 (m^2/rad), zero where motor 1 turns while P rests and
      link 3' turns about it; B_iC_i . dB_i/dtheta_i (m^2/rad) for i = 2, 3.
    * constraint (..., 8): z_C1 - z_B1 = -rho sin(phi / 2) (m), zero where both modes meet.
    """
    g = solutions.geometry
    rods, rates = solutions.rods, _elbow_rates(solutions.theta, g)
    b1 = _elbows(solutions.theta, g)[..., None, 0, :]
    c1 = solutions.link3[..., 0] + 1j * solutions.link3[..., 1]
    p = solutions.position[..., 0] + 1j * solutions.position[..., 2] - c1
    u, n = np.exp(-1j * solutions.tilt), np.exp(-0.5j * solutions.tilt)
    rho = _dot(c1 - 1j * b1[..., 2], n)
    rod6, rod11 = (rods[..., i, 0] + 1j * rods[..., i, 2] for i in (2, 3))
    bend = g.l5**2 * np.sin(solutions.tilt)  # -rho drho/dphi
    planar = _dot(rod6, 2j * g.l5 * u - 0.5j * rho * n - bend / rho * n)
    out, up = rates[..., None, 0, 1], rates[..., None, 0, 2]
    leg1 = (_dot(p, n) + rho / 2) * (up * n.imag - b1[..., 1] * out / rho)
    leg1 -= up * n.real * (_dot(n, 1j * p) + bend / rho)
    leg2, leg3 = (np.sum(rods[..., i + 1, :] * rates[..., None, i, :], axis=-1) for i in (1, 2))
    sin, cos = np.sin(solutions.beta), np.cos(solutions.beta)
    return Factors(
        np.stack([sin, g.l7 * cos - _dot(rod11, u), planar], axis=-1),
        np.stack([cos, leg1, leg2, leg3], axis=-1),
        c1.imag - b1[..., 2],
    )


def velocity(solutions: RotatedSolutions) -> FloatArray:
    """Rates of P (m/rad) and of the tilt (rad/rad) per rate of each motor, (..., 8, 4, 3).

    No rod changes its length: rods 4a, 4b and 6 give the twist of link 3', rod 11 the rate of link
    7. At a parallel singularity, and where both modes meet, there are no finite rates.
    """
    g, rods, ends = solutions.geometry, solutions.rods, solutions.ends
    rates = _elbow_rates(solutions.theta, g)[..., None, [0, 0, 1, 2], :]
    pulls = np.sum(rods * rates, axis=-1)[..., None] * np.eye(3)[[0, 0, 1, 2]]
    c1, e_y = solutions._moved([0.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    # What velocities of C1 along x and z, and a turn about y through it, do to each rod
    turns = np.sum(rods * np.cross(e_y, ends - c1[..., None, :]), axis=-1)
    moved = np.stack([rods[..., 0], rods[..., 2], turns], axis=-1)
    cos, sin = np.cos(solutions.beta), np.sin(solutions.beta)
    along7 = solutions._moved([-g.l7 * sin, g.l7 * cos, 0.0]) - c1  # for a unit rate of link 7
    to_p = np.cross(e_y, solutions.position - c1)
    with np.errstate(all="ignore"):
        twist = _inverse(moved[..., :3, :]) @ pulls[..., :3, :]
        wanted = pulls[..., 3, :] - np.einsum("...i,...ij->...j", moved[..., 3, :], twist)
        link7 = wanted / np.sum(rods[..., 3, :] * along7, axis=-1)[..., None]
        by_link3 = np.stack([twist[..., 0, :], 0 * link7, twist[..., 1, :]], axis=-2)
        turn = twist[..., 2, :]
        rows = by_link3 + to_p[..., None] * turn[..., None, :] + along7[..., None] * link7[..., None, :]
    return np.concatenate([rows, turn[..., None, :]], axis=-2)


def _elbow_rates(theta: FloatArray, g: Geometry) -> FloatArray:
    """dB_i/dtheta_i as rows (..., 3, 3), m/rad."""
    pivots = np.array([[0.0, g.l1, 0.0], [-g.l1, 0.0, 0.0], [g.l1, 0.0, 0.0]])
    return _elbows(theta + np.pi / 2, g) - pivots


def _inverse(matrix: FloatArray) -> FloatArray:
    """Of matrices (..., 3, 3); not finite where there is none."""
    one, two, three = np.moveaxis(matrix, -2, 0)
    adjugate = np.stack([np.cross(two, three), np.cross(three, one), np.cross(one, two)], axis=-1)
    inverted: FloatArray = adjugate / np.sum(one * adjugate[..., 0], axis=-1)[..., None, None]
    return inverted
