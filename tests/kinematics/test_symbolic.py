"""sympy proves, for any lengths, that our forms of the equations follow from the closures."""

from typing import Any

import numpy as np
import oracle
import pytest
from examples import examples
from hypothesis import example

from tpm_gym.kinematics import ASSEMBLY_MODES, forward_all, jacobian
from tpm_gym.kinematics.geometry import PAPER

sp = pytest.importorskip("sympy")

LENGTHS = l1, l2, l3, l4, l5, l6, l7 = sp.symbols("l1:8", positive=True)
THETA = t1, t2, t3 = sp.symbols("theta1:4", real=True)
x_c, z_c, beta = sp.symbols("x_C z_C beta", real=True)
half = sp.Symbol("t", real=True)  # tan(theta / 2)


def column(*entries: Any) -> Any:
    return sp.Matrix(entries)


UP = column(0, 0, 1)
A = [column(0, l1, 0), column(-l1, 0, 0), column(l1, 0, 0)]
ARM = [
    l3 * column(0, sp.cos(t1), sp.sin(t1)),
    l3 * column(sp.cos(t2), 0, sp.sin(t2)),
    l3 * column(sp.cos(t3), 0, sp.sin(t3)),
]
B = [a + arm for a, arm in zip(A, ARM, strict=True)]
C1 = column(x_c, 0, z_c)
C2 = column(x_c - 2 * l5, 0, z_c)
D1 = C1 + l6 * UP
E1 = D1 + l7 * column(sp.cos(beta), sp.sin(beta), 0)
F1 = E1 + l6 * UP
P = F1 + column(l2, 0, 0)
D3 = F1 + column(2 * l2, 0, 0)
C3 = D3 - l6 * UP
C = [C1, C2, C3]
RODS = [c - b for c, b in zip(C, B, strict=True)]
CLOSURES = [rod.dot(rod) - l4**2 for rod in RODS]  # f_i = |B_iC_i|^2 - l4^2

PARALLEL = [
    sp.sin(beta),
    l1 + l3 * sp.cos(t3) - x_c - 2 * l2,
    x_c * (z_c - l3 * sp.sin(t2)) - (z_c - l3 * sp.sin(t1)) * (x_c - 2 * l5 + l1 - l3 * sp.cos(t2)),
]
SERIAL = [
    sp.cos(beta),
    l3 * (l1 * sp.sin(t1) + z_c * sp.cos(t1)),
    l3 * (z_c * sp.cos(t2) - (x_c - 2 * l5 + l1) * sp.sin(t2)),
    l3 * ((z_c + l6) * sp.cos(t3) - (x_c + l7 * sp.cos(beta) + 2 * l2 - l1) * sp.sin(t3)),
]
CONSTRAINT = z_c - l3 * sp.sin(t1)  # z_C1 - z_B1


def assert_zero(expression: Any) -> None:
    assert sp.simplify(sp.expand(expression)) == 0


def test_eq_7_is_the_difference_of_the_two_lines_of_eq_6():
    a1, b1 = 2 * (B[1][0] + 2 * l5), 2 * (B[1][2] - B[0][2])
    c1 = (B[1][0] + 2 * l5) ** 2 + B[1][2] ** 2 - B[0][1] ** 2 - B[0][2] ** 2
    assert_zero(CLOSURES[0] - CLOSURES[1] - (a1 * x_c + b1 * z_c - c1))


def test_eq_8_follows_from_eqs_6_and_7():
    a1, b1, c1, y_b, z_b = sp.symbols("a1 b1 c1 y_B1 z_B1", real=True)
    first = (x_c**2 + y_b**2 + (z_c - z_b) ** 2 - l4**2).subs(x_c, (c1 - b1 * z_c) / a1)
    d1, e1 = a1**2 + b1**2, 2 * (b1 * c1 + z_b * a1**2)
    f1 = a1**2 * (y_b**2 + z_b**2 - l4**2) + c1**2
    assert_zero(a1**2 * first - (d1 * z_c**2 - e1 * z_c + f1))
    for sign in (1, -1):
        root = (e1 + sign * sp.sqrt(e1**2 - 4 * d1 * f1)) / (2 * d1)
        assert_zero(d1 * root**2 - e1 * root + f1)


def test_eq_10_follows_from_eq_9_with_f1_above_e1():
    reach = D1[0] - B[2][0] + 2 * l2
    a2 = 2 * l7 * reach
    b2 = l4**2 - l7**2 - reach**2 - (D1[2] - B[2][2]) ** 2
    assert_zero(CLOSURES[2] - (a2 * sp.cos(beta) - b2))


@pytest.mark.parametrize("leg", [0, 1, 2])
def test_eqs_13_and_15_corrected_are_the_closures_in_the_half_angle(leg):
    x, y, z = sp.symbols("x y z", real=True)
    end = [column(x, 0, z), column(x, 0, z), column(x, y, z)][leg]
    theta = THETA[leg]
    closure = (end - B[leg]).dot(end - B[leg]) - l4**2
    closure = closure.subs({sp.cos(theta): (1 - half**2) / (1 + half**2)})
    closure = closure.subs({sp.sin(theta): 2 * half / (1 + half**2)})
    minus, plus = (l1 - l3) ** 2 - l4**2, (l1 + l3) ** 2 - l4**2
    g, h = [
        (minus + x**2 + z**2, plus + x**2 + z**2),
        (plus + x**2 + z**2 + 2 * x * (l1 + l3), minus + x**2 + z**2 + 2 * x * (l1 - l3)),
        (
            minus + x**2 + y**2 + z**2 - 2 * x * (l1 - l3),
            plus + x**2 + y**2 + z**2 - 2 * x * (l1 + l3),
        ),
    ][leg]
    assert_zero(closure * (1 + half**2) - (g * half**2 - 4 * l3 * z * half + h))
    for sign in (1, -1):
        root = (2 * l3 * z + sign * sp.sqrt(4 * z**2 * l3**2 - g * h)) / g
        assert_zero(g * root**2 - 4 * l3 * z * root + h)


def test_eq_16_factors_are_the_determinant_of_the_closures():
    parallel = sp.Matrix(CLOSURES).jacobian([x_c, z_c, beta])
    assert_zero(parallel.det() - 8 * l7 * sp.prod(PARALLEL))


def test_eq_17_factors_are_the_derivatives_by_the_motors():
    serial = sp.Matrix(CLOSURES).jacobian(THETA)
    assert serial.is_diagonal()
    for leg in range(3):
        assert_zero(serial[leg, leg] + 2 * SERIAL[leg + 1])


def test_determinants_of_a_and_b_are_products_of_the_factors():
    """A and B in the velocity of P: rows 1 and 2 times cos(beta), with y = l7 sin(beta)."""
    cos, sin = sp.cos(beta), sp.sin(beta)
    a = sp.Matrix([[cos * r[0], sin * r[0], cos * r[2]] for r in RODS[:2]] + [list(RODS[2])])
    b = sp.diag(cos * SERIAL[1], cos * SERIAL[2], SERIAL[3])
    # Each row is what its closure says about the velocities of P and of the motors.
    p_rates = P.jacobian([x_c, z_c, beta])
    for leg, scale in enumerate((cos, cos, 1)):
        by_links = sp.Matrix([CLOSURES[leg]]).jacobian([x_c, z_c, beta]) / 2
        assert sp.simplify((a[leg, :] * p_rates - scale * by_links).expand()) == sp.zeros(1, 3)
        assert_zero(b[leg, leg] + scale * sp.diff(CLOSURES[leg], THETA[leg]) / 2)
    assert_zero(a.det() + cos * sp.prod(PARALLEL))
    assert_zero(b.det() - cos * sp.prod(SERIAL))


SYMBOLIC = {
    name: sp.lambdify((*LENGTHS, *THETA, x_c, z_c, beta), factors, "numpy")
    for name, factors in (("parallel", PARALLEL), ("serial", SERIAL), ("constraint", [CONSTRAINT]))
}


@examples(25, oracle.geometries(), oracle.seeds())
@example(PAPER, 1)
def test_the_code_returns_these_factors_a_and_b(g, seed):
    for branch in ASSEMBLY_MODES:
        theta = oracle.angles_on(branch, np.random.default_rng(seed), 100, g)
        assert len(theta) > 100 or g != PAPER
        forward = forward_all(theta, g)
        x, z = forward.link3[:, branch.index].T
        turned = forward.beta[:, branch.index]
        expected = {
            name: np.stack(np.broadcast_arrays(*f(*vars(g).values(), *theta.T, x, z, turned)), -1)
            for name, f in SYMBOLIC.items()
        }
        found = jacobian.factors(theta, branch, g)
        np.testing.assert_allclose(found.parallel, expected["parallel"], rtol=0, atol=1e-12)
        np.testing.assert_allclose(found.serial, expected["serial"], rtol=0, atol=1e-12)
        elevation = expected["constraint"][..., 0]
        np.testing.assert_allclose(found.elevation, elevation, rtol=0, atol=1e-12)
        det_a = np.linalg.det(jacobian.parallel(theta, branch, g))
        det_b = np.linalg.det(jacobian.serial(theta, branch, g))
        products = [expected[name].prod(axis=-1) for name in ("parallel", "serial")]
        np.testing.assert_allclose(det_a, -np.cos(turned) * products[0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(det_b, np.cos(turned) * products[1], rtol=0, atol=1e-12)


def test_text_under_eq_7_what_keeps_a1_b1_c1_from_vanishing_together_is_l5():
    """a1 = b1 = 0 leaves c1 = -y_B1^2, zero only for l5 = l1 (or the forbidden l5 = 0)."""
    cos_2 = sp.solve(B[1][0] + 2 * l5, sp.cos(t2))[0]  # a1 = 0
    for cos_1 in (cos_2, -cos_2):  # b1 = 0: sin theta_1 = sin theta_2
        y_b = sp.expand(B[0][1].subs(sp.cos(t1), cos_1))
        assert sp.solve(y_b, l5) in ([l1], [])
    assert sp.expand(B[0][1].subs(sp.cos(t1), cos_2) - 2 * (l1 - l5)) == 0
    assert sp.expand(B[0][1].subs(sp.cos(t1), -cos_2) - 2 * l5) == 0
