"""Kinematics of the second operation mode, in which link 3' and the platform are turned about y.

Seen along y, leg 1 is a four-bar linkage with opposite sides of equal length: rods 4a and 4b, and
links 3 and 3'. In the paper's mode it is a parallelogram, in which link 3' only translates. In the
second mode it is an antiparallelogram, in which link 3' is turned. Then B1C1, seen along y, bisects
the angle between links 3 and 3'. Leg 2 lets link 3' turn about y, and leg 3 lets the platform turn
with link 3'.

The two modes meet at the constraint singularity, z_C1 = z_B1. There, all four sides of the linkage,
seen along y, lie on one line, and the linkage can continue in either mode.

Everything is in the paper's frame, in m and rad, and in numpy arrays. The tilt phi is a
right-handed turn about y: link 3' points along (cos phi, 0, -sin phi). A vector seen along y is
written as a complex number x + i z, so the direction of link 3' is exp(-i phi).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.arrays import BoolArray, FloatArray, numbers, points
from tpm_gym.kinematics import equations
from tpm_gym.kinematics.equations import Factors
from tpm_gym.kinematics.geometry import PAPER, Geometry, require_geometry
from tpm_gym.kinematics.namespaces import NUMPY

_Planar = NDArray[np.complex128]
_Pair = tuple[FloatArray, FloatArray]
_Four = tuple[FloatArray, FloatArray, FloatArray, FloatArray]  # two derivatives of two functions

_NEAR = 1e-5  # an eigenvalue this close to the unit circle may be on it
_MERGED = 1e-7  # fraction of l4; where eigenvalues coincide, half of the digits are right
_STEPS = 4  # Newton steps; enough if half of the digits are right
_FARTHEST = 0.01  # largest Newton step that is taken, rad or m
_CLOSED = 1e-13  # largest rounding error of a closure |rod|^2 - l4^2, in l4^2


@dataclass(frozen=True)
class RotatedPostures:
    """Postures (...,) with link 3' turned; NaN where there is no posture.

    Attributes:
        theta: (..., 3) rad, the actuated angles.
        link3: (..., 2) m, (xC, zC) of point C1 of link 3'.
        tilt: (...,) rad, in (-pi, pi], the turn of link 3' and the platform about y.
        beta: (...,) rad, in (-pi, pi], the passive angle of link 7, in the plane of link 3'.
        geometry: The lengths.
    """

    theta: FloatArray
    link3: FloatArray
    tilt: FloatArray
    beta: FloatArray
    geometry: Geometry

    @property
    def valid(self) -> BoolArray:
        """(...,) bool, whether there is a posture."""
        return ~np.isnan(self.beta)

    @property
    def orientation(self) -> FloatArray:
        """Rotation (..., 3, 3) of link 3' and the platform about y, by the tilt."""
        cos, sin, zero = np.cos(self.tilt), np.sin(self.tilt), 0 * self.tilt
        rows = [cos, zero, sin, zero, zero + 1, zero, -sin, zero, cos]
        return np.stack(rows, axis=-1).reshape(*self.tilt.shape, 3, 3)

    @property
    def position(self) -> FloatArray:
        """Point P, (..., 3) m."""
        g, (cos, sin) = self.geometry, (np.cos(self.beta), np.sin(self.beta))
        return self._moved([g.l7 * cos + g.l2, g.l7 * sin, 2 * g.l6])

    @property
    def ends(self) -> FloatArray:
        """Far ends of rods 4a, 4b and 6 on link 3', and C3, (..., 4, 3) m."""
        g, (cos, sin) = self.geometry, (np.cos(self.beta), np.sin(self.beta))
        on_link3 = [self._moved([along, 0.0, 0.0]) for along in (g.l5, -g.l5, -2 * g.l5)]
        c3 = self._moved([g.l7 * cos + 2 * g.l2, g.l7 * sin, g.l6])
        return np.stack([*on_link3, c3], axis=-2)

    @property
    def rods(self) -> FloatArray:
        """Four vectors (..., 4, 3) m: along rods 4a, 4b and 6, and from B3 to C3.

        The last one is parallel to rods 11a and 11b.
        """
        half = np.array([self.geometry.l5, 0.0, 0.0])
        b1, b2, b3 = np.moveaxis(_elbows(self.theta, self.geometry), -2, 0)
        feet: FloatArray = np.stack([b1 + half, b1 - half, b2, b3], axis=-2)
        return self.ends - feet

    def _moved(self, offset: Sequence[FloatArray | float]) -> FloatArray:
        """Return the points at an offset from C1, (..., 3) m.

        ``offset`` is (x, y, z) in the frame of link 3', m.
        """
        x, y, z = offset
        cos, sin = np.cos(self.tilt), np.sin(self.tilt)
        along, up = x * cos + z * sin, z * cos - x * sin
        x_c, z_c = self.link3[..., 0], self.link3[..., 1]
        return np.stack([x_c + along, 0 * x_c + y, z_c + up], axis=-1)


@np.errstate(all="ignore")
def forward_rotated(theta: ArrayLike, geometry: Geometry = PAPER) -> RotatedPostures:
    """Compute the 8 assemblies with link 3' turned, for actuated angles theta (..., 3) rad.

    Link 3' depends on theta_1 and theta_2 alone and has 4 postures at most; link 7 has 2 for each.
    The slots (..., 8) are in the order of :data:`.modes.ROTATED_MODES`. Assemblies in which both
    operation modes meet (tilt 0) are included. Angles that are not finite have no assembly.

    Raises:
        InputError: If theta is no array (..., 3) of numbers.
    """
    require_geometry(geometry)
    angles = points("theta", numbers("theta", theta))
    link3, tilt = link3_rotated(angles, geometry)
    cos_beta, real = _link7(angles, link3, tilt, geometry)
    beta = np.where(real, np.arccos(cos_beta), np.nan)
    # Postures of link 3', then both signs of sin(beta)
    link3, tilt = (np.repeat(np.where(real, some, np.nan), 2, axis=-1) for some in (link3, tilt))
    return RotatedPostures(
        np.repeat(angles[..., None, :], 8, axis=-2),
        np.stack([link3.real, link3.imag], axis=-1),
        tilt,
        np.stack([-beta, beta], axis=-1).reshape(tilt.shape),
        geometry,
    )


@np.errstate(all="ignore")
def inverse_rotated(position: ArrayLike, geometry: Geometry = PAPER) -> RotatedPostures:
    """Compute the postures (..., 48) with link 3' turned and P at position (..., 3) m.

    Slots are ordered by the sign of cos(beta), then by the tilt (6 values, ascending), then by the
    sign of B_2C_2 . dB_2/dtheta_2, then by the sign of B_3C_3 . dB_3/dtheta_3; -1 comes before 1.
    Positions that are not finite have no posture.

    Raises:
        InputError: If position is no array (..., 3) of numbers.
    """
    require_geometry(geometry)
    g, places = geometry, points("position", numbers("position", position))
    x, y, z = np.moveaxis(places, -1, 0)
    sin_beta = (y / g.l7)[..., None]
    cos_beta = np.sqrt((1 - sin_beta) * (1 + sin_beta)) * [-1.0, 1.0]
    link7 = g.l7 * cos_beta + g.l2 + 2j * g.l6
    theta_1, tilt = _leg1((x + 1j * z)[..., None], link7, g)
    c1 = (x + 1j * z)[..., None, None] - link7[..., None] * np.exp(-1j * tilt)
    c2 = c1 - 2 * g.l5 * np.exp(-1j * tilt) + g.l1  # from A2
    c3 = c1 + (link7 + g.l2 - 1j * g.l6)[..., None] * np.exp(-1j * tilt) - g.l1  # from A3
    c2, c3, out = c2[..., None, None], c3[..., None, None], y[..., None, None, None, None]
    bends = np.array([-1.0, 1.0])
    theta_2, real2 = equations.arm(c2.real, c2.imag, 0.0, bends[:, None], g, NUMPY)
    theta_3, real3 = equations.arm(c3.real, c3.imag, out, bends, g, NUMPY)
    real = ~np.isnan(tilt)[..., None, None] & real2 & real3
    beta = np.arctan2(sin_beta, cos_beta)[..., None, None, None]
    by_tilt = (values[..., None, None] for values in (theta_1, tilt, c1.real, c1.imag))
    slots = np.broadcast_arrays(*by_tilt, theta_2, theta_3, beta)
    one, tilt, x_c, z_c, two, three, beta = (
        np.where(real, values, np.nan).reshape(*places.shape[:-1], 48) for values in slots
    )
    theta, link3 = np.stack([one, two, three], axis=-1), np.stack([x_c, z_c], axis=-1)
    return RotatedPostures(theta, link3, tilt, beta, g)


def _dot(a: _Planar, b: _Planar) -> FloatArray:
    product: FloatArray = (a * b.conj()).real
    return product


def _elbows(theta: FloatArray, g: Geometry) -> FloatArray:
    """Compute B1, B2, B3 as rows (..., 3, 3) m."""
    one, two, three = np.moveaxis(theta, -1, 0)
    level, rise = equations.arms((one, two, three), g, NUMPY)
    first = 0 * one, g.l1 + level[0], rise[0]
    second, third = (level[1] - g.l1, 0 * one, rise[1]), (level[2] + g.l1, 0 * one, rise[2])
    elbows: FloatArray = np.stack([*first, *second, *third], axis=-1)
    return elbows.reshape(*theta.shape, 3)


def _zeros(values: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Find zeros (..., 2 d) of trigonometric polynomials of degree d, and whether they may be real.

    The polynomials are given by their values (..., 2 d + 1) at equally spaced angles in [0, 2 pi).
    The zeros phi, ascending in (-pi, pi], are the angles of the eigenvalues w of the companion
    matrix. A zero may be real if w is close to the unit circle.
    """
    degree = values.shape[-1] - 1
    coefficients = np.fft.fftshift(np.fft.fft(values), axes=-1)
    lower, highest = coefficients[..., :-1], coefficients[..., -1:]
    # If the highest coefficient is 0, so is the lowest. Then one w is 0, and another is very large.
    least = 1e-14 * abs(lower).max(axis=-1, keepdims=True)
    companion = np.zeros((*values.shape[:-1], degree, degree), dtype=complex)
    companion[..., 1:, :-1] = np.eye(degree - 1)
    companion[..., -1] = -lower / np.where(abs(highest) < least, least, highest)
    known = np.isfinite(companion).all(axis=(-2, -1), keepdims=True)
    w = np.linalg.eigvals(np.where(known, companion, 0.0))
    near = abs(np.log(abs(w))) < _NEAR
    order = np.angle(w).argsort(axis=-1)
    return np.take_along_axis(np.angle(w), order, -1), np.take_along_axis(near, order, -1)


@np.errstate(all="ignore")
def link3_rotated(theta: FloatArray, geometry: Geometry = PAPER) -> tuple[_Planar, FloatArray]:
    """Compute C1 (xC + i zC, m) and tilt (rad) of the turned link 3', (..., 4) each.

    ``theta`` is (..., 3) rad. Missing solutions are NaN. There is a slot for each pair of signs
    (planar, further) of :data:`.modes.ROTATED_MODES`.

    Seen along y, the vector from B1 to C1 is rho n with n = exp(-i phi / 2), since it bisects the
    angle between links 3 and 3'. Then rods 4a and 4b have the same closure, which gives rho^2. With
    this rho^2, the closure of rod 6 has the form 2 rho p = q, where p and q depend on phi only. The
    squared equation, 4 rho^2 p^2 = q^2, is a trigonometric polynomial of degree 2 in phi, a quartic
    in tan(phi / 2).
    """
    g = geometry
    b1, b2, _ = np.moveaxis(_elbows(theta, g), -2, 0)
    reach2 = g.l4**2 - b1[..., 1, None] ** 2
    kappa = (b2 - b1)[..., 0, None] + 2 * g.l5 + 1j * (b2 - b1)[..., 2, None]

    def terms(tilt: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return rho^2, p and q at a tilt. The closure of rod 6 is 2 rho p = q.

        |rho| is the distance from B1 to C1 seen along y, m.
        """
        n, u = np.exp(-0.5j * tilt), np.exp(-1j * tilt)
        rho2 = reach2 - (2 * g.l5 * n.imag) ** 2
        q = rho2 + abs(kappa + 2 * g.l5 * (u - 1)) ** 2 - g.l4**2
        return rho2, _dot(kappa, n), q

    def closures(rho: FloatArray, tilt: FloatArray) -> tuple[_Pair, _Four]:
        """Return two closures |rod|^2 - l4^2, m^2, and their derivatives by rho and tilt.

        Rods 4a and 4b have the first closure, rod 6 has the second closure.
        """
        n, u = np.exp(-0.5j * tilt), np.exp(-1j * tilt)
        rod6 = rho * n - 2 * g.l5 * (u - 1) - kappa
        gaps = rho**2 + (2 * g.l5 * n.imag) ** 2 - reach2, abs(rod6) ** 2 - g.l4**2
        bend = 2 * _dot(rod6, 2j * g.l5 * u - 0.5j * rho * n)
        return gaps, (2 * rho, 2 * g.l5**2 * np.sin(tilt), 2 * _dot(rod6, n), bend)

    rho2, p, q = terms(np.linspace(0.0, 2 * np.pi, 5, endpoint=False))
    tilt, near = _zeros(4 * rho2 * p**2 - q**2)
    rho2, p, q = terms(tilt)
    # Where p = q = 0, two neighbouring zeros coincide, and rho has both signs.
    rho = np.where(abs(p) < _MERGED * g.l4, [1, -1, 1, -1], np.sign(p * q)) * NUMPY.root(rho2)
    (rho, tilt), gaps, slopes = _refined(closures, rho, tilt)
    # This is 4 rho^2 times the planar factor. The derivative of rod 6's closure along rho(phi) has
    # the same sign, which alternates from one zero to the next.
    a, b, c, d = slopes
    sign = (a * d - b * c) * rho
    real = near & (np.maximum(*map(abs, gaps)) < _CLOSED * g.l4**2)
    c1 = 1j * b1[..., 2, None] + rho * np.exp(-0.5j * tilt)
    return _in_slots(c1, np.angle(np.exp(1j * tilt)), np.where(real, sign, np.nan))


def _leg1(p: _Planar, link7: _Planar, g: Geometry) -> tuple[FloatArray, FloatArray]:
    """Solve for theta_1 and tilt, (..., 6) rad each.

    ``p`` is point P, and ``link7`` is the vector from C1 to P in the frame of link 3', both in m
    and seen along y. The inner function ``terms`` computes ``up`` and ``out`` for a tilt phi. If
    l3 sin(theta_1) = up, then B1C1 bisects the angle between links 3 and 3'. If, in addition,
    l3 cos(theta_1) = out, then rods 4a and 4b have the length l4. So the equation
    up^2 + out^2 = l3^2 gives phi. Multiplied by cos^2(phi / 2), this equation is a trigonometric
    polynomial of degree 3.
    """
    p, link7 = p[..., None], link7[..., None]

    def terms(tilt: FloatArray) -> tuple[FloatArray, FloatArray]:
        c1, n = p - link7 * np.exp(-1j * tilt), np.exp(-0.5j * tilt)
        up = c1.imag - c1.real * n.imag / n.real
        apart2 = (c1.real / n.real) ** 2 + (2 * g.l5 * n.imag) ** 2 - up**2
        return up, (g.l4**2 - g.l3**2 - g.l1**2 - apart2) / (2 * g.l1)

    def closures(theta_1: FloatArray, tilt: FloatArray) -> tuple[_Pair, _Four]:
        out, up = g.l3 * np.cos(theta_1), g.l3 * np.sin(theta_1)
        spin, n = link7 * np.exp(-1j * tilt), np.exp(-0.5j * tilt)
        rod = p - spin - 1j * up
        apart2 = abs(rod) ** 2 + (g.l1 + out) ** 2 + (2 * g.l5 * n.imag) ** 2
        gaps = _dot(rod, 1j * n), (apart2 - g.l4**2) / 2
        slopes = (
            -out * n.real,
            _dot(spin, n) + _dot(rod, n) / 2,
            -out * rod.imag - (g.l1 + out) * up,
            _dot(rod, 1j * spin) + g.l5**2 * np.sin(tilt),
        )
        return gaps, slopes

    samples = np.linspace(0.0, 2 * np.pi, 7, endpoint=False)
    up, out = terms(samples)
    tilt, near = _zeros((up**2 + out**2 - g.l3**2) * np.cos(samples / 2) ** 2)
    up, out = terms(tilt)
    (theta_1, tilt), gaps, _ = _refined(closures, np.arctan2(up, out), tilt)
    real = near & (abs(gaps[0]) < _CLOSED * g.l4) & (abs(gaps[1]) < _CLOSED * g.l4**2)
    tilt = np.where(real, np.angle(np.exp(1j * tilt)), np.nan)
    order = tilt.argsort(axis=-1)
    return np.take_along_axis(theta_1, order, axis=-1), np.take_along_axis(tilt, order, axis=-1)


def _refined(
    closures: Callable[[FloatArray, FloatArray], tuple[_Pair, _Four]],
    one: FloatArray,
    two: FloatArray,
) -> tuple[_Pair, _Pair, _Four]:
    """Refine two unknowns by Newton's method; return unknowns, closures, closures' derivatives."""
    for _ in range(_STEPS):
        (e, f), (a, b, c, d) = closures(one, two)
        determinant = a * d - b * c
        first, second = (d * e - b * f) / determinant, (a * f - c * e) / determinant
        small = abs(first) + abs(second) < _FARTHEST  # else no zero is nearby
        one, two = one - np.where(small, first, 0.0), two - np.where(small, second, 0.0)
    return ((one, two), *closures(one, two))


def _in_slots(c1: _Planar, tilt: FloatArray, sign: FloatArray) -> tuple[_Planar, FloatArray]:
    """Sort solutions into four slots; slots without a solution are NaN.

    Half of the solutions, those with the smaller values of ``sign``, get the first two slots. The
    other solutions get the last two. In each half, the tilts in [0, 2 pi) are ascending.
    """
    real = ~np.isnan(sign)
    count = real.sum(axis=-1, keepdims=True)
    half = count // 2
    positive = sign.argsort(axis=-1).argsort(axis=-1) >= half
    order = np.lexsort((np.mod(tilt, 2 * np.pi), positive, ~real), axis=-1)
    place = np.concatenate([0 * half, 0 * half + 1, half, half + 1], axis=-1)
    filled = place < np.concatenate([half, half, count, count], axis=-1)
    source = np.take_along_axis(order, np.minimum(place, 3), axis=-1)
    found, turns = (np.take_along_axis(values, source, axis=-1) for values in (c1, tilt))
    return np.where(filled, found, np.nan), np.where(filled, turns, np.nan)


def _link7(
    theta: FloatArray, link3: _Planar, tilt: FloatArray, g: Geometry
) -> tuple[FloatArray, BoolArray]:
    """Compute cos(beta) by Eqs. (9) and (10) in the frame of link 3', and whether beta exists.

    Beta exists if rods 11 have the length l4 for some direction of link 7.
    """
    b3 = _elbows(theta, g)[..., 2, :]
    to_c1 = (link3 - (b3[..., 0, None] + 1j * b3[..., 2, None])) * np.exp(1j * tilt)
    u, w = to_c1.real + 2 * g.l2, to_c1.imag + g.l6
    numerator, denominator = g.l4**2 - g.l7**2 - u**2 - w**2, 2 * g.l7 * u
    real = abs(numerator) <= abs(denominator) + equations.ROUNDING * g.l4**2
    return np.clip(numerator / denominator, -1.0, 1.0), real


@np.errstate(all="ignore")
def factors(postures: RotatedPostures) -> Factors:
    """Compute the factors that are zero where a rotated assembly is singular.

    The names are as in :class:`.equations.Factors`, and each factor is (...,). Besides sin(beta)
    and cos(beta), the factors are:

    * level3 (m): l7 cos(beta) - B3C3 . u, where u is the unit vector along link 3'.
    * planar (m^2/rad): B2C2 . dC2/dphi with motor 1 locked. It is zero where the lines of rods 4a,
      4b and 6, seen along y, meet in one point.
    * leg1 (m^2/rad): no short formula. It is zero where motor 1 can turn while P rests and link 3'
      turns about P.
    * leg2 and leg3 (m^2/rad): B_iC_i . dB_i/dtheta_i.
    * elevation (m): z_C1 - z_B1 = -rho sin(phi / 2), with rho as in :func:`link3_rotated`. It is
      zero where the two operation modes meet.
    """
    g = postures.geometry
    rods, rates = postures.rods, _elbow_rates(postures.theta, g)
    b1 = _elbows(postures.theta, g)[..., 0, :]
    c1 = postures.link3[..., 0] + 1j * postures.link3[..., 1]
    p = postures.position[..., 0] + 1j * postures.position[..., 2] - c1
    u, n = np.exp(-1j * postures.tilt), np.exp(-0.5j * postures.tilt)
    rho = _dot(c1 - 1j * b1[..., 2], n)
    rod6, rod11 = (rods[..., i, 0] + 1j * rods[..., i, 2] for i in (2, 3))
    bend = g.l5**2 * np.sin(postures.tilt)  # -rho drho/dphi
    planar = _dot(rod6, 2j * g.l5 * u - 0.5j * rho * n - bend / rho * n)
    out, up = rates[..., 0, 1], rates[..., 0, 2]
    leg1 = (_dot(p, n) + rho / 2) * (up * n.imag - b1[..., 1] * out / rho)
    leg1 -= up * n.real * (_dot(n, 1j * p) + bend / rho)
    leg2, leg3 = (np.sum(rods[..., i + 1, :] * rates[..., i, :], axis=-1) for i in (1, 2))
    sin, cos = np.sin(postures.beta), np.cos(postures.beta)
    level3, elevation = g.l7 * cos - _dot(rod11, u), c1.imag - b1[..., 2]
    return Factors(sin, level3, planar, cos, leg1, leg2, leg3, elevation)


@np.errstate(all="ignore")
def velocity(postures: RotatedPostures) -> FloatArray:
    """Compute the derivatives of P and of the tilt by the joint positions, (..., 4, 3).

    The first three rows belong to P (m/rad), the last row belongs to the tilt (rad/rad), and the
    columns belong to the motors. The lengths of the rods are constant: rods 4a, 4b and 6 determine
    the motion of link 3', and rods 11a and 11b determine the turn of link 7. At a parallel
    singularity, and where the two operation modes meet, the derivatives are not finite.
    """
    g, rods, ends = postures.geometry, postures.rods, postures.ends
    rates = _elbow_rates(postures.theta, g)[..., [0, 0, 1, 2], :]
    pulls = np.sum(rods * rates, axis=-1)[..., None] * np.eye(3)[[0, 0, 1, 2]]
    c1, e_y = postures._moved([0.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    # Rates of |rod|^2 / 2 for unit velocities of C1 along x and z, and a unit turn about y at C1
    turns = np.sum(rods * np.cross(e_y, ends - c1[..., None, :]), axis=-1)
    moved = np.stack([rods[..., 0], rods[..., 2], turns], axis=-1)
    cos, sin = np.cos(postures.beta), np.sin(postures.beta)
    # Velocity of P and C3 relative to link 3', for a unit rate of beta
    along7 = postures._moved([-g.l7 * sin, g.l7 * cos, 0.0]) - c1
    to_p = np.cross(e_y, postures.position - c1)
    twist = _inverse(moved[..., :3, :]) @ pulls[..., :3, :]
    wanted = pulls[..., 3, :] - np.einsum("...i,...ij->...j", moved[..., 3, :], twist)
    link7 = wanted / np.sum(rods[..., 3, :] * along7, axis=-1)[..., None]
    by_link3 = np.stack([twist[..., 0, :], 0 * link7, twist[..., 1, :]], axis=-2)
    by_link7 = along7[..., None] * link7[..., None, :]
    turn = twist[..., 2:, :]
    linear = by_link3 + to_p[..., None] * turn + by_link7
    return np.concatenate([linear, turn], axis=-2)


def _elbow_rates(theta: FloatArray, g: Geometry) -> FloatArray:
    """Compute dB_i/dtheta_i as rows (..., 3, 3), m/rad."""
    pivots = np.array([[0.0, g.l1, 0.0], [-g.l1, 0.0, 0.0], [g.l1, 0.0, 0.0]])
    rates: FloatArray = _elbows(theta + np.pi / 2, g) - pivots
    return rates


def _inverse(matrix: FloatArray) -> FloatArray:
    """Invert matrices (..., 3, 3); the result is not finite where there is no inverse."""
    one, two, three = np.moveaxis(matrix, -2, 0)
    adjugate = np.stack([np.cross(two, three), np.cross(three, one), np.cross(one, two)], axis=-1)
    inverted: FloatArray = adjugate / np.sum(one * adjugate[..., 0], axis=-1)[..., None, None]
    return inverted
