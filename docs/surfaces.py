"""Singular surfaces as polynomials in x, y, z, by elimination of the joint angles (Figs. 4 and 5).

After elimination of the angles, one polynomial remains that is zero on the sheets of all working
modes. For level3, planar, legs 1 and 2 and the constraint this is first a curve in (xC, zC),
:data:`CURVES`. Let xC = x - l2 - u and u^2 = l7^2 - y^2. The surface is the product of its curve at
both signs of u. The product is even in u, so it is a polynomial in x, y, z of twice the degree.

The functions take numbers, arrays, or symbols of sympy. Lengths and coordinates must have the same
unit.
"""

from typing import Any, Final

import numpy as np

from tpm_gym.kinematics.geometry import PAPER, Geometry

DEGREES: Final = {
    "sin_beta": 1,
    "level3": 8,
    "planar": 32,
    "cos_beta": 2,
    "leg1": 8,
    "leg2": 8,
    "leg3": 4,
    "constraint": 8,
}
"""Degree in x, y, z of each polynomial, by the name of its factor."""


def _level3(x: Any, z: Any, g: Geometry) -> Any:
    """Return the curve of level3, two circles: C3 is sqrt(l4^2 - l7^2) above or below B3."""
    a, b = x + 2 * g.l2 - g.l1, z + g.l6
    height2 = g.l4**2 - g.l7**2
    return (a**2 + b**2 + height2 - g.l3**2) ** 2 - 4 * height2 * b**2


def _planar(x: Any, z: Any, g: Geometry) -> Any:
    """Return the planar curve: two quadratics in s = 2 l3 sin(theta_1) share a root."""
    # The first quadratic is cos^2 + sin^2 = 1, with 2 l1 l3 cos(theta_1) = n + z s from B1C1 = l4.
    # The second puts B2 on the circle of arm 5, with B2C2 along B1C1, projected on y = 0.
    l1, l3, l4 = g.l1, g.l3, g.l4
    c2 = x - 2 * g.l5 + l1  # level, from A2
    n = l4**2 - l1**2 - l3**2 - x**2 - z**2
    first = (z**2 + l1**2, 2 * n * z, n**2 - 4 * l1**2 * l3**2)
    span2 = (c2**2 + z**2 + l4**2 - l3**2) ** 2
    along, offset, scale = c2 * x + z**2, 2 * l1**2 + n, 4 * l1**2 * l4**2
    second = (
        -(span2 + scale) * z**2,
        4 * scale * along * z - 2 * span2 * offset * z,
        span2 * (scale - offset**2) - 4 * scale * along**2,
    )
    (a, b, c), (d, e, f) = first, second
    return (a * f - c * d) ** 2 - (a * e - b * d) * (b * f - c * e)


def _leg(a: Any, b: Any, out: Any, g: Geometry) -> Any:
    """Return 4 times the squared factor of a leg, from C - A: a, b in its plane, and out of it."""
    in_plane = a**2 + b**2
    return 4 * g.l3**2 * in_plane - (in_plane + out**2 + g.l3**2 - g.l4**2) ** 2


def _constraint(x: Any, z: Any, g: Geometry) -> Any:
    """Return the curve z_C1 = z_B1, with cos(theta_1) from B1C1 = l4."""
    return (g.l1**2 + g.l3**2 - g.l4**2 + x**2 - z**2) ** 2 - 4 * g.l1**2 * (g.l3**2 - z**2)


CURVES: Final = {
    "level3": _level3,
    "planar": _planar,
    "leg1": lambda x, z, g: _leg(g.l1, z, x, g),
    "leg2": lambda x, z, g: _leg(x - 2 * g.l5 + g.l1, z, 0, g),
    "constraint": _constraint,
}
"""Polynomials in xC, zC (and the lengths), by the name of their factor."""


def polynomial(name: str, x: Any, y: Any, z: Any, geometry: Geometry = PAPER, u: Any = None) -> Any:
    """Compute the polynomial of the factor ``name`` of :data:`DEGREES` at x, y, z of P.

    ``u`` is a root of l7^2 - y^2. The default computes it from numbers, |y| <= l7.
    """
    g = geometry
    if name == "sin_beta":
        return y
    if name == "cos_beta":
        return y**2 - g.l7**2
    if name == "leg3":
        return _leg(x + g.l2 - g.l1, z - g.l6, y, g)
    root = np.sqrt(g.l7**2 - y**2) if u is None else u
    curve = CURVES[name]
    return curve(x - g.l2 - root, z - 2 * g.l6, g) * curve(x - g.l2 + root, z - 2 * g.l6, g)
