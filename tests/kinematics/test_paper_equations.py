"""What the kinematics return satisfies the paper's equations, corrected, in the paper's own terms.

test_symbolic.py proves that these forms follow from the closures; here they are evaluated on what
the code returns, so a wrong function fails under the number of its equation.
"""

import numpy as np
import oracle
import pytest
from examples import examples
from hypothesis import example

from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics import ASSEMBLY_MODES, forward, forward_all, inverse_all
from tpm_gym.kinematics.geometry import PAPER, Geometry

any_geometry = examples(20, oracle.geometries(), oracle.seeds())


def assemblies(theta: FloatArray, g: Geometry) -> tuple[FloatArray, ...]:
    """theta (n, 3), C1 (n, 2), beta (n,) and P (n, 3) of every assembly, and its slot (n,)."""
    found = forward_all(theta, g)
    row, slot = np.nonzero(found.valid)
    return (
        theta[row],
        found.link3[row, slot],
        found.beta[row, slot],
        found.position[row, slot],
        slot,
    )


def drawn(seed: int, count: int) -> FloatArray:
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (count, 3))


def eq_7(theta: FloatArray, g: Geometry) -> tuple[FloatArray, ...]:
    """a1, b1, c1 and y_B1, z_B1."""
    p = oracle.points(theta, 0.0, 0.0, 0.0, g)
    (_, y1, z1), (x2, _, z2) = p["B1"].T, p["B2"].T
    c1 = (x2 + 2 * g.l5) ** 2 + z2**2 - y1**2 - z1**2
    return 2 * (x2 + 2 * g.l5), 2 * (z2 - z1), c1, y1, z1


@any_geometry
@example(PAPER, 1)
def test_eq_7_holds_of_c1(g: Geometry, seed: int) -> None:
    theta, (x_c, z_c), *_ = (np.transpose(v) for v in assemblies(drawn(seed, 500), g))
    a1, b1, c1, _, _ = eq_7(theta.T, g)
    np.testing.assert_allclose(a1 * x_c + b1 * z_c, c1, rtol=0, atol=1e-11)
    assert len(c1) > 20


@pytest.mark.parametrize("g", [PAPER, Geometry(0.31, 0.06, 0.36, 0.79, 0.11, 0.02, 0.07)])
def test_eq_8a_gives_c1_where_a1_is_zero(g: Geometry) -> None:
    """Its signs of x_C1 are those of the planar factor: there, this is b1 x_C1 / 2."""
    theta = drawn(2, 4000)
    theta[:, 1] = np.sign(theta[:, 1]) * np.arccos((g.l1 - 2 * g.l5) / g.l3)
    theta, link3, _, _, slot = assemblies(theta, g)
    a1, b1, c1, y1, z1 = eq_7(theta, g)
    assert np.abs(a1).max() < 1e-15
    clear = np.abs(b1) > 0.1
    z_c = c1 / b1
    planar = np.array([mode.planar for mode in ASSEMBLY_MODES])[slot]
    size = np.sqrt(np.maximum(g.l4**2 - (z1 - z_c) ** 2 - y1**2, 0.0))
    expected = np.stack([-planar * np.sign(b1) * size, z_c], axis=-1)
    np.testing.assert_allclose(link3[clear], expected[clear], rtol=0, atol=1e-7)
    assert clear.sum() > 500
    assert set(slot[clear]) == {0, 1, 2, 3}


@any_geometry
@example(PAPER, 1)
def test_eq_8b_gives_c1_where_a1_is_not_zero(g: Geometry, seed: int) -> None:
    theta, link3, *_ = assemblies(drawn(seed, 500), g)
    a1, b1, c1, y1, z1 = eq_7(theta, g)
    d1, e1 = a1**2 + b1**2, 2 * (b1 * c1 + z1 * a1**2)
    f1 = a1**2 * (y1**2 + z1**2 - g.l4**2) + c1**2
    root = np.sqrt(np.maximum(e1**2 - 4 * d1 * f1, 0.0))
    z_c = (e1 + [[1.0], [-1.0]] * root) / (2 * d1)
    x_c = (c1 - b1 * z_c) / a1
    off = np.abs(np.stack([x_c, z_c], axis=-1) - link3).max(axis=-1)
    clear = (np.abs(a1) > 0.05) & (root > 1e-3 * d1)
    assert off.min(axis=0)[clear].max(initial=0.0) < 1e-9
    assert clear.mean() > 0.2


def rest_of_eq_10(theta: FloatArray, link3: FloatArray, g: Geometry) -> tuple[FloatArray, ...]:
    """a2 and b2, from C1."""
    x_d, z_d = link3[:, 0], link3[:, 1] + g.l6
    x3, _, z3 = oracle.points(theta, 0.0, 0.0, 0.0, g)["B3"].T
    reach = x_d - x3 + 2 * g.l2
    return 2 * g.l7 * reach, g.l4**2 - g.l7**2 - reach**2 - (z_d - z3) ** 2


@any_geometry
@example(PAPER, 1)
def test_eq_10_holds_of_beta(g: Geometry, seed: int) -> None:
    theta, link3, beta, _, slot = assemblies(drawn(seed, 500), g)
    a2, b2 = rest_of_eq_10(theta, link3, g)
    np.testing.assert_allclose(a2 * np.cos(beta), b2, rtol=0, atol=1e-11)
    np.testing.assert_array_equal(np.sign(np.sin(beta)), [(-1, 1)[i % 2] for i in slot])


@any_geometry
@example(PAPER, 1)
def test_eq_11_puts_p_in_the_middle_of_f1_and_d3(g: Geometry, seed: int) -> None:
    """From C1 as Eq. (7) and B1C1 = l4 give it, and beta as Eq. (10) does, not from P."""
    for mode in ASSEMBLY_MODES:
        theta = oracle.angles_on(mode, np.random.default_rng(seed), 40, g, clear=0.05)
        a1, b1, c1, y1, z1 = eq_7(theta, g)
        # The foot of the perpendicular from B1 on the line (7), and on along it to the sphere.
        size = a1**2 + b1**2
        foot = (c1 - b1 * z1) / size
        along = mode.planar * np.sqrt(g.l4**2 - y1**2 - foot**2 * size) / np.sqrt(size)
        link3 = np.stack([foot * a1 - along * b1, z1 + foot * b1 + along * a1], axis=-1)
        a2, b2 = rest_of_eq_10(theta, link3, g)
        beta = mode.sin_beta * np.arccos(b2 / a2)
        p = oracle.points(theta, *link3.T, beta, g)
        middle = (p["F1"] + p["D3"]) / 2
        np.testing.assert_allclose(forward(theta, mode, g), middle, rtol=0, atol=1e-9)
        for angles, point in zip(theta[:5], middle, strict=False):  # single angles go another way
            np.testing.assert_allclose(forward(angles, mode, g), point, rtol=0, atol=1e-9)


@any_geometry
@example(PAPER, 1)
@pytest.mark.parametrize("leg", [1, 2, 3])
def test_eqs_13_and_15_give_the_angles(leg: int, g: Geometry, seed: int) -> None:
    points = oracle.reachable_points(np.random.default_rng(seed), 100, g)
    s = oracle.postures(inverse_all(points, g), points, g)
    x, y, z = s.p[f"C{leg}"].T
    shift = {1: 0.0, 2: 2 * x, 3: -2 * x}[leg]
    common = x**2 + y**2 + z**2 - g.l4**2
    plus, minus = ((arm := g.l1 + sign * g.l3) * (arm + shift) + common for sign in (1, -1))
    gain, rest = (plus, minus) if leg == 2 else (minus, plus)
    root = np.sqrt(np.maximum(4 * z**2 * g.l3**2 - gain * rest, 0.0))
    theta = 2 * np.arctan((2 * g.l3 * z + [[1.0], [-1.0]] * root) / gain)
    off = np.abs(np.exp(1j * theta) - np.exp(1j * s.theta[:, leg - 1]))
    clear = (root > 1e-3) & (np.abs(gain) > 1e-3)  # half angles lose digits elsewhere
    assert off.min(axis=0)[clear].max() < 1e-9
    assert clear.mean() > 0.8
