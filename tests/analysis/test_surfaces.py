"""The polynomials are what elimination leaves, and their zeros are the sheets of the factors."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import oracle
import pytest
from surfaces import CURVES, DEGREES, polynomial

from tpm_gym.kinematics import WORKING_MODES
from tpm_gym.kinematics.geometry import PAPER, WIDE, Geometry

sp = pytest.importorskip("sympy")

# The case study in centimetres, exact
CM = SimpleNamespace(**{f"l{i}": sp.Integer(v) for i, v in enumerate((30, 7, 35, 80, 10, 1, 5), 1)})
x_c, z_c, u = sp.symbols("x_C z_C u")  # u = l7 cos(beta)
c1, s1, c2, s2, c3, s3 = sp.symbols("c1 s1 c2 s2 c3 s3")
ON_CIRCLE = [c1**2 + s1**2 - 1, c2**2 + s2**2 - 1, c3**2 + s3**2 - 1]


def closures() -> list[Any]:
    """Return the closures B_iC_i = l4 in xC, zC and u."""
    g = CM
    level_2, level_3 = x_c - 2 * g.l5 + g.l1 - g.l3 * c2, x_c + u + 2 * g.l2 - g.l1 - g.l3 * c3
    return [
        x_c**2 + (g.l1 + g.l3 * c1) ** 2 + (z_c - g.l3 * s1) ** 2 - g.l4**2,
        level_2**2 + (z_c - g.l3 * s2) ** 2 - g.l4**2,
        level_3**2 + (g.l7**2 - u**2) + (z_c + g.l6 - g.l3 * s3) ** 2 - g.l4**2,
    ]


# Each factor, as mechanism and Eqs. (16), (17) have it, with the leg that it is eliminated from
FACTORS = {
    "level3": (2, CM.l1 + CM.l3 * c3 - x_c - 2 * CM.l2),
    "leg1": (0, CM.l1 * s1 + z_c * c1),
    "leg2": (1, z_c * c2 - (x_c - 2 * CM.l5 + CM.l1) * s2),
    "constraint": (0, z_c - CM.l3 * s1),
}


def assert_same_up_to_a_number(found: Any, name: str) -> None:
    ours = sp.Poly(sp.expand(CURVES[name](x_c, z_c, CM)), x_c, z_c)
    assert (sp.Poly(found, x_c, z_c).monic() - ours.monic()).is_zero


@pytest.mark.parametrize("name", list(FACTORS))
def test_groebner_bases_eliminate_to_these_curves(name):
    leg, factor = FACTORS[name]
    angles = [(c1, s1), (c2, s2), (c3, s3, u)][leg]
    basis = sp.groebner([ON_CIRCLE[leg], closures()[leg], factor], *angles, x_c, z_c, order="lex")
    (left,) = [e for e in basis.exprs if not e.free_symbols & set(angles)]
    assert_same_up_to_a_number(left, name)


def test_resultants_eliminate_to_the_planar_curve():
    first, second, _ = closures()
    b2, b1 = CM.l1 - CM.l3 * c2 - 2 * CM.l5, CM.l3 * s1
    planar = x_c * (z_c - CM.l3 * s2) - (z_c - b1) * (x_c + b2)
    # Closures and factor are linear in c1, and in c2 and s2, once the squares are taken out.
    first = sp.expand(first - CM.l3**2 * ON_CIRCLE[0])
    second = sp.expand(second - CM.l3**2 * ON_CIRCLE[1])
    (arm_2,) = sp.solve([second, planar], [c2, s2], dict=True)
    (arm_1,) = sp.solve(first, c1)
    one, other = (
        sp.Poly(sp.expand(sp.numer(sp.together(e.subs(arm_2).subs(c1, arm_1)))), s1)
        for e in ON_CIRCLE[:2]
    )
    left = sp.expand(sp.resultant(one, other))
    ((_, power),) = sp.factor_list(left)[1]
    assert power == 1
    assert_same_up_to_a_number(left, "planar")
    assert sp.Poly(left, x_c, z_c).total_degree() == 16


@pytest.mark.parametrize("name", list(DEGREES))
def test_degrees_along_a_line_and_no_u_is_left(name):
    t = sp.Symbol("t")
    x, y, z = (sp.Poly(a + b * t, u, t) for a, b in ((3, 2), (1, 1), (-4, 3)))
    whole = polynomial(name, x, y, z, CM, sp.Poly(u, u, t))
    assert all(power % 2 == 0 for (power, _), _ in whole.terms())
    left = whole.rem(sp.Poly(u, u, t) ** 2 - (CM.l7**2 - y**2))
    assert left.degree(u) == 0
    assert left.degree(t) == DEGREES[name]


# Against the factors


GEOMETRIES = [PAPER, WIDE, Geometry(0.25, 0.06, 0.30, 0.65, 0.08, 0.02, 0.12)]


@pytest.mark.parametrize("g", GEOMETRIES)
def test_the_polynomials_of_the_legs_are_four_times_the_squares_of_their_factors(g):
    s = oracle.reachable_postures(np.random.default_rng(2), 200, g)
    _, serial = oracle.factors(s.theta, s.x_c, s.z_c, s.beta, g)
    found = [CURVES["leg1"](s.x_c, s.z_c, g), CURVES["leg2"](s.x_c, s.z_c, g)]
    found.append(polynomial("leg3", *s.position.T, g))
    np.testing.assert_allclose(np.transpose(found), 4 * serial[:, 1:] ** 2, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("name", "index"), [("level3", 1), ("planar", 2)])
def test_every_real_zero_within_reach_is_singular_in_some_mode(name, index):
    """Elimination adds no zeros: all roots of the polynomial along lines in (xC, zC) count."""
    t = np.cos(np.pi * (np.arange(40) + 0.5) / 40)
    rng, singular, checked = np.random.default_rng(6), 0, 0
    for _ in range(60):
        start, end = rng.uniform([-0.9, -1.1], [0.9, 1.1], (2, 2))
        line = start + (t[:, None] + 1) / 2 * (end - start)
        values = CURVES[name](line[:, 0], line[:, 1], PAPER)
        roots = np.polynomial.Chebyshev.fit(t, values, 16, domain=[-1, 1]).roots()
        roots = roots[(np.abs(roots.imag) < 1e-9) & (np.abs(roots.real) < 1)].real
        for at in start + (roots[:, None] + 1) / 2 * (end - start):
            beta = rng.choice([-1, 1]) * np.arcsin(0.6)
            p = oracle.vector(
                at[0] + PAPER.l2 + PAPER.l7 * np.cos(beta), 0.6 * PAPER.l7, at[1] + 0.02
            )
            factors = [oracle.factors_at(p, mode, PAPER)[0][index] for mode in WORKING_MODES]
            if np.isfinite(factors).any():
                checked += 1
                singular += np.nanmin(np.abs(factors)) < 1e-6
    assert checked > 40
    assert singular == checked


def test_all_surfaces_are_named():
    assert set(DEGREES) >= set(CURVES)
    assert polynomial("sin_beta", 1, 0, 1) == 0
    assert polynomial("cos_beta", 1, PAPER.l7, 1) == 0
