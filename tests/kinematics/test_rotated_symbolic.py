"""sympy proves, for any lengths, where link 3' can turn, how often, and when it is singular."""

from typing import Any

import numpy as np
import pytest

from tpm_gym.kinematics import forward_rotated, rotated
from tpm_gym.kinematics.geometry import PAPER, WIDE

sp = pytest.importorskip("sympy")

l2, l4, l5, l6, l7 = sp.symbols("l2 l4 l5 l6 l7", positive=True)
PLACES = x_c, z_c, y_1, z_1, x_2, z_2, x_3, z_3 = sp.symbols("x_C z_C y1 z1 x2 z2 x3 z3", real=True)
c, s, cb, sb, rho, t = sp.symbols("c s cb sb rho t", real=True)  # of phi / 2, and of beta
tilt, beta = sp.symbols("phi beta", real=True)

U = sp.Matrix([sp.cos(tilt), 0, -sp.sin(tilt)])  # along link 3'
V = sp.Matrix([sp.sin(tilt), 0, sp.cos(tilt)])  # off it
E_X, E_Y = sp.Matrix([1, 0, 0]), sp.Matrix([0, 1, 0])
C1, B1 = sp.Matrix([x_c, 0, z_c]), sp.Matrix([0, y_1, z_1])
ROD_4A, ROD_4B = (C1 - B1 + side * l5 * (U - E_X) for side in (1, -1))
ROD_6 = C1 - 2 * l5 * U - sp.Matrix([x_2, 0, z_2])
ROD_11 = C1 + (l7 * sp.cos(beta) + 2 * l2) * U + l7 * sp.sin(beta) * E_Y + l6 * V
ROD_11 = ROD_11 - sp.Matrix([x_3, 0, z_3])
CLOSURES = sp.Matrix([rod.dot(rod) - l4**2 for rod in (ROD_4A, ROD_4B, ROD_6, ROD_11)])
DETERMINANT = CLOSURES.jacobian([x_c, z_c, tilt, beta]).det()
# The rotated mode: C1 as seen along y from B1
TURNED = {x_c: rho * c, z_c: z_1 - rho * s}


def halved(expression: Any) -> Any:
    """In sines and cosines of phi / 2 and of beta."""
    angles = {sp.cos(tilt): c**2 - s**2, sp.sin(tilt): 2 * s * c}
    return expression.subs({**angles, sp.cos(beta): cb, sp.sin(beta): sb})


def assert_zero(expression: Any) -> None:
    circles = [c**2 + s**2 - 1, cb**2 + sb**2 - 1]
    _, rest = sp.reduced(sp.expand(expression), circles, s, sb, c, cb)
    assert sp.expand(rest) == 0


def test_both_rods_4_close_where_link_3p_is_level_or_b1c1_halves_the_angle():
    difference = halved(ROD_4A.dot(ROD_4A) - ROD_4B.dot(ROD_4B))
    assert_zero(difference + 8 * l5 * s * (x_c * s + (z_c - z_1) * c))
    assert_zero((x_c * s + (z_c - z_1) * c).subs(TURNED))
    for rod in (ROD_4A, ROD_4B):
        assert_zero(halved(rod.dot(rod)).subs(TURNED) - (rho**2 + y_1**2 + 4 * l5**2 * s**2))


def in_tangent(expression: Any, degree: int) -> Any:
    """An even polynomial in c and s, of this degree at most, as one in t = s / c, over c^degree."""
    powers = sp.Poly(sp.expand(expression.subs(s, t * c)), c).terms()
    assert all(power % 2 == 0 for (power,), _ in powers)
    raised = [factor * (1 + t**2) ** ((degree - power) // 2) for (power,), factor in powers]
    return sp.Poly(sp.expand(sum(raised)), t)


def test_the_motors_allow_four_tilts_at_most():
    rod_6 = halved(ROD_6.dot(ROD_6) - l4**2).subs(TURNED)
    rho2 = l4**2 - y_1**2 - 4 * l5**2 * s**2
    rod_6 = sp.expand(rod_6).subs(rho**2, rho2)
    _, rod_6 = sp.reduced(rod_6, [c**2 + s**2 - 1], c, s)
    p, q = sp.Poly(rod_6, rho).coeff_monomial(rho), sp.Poly(rod_6, rho).coeff_monomial(1)
    assert_zero(p + 2 * ((x_2 + 2 * l5) * c - (z_2 - z_1) * s))
    level, rise = x_2 + 2 * l5 * (c**2 - s**2), z_2 - z_1 - 4 * l5 * s * c
    assert_zero(q - (rho2 - l4**2 + level**2 + rise**2))
    assert in_tangent(rho2 * p**2 - q**2, 4).degree() == 4


def test_point_p_allows_six_tilts_at_most_for_each_sign_of_cos_beta():
    l1, l3, along, up, x, z = sp.symbols("l1 l3 along up x z", real=True)
    x_1 = x - along * (c**2 - s**2) - up * 2 * s * c
    z_1 = z - up * (c**2 - s**2) + along * 2 * s * c
    # c l3 sin(theta_1), where B1C1 halves the angle, and 2 l1 c l3 cos(theta_1), where rods 4 close
    sine = z_1 * c + x_1 * s
    cosine = (l4**2 - l3**2 - l1**2 - 4 * l5**2 * s**2 - x_1**2 + z_1**2) * c + 2 * z_1 * x_1 * s
    _, cosine = sp.reduced(sp.expand(cosine), [c**2 + s**2 - 1], c, s)
    _, sine = sp.reduced(sp.expand(sine), [c**2 + s**2 - 1], c, s)
    closure = 4 * l1**2 * sine**2 + cosine**2 - 4 * l1**2 * l3**2 * c**2
    sextic, rest = sp.div(in_tangent(closure, 10), sp.Poly((1 + t**2) ** 2, t))
    assert rest == 0
    assert sextic.degree() == 6


def test_the_determinant_is_the_factors():
    """Of all four closures by (xC, zC, phi, beta), on the mode with link 3' turned."""
    level3 = l7 * cb - halved(ROD_11.dot(U)).subs(TURNED)
    rate = ROD_6.diff(tilt) + ROD_6.jacobian([x_c, z_c]) * sp.Matrix([-s / 2, -c / 2]) * rho
    rate -= ROD_6.jacobian([x_c, z_c]) * sp.Matrix([c, -s]) * 2 * l5**2 * s * c / rho
    planar = halved(ROD_6.dot(rate)).subs(TURNED)
    factors = -64 * l5 * l7 * (-rho * s) * sb * level3 * planar
    assert_zero(halved(DETERMINANT).subs(TURNED) - sp.expand(factors))


def test_the_determinant_where_link_3p_is_level_is_eq_16_and_the_constraint_factor():
    level3 = l7 * cb - halved(ROD_11.dot(U)).subs({s: 0, c: 1})
    planar = x_c * (z_c - z_2) - (z_c - z_1) * (x_c - 2 * l5 - x_2)
    factors = -32 * l5 * l7 * (z_c - z_1) * sb * level3 * planar
    assert_zero(halved(DETERMINANT).subs({s: 0, c: 1}) - factors)


@pytest.mark.parametrize("g", [PAPER, WIDE])
def test_the_code_has_these_factors(g):
    symbols = (*PLACES, l2, l4, l5, l6, l7, tilt, beta)
    found = forward_rotated(np.random.default_rng(0).uniform(-np.pi, np.pi, (500, 3)), g)
    real = found.valid
    theta, (x, z) = found.theta[real], found.link3[real].T
    level, rise = g.l3 * np.cos(theta.T), g.l3 * np.sin(theta.T)
    places = x, z, g.l1 + level[0], rise[0], level[1] - g.l1, rise[1], level[2] + g.l1, rise[2]
    lengths = g.l2, g.l4, g.l5, g.l6, g.l7
    values = sp.lambdify(symbols, DETERMINANT)(
        *places, *lengths, found.tilt[real], found.beta[real]
    )
    factors = rotated.factors(found)
    product = factors.parallel[real].prod(axis=-1) * factors.elevation[real]
    np.testing.assert_allclose(values, -64 * g.l5 * g.l7 * product, rtol=0, atol=1e-13)
