"""For each misprint of the paper: its form does not hold, and ours does. Named by equation.

docs/paper.md lists them in words. The printed forms exist nowhere but here; those of the section
on topology are in test_paper_topology.py.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import oracle
import pytest

from tpm_gym.analysis.topology import mobility
from tpm_gym.arrays import FloatArray
from tpm_gym.errors import GeometryError
from tpm_gym.kinematics import (
    DEFAULT_ASSEMBLY,
    ELBOWS_OUT,
    WORKING_MODES,
    AssemblyMode,
    forward_all,
    inverse,
    inverse_all,
    jacobian,
)
from tpm_gym.kinematics.geometry import PAPER, Geometry

l1, l2, l3, l4, l5, l6, l7 = vars(PAPER).values()
CLOSED = 1e-12  # m^2; and open, below, is at least 1e-4 m^2 on half of the sample
OPEN = 1e-4


class Sample(SimpleNamespace):
    """Random postures of the oracle."""

    def __getitem__(self, name: str) -> FloatArray:
        """Return x, y, z of a point, (3, n)."""
        return np.asarray(self.p[name].T)


@pytest.fixture(scope="module")
def sample():
    found = oracle.reachable_postures(np.random.default_rng(0), 300, PAPER)
    assert np.abs(gap(found.p["B1"], found.p["C1"])).max() < CLOSED
    return Sample(**vars(found))


def gap(b: FloatArray, c: FloatArray) -> FloatArray:
    """Return f_i = |BC|^2 - l4^2 in m^2."""
    return np.asarray(((c - b) ** 2).sum(axis=-1) - l4**2)


def assert_closed(value: FloatArray, limit: float = CLOSED) -> None:
    assert np.abs(value).max() < limit


def assert_open(value: FloatArray) -> None:
    assert np.median(np.abs(value)) > OPEN


# Position analysis


def test_text_under_eq_7_y_b1_can_be_zero():
    theta_1 = np.arccos(-l1 / l3)
    assert abs(oracle.points([theta_1, 0, 0], 0, 0, 0, PAPER)["B1"][1]) < 1e-15
    rng = np.random.default_rng(1)
    theta = rng.uniform(-np.pi, np.pi, (20000, 3))
    theta[:, 0] = theta_1
    assert forward_all(theta).valid.any()  # not just on paper: the mechanism can be assembled there


def test_text_under_eq_7_a1_and_b1_vanish_together_at_any_l5_but_c1_only_at_l5_equal_l1():
    """If all three are zero, the circles of Eq. (6) coincide, and link 3' moves freely."""
    for half_short in (0.1, 0.2, l1):
        cos_2 = (l1 - 2 * half_short) / l3  # a1 = 0
        theta = [np.pi - np.arccos(cos_2), np.arccos(cos_2), 0.0]  # b1 = 0, y_B1 = 2 l5
        other = [np.arccos(cos_2), np.arccos(cos_2), 0.0]  # b1 = 0, y_B1 = 2 (l1 - l5)
        g = SimpleNamespace(**vars(PAPER) | {"l5": half_short})
        y_b = [oracle.points(t, 0, 0, 0, g)["B1"][1] for t in (theta, other)]
        np.testing.assert_allclose(y_b, [2 * half_short, 2 * (l1 - half_short)], atol=1e-15)
    for turn in np.linspace(0, 2 * np.pi, 7):  # l5 = l1: any point of the circle closes both rods
        x, z = l4 * np.cos(turn), l3 * np.sin(other[0]) + l4 * np.sin(turn)
        p = oracle.points(other, x, z, 0.0, g)
        assert abs(gap(p["B1"], p["C1"])) < CLOSED
        assert abs(gap(p["B2"], p["C2"])) < CLOSED
    with pytest.raises(GeometryError) as caught:
        Geometry(**vars(PAPER) | {"l5": l1})
    assert caught.value.name == "l5"


def test_eq_8b_second_line_gives_x_c1_not_z_c1(sample):
    (_, y1, z1), (x2, _, z2) = sample["B1"], sample["B2"]
    a1, b1 = 2 * (x2 + 2 * l5), 2 * (z2 - z1)
    c1 = (x2 + 2 * l5) ** 2 + z2**2 - y1**2 - z1**2
    regular = np.abs(a1) > 1e-2
    second = ((c1 - b1 * sample.z_c) / a1)[regular]
    np.testing.assert_allclose(second, sample.x_c[regular], atol=1e-11)
    printed, ours = sample.p["C1"][regular].copy(), sample.p["C1"][regular].copy()
    printed[:, 2], ours[:, 0] = second, second
    b = sample.p["B1"][regular]
    assert_closed(gap(b, ours), 1e-11)
    assert_open(gap(b, printed))


def test_forward_kinematics_prints_f1_equal_to_e1(sample):
    """With this P, the section on inverse kinematics does not find the posture."""
    printed_p = sample.p["E1"] + [l2, 0, 0]
    ours_p = sample.p["P"]
    for p, check in ((printed_p, assert_open), (ours_p, assert_closed)):
        d1 = np.stack([sample.x_c, 0 * sample.x_c, p[:, 2] - l6], axis=-1)  # "D1", inverse section
        check(gap(sample.p["B1"], d1 - [0, 0, l6]))
    np.testing.assert_allclose(printed_p[:, 2] + l6, ours_p[:, 2], atol=1e-15)


def test_eq_10_holds_for_our_f1_not_for_the_printed_f1(sample):
    """Eq. (10) as printed measures leg 3 from z_D1, so it presupposes z_D3 = z_D1 + l6."""
    x3, _, z3 = sample["B3"]
    reach, d1_z = sample["D1"][0] - x3 + 2 * l2, sample["D1"][2]
    a2 = 2 * l7 * reach
    b2 = l4**2 - l7**2 - reach**2 - (d1_z - z3) ** 2
    assert_closed(a2 * np.cos(sample.beta) - b2)
    printed_c3_z = d1_z - l6  # D3 = [.., z_D1] and C3 = D3 - l6
    b2_of_printed_points = b2 + (d1_z - z3) ** 2 - (printed_c3_z - z3) ** 2
    assert_open(a2 * np.cos(sample.beta) - b2_of_printed_points)


def test_forward_kinematics_prints_y_d3_minus_l6_as_z_of_c3(sample):
    printed = sample.p["C3"].copy()
    printed[:, 2] = sample["D3"][1] - l6
    assert_open(gap(sample.p["B3"], printed))
    assert_closed(gap(sample.p["B3"], sample.p["D3"] - [0, 0, l6]))


# Inverse kinematics


def half_angle(z: FloatArray, g: FloatArray, h: FloatArray) -> FloatArray:
    """Return Eqs. (13) and (15) for both signs, (2, n); NaN where not real."""
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(4 * z**2 * l3**2 - g * h)
        return np.asarray(2 * np.arctan((2 * l3 * z + [[1], [-1]] * root) / g))


def leg_gaps(sample: Sample, leg: int, angles: FloatArray) -> FloatArray:
    """Return f_leg at other angles of the leg, in m^2."""
    theta = np.repeat(sample.theta[None], 2, axis=0)
    theta[..., leg - 1] = angles
    arms = oracle.points(theta, sample.x_c, sample.z_c, sample.beta, PAPER)[f"B{leg}"]
    return gap(arms, sample.p[f"C{leg}"])


def assert_leg(
    sample: Sample, leg: int, printed: FloatArray, ours: FloatArray, among: Any = slice(None)
) -> None:
    """Check that our angles close the leg and contain the true one, and the printed ones do not."""
    turned = np.abs(np.exp(1j * ours) - np.exp(1j * sample.theta[:, leg - 1])).min(axis=0)
    # Half angles lose digits near g = 0 and near a double root, so judge where they do not.
    good = np.isfinite(ours).all(axis=0) & (np.abs(np.cos(ours / 2)).min(axis=0) > 1e-2)
    good &= np.abs(np.sin((ours[0] - ours[1]) / 2)) > 1e-2
    assert good[among].mean() > 0.8
    assert_closed(leg_gaps(sample, leg, ours)[:, good], 1e-10)
    assert turned[good].max() < 1e-9
    wrong = np.abs(leg_gaps(sample, leg, printed))
    assert (~(wrong < OPEN))[:, among].mean() > 0.95  # open, or not even real


def test_eq_13_leg_1_printed_swaps_g_and_h(sample):
    x, _, z = sample["C1"]
    minus = (l1 - l3) ** 2 - l4**2 + x**2 + z**2
    plus = (l1 + l3) ** 2 - l4**2 + x**2 + z**2
    printed, ours = half_angle(z, g=plus, h=minus), half_angle(z, g=minus, h=plus)
    assert_leg(sample, 1, printed, ours)
    # What the swap does: tan(theta / 2) is inverted, theta_1 becomes pi - theta_1.
    np.testing.assert_allclose(np.sin(printed), np.sin(ours[::-1]), atol=1e-7)
    np.testing.assert_allclose(np.cos(printed), -np.cos(ours[::-1]), atol=1e-7)


def test_eq_13_leg_2_printed_has_x_c1_squared_for_x_c2_squared(sample):
    x1, (x2, _, z) = sample.x_c, sample["C2"]

    def angles(square):
        g = (l1 + l3) ** 2 - l4**2 + square + z**2 + 2 * x2 * (l1 + l3)
        h = (l1 - l3) ** 2 - l4**2 + square + z**2 + 2 * x2 * (l1 - l3)
        return half_angle(z, g, h)

    apart = np.abs(x1**2 - x2**2) > 1e-2  # they agree where x_C1 = l5
    assert apart.mean() > 0.8
    assert_leg(sample, 2, angles(x1**2), angles(x2**2), among=apart)


def test_eq_15_printed_lacks_the_x_c3_terms(sample):
    x, y, z = sample["C3"]
    printed_g, printed_h = ((l1 + s * l3) ** 2 - l4**2 + y**2 + z**2 for s in (-1, 1))
    g = printed_g + x**2 - 2 * x * (l1 - l3)
    h = printed_h + x**2 - 2 * x * (l1 + l3)
    assert_leg(sample, 3, half_angle(z, printed_g, printed_h), half_angle(z, g, h))


def test_inverse_kinematics_prints_one_branch_of_d1(sample):
    x, y, z = sample["P"]
    printed = np.stack([x - l2 + np.sqrt(l7**2 - y**2), 0 * x, z - l6], axis=-1)
    found = np.abs(printed - sample.p["D1"]).max(axis=1) < 1e-9
    np.testing.assert_array_equal(found, np.cos(sample.beta) < 0)
    assert 0.3 < found.mean() < 0.7
    assert ELBOWS_OUT.cos_beta == 1  # the postures of the environments are on the other one
    ours = np.stack([x - l2 - l7 * np.cos(sample.beta), 0 * x, z - l6], axis=-1)
    np.testing.assert_allclose(ours, sample.p["D1"], atol=1e-12)


def test_number_of_inverse_solutions_is_2_2_2_2_not_4_4_2():
    """The paper multiplies 4 by 4 by 2 to 16. Four theta_1 and four theta_2 share two betas."""
    theta = inverse_all([-0.04, 0.028, 0.80]).theta
    assert np.isfinite(theta).all()
    different = [len(np.unique(theta[:, leg].round(9))) for leg in range(3)]
    assert different == [4, 4, 2]
    assert np.prod(different) == 32
    assert len(np.unique(theta.round(9), axis=0)) == len(WORKING_MODES) == 2**4 == 16


# Singularities. Eqs. (16), (17) are in centimetres, the lengths of the case study in millimetres.


def numeric_determinant(sample: Sample) -> FloatArray:
    """Return det of d(f1, f2)/d(xC, zC), m^2, by central differences (exact for squares)."""
    step = 1e-3
    columns = []
    for dx, dz in ((step, 0.0), (0.0, step)):
        up, down = (
            oracle.points(
                sample.theta, sample.x_c + s * dx, sample.z_c + s * dz, sample.beta, PAPER
            )
            for s in (1, -1)
        )
        columns.append(
            [
                (gap(up[b], up[c]) - gap(down[b], down[c])) / (2 * step)
                for b, c in (["B1", "C1"], ["B2", "C2"])
            ]
        )
    (f1x, f2x), (f1z, f2z) = columns
    return np.asarray(f1x * f2z - f1z * f2x)


def test_eq_16_planar_factor_lacks_its_second_product(sample):
    s1, s2, c2 = np.sin(sample.theta[:, 0]), np.sin(sample.theta[:, 1]), np.cos(sample.theta[:, 1])
    truth = numeric_determinant(sample) / 4
    ours = sample.x_c * (sample.z_c - l3 * s2)
    ours = ours - (sample.z_c - l3 * s1) * (sample.x_c - 2 * l5 + l1 - l3 * c2)
    np.testing.assert_allclose(ours, truth, rtol=0, atol=1e-9)
    x, z = 100 * sample.x_c, 100 * sample.z_c
    printed = x * (35 * s2 - z)
    ratio = printed / truth
    assert np.ptp(np.quantile(ratio, [0.1, 0.9])) > 0.5 * abs(np.median(ratio))
    wrong_side = np.sign(-printed) != np.sign(truth)  # and so its zeros are elsewhere
    assert wrong_side.mean() > 0.05


def test_eq_16_other_factors_are_as_printed_in_centimetres(sample):
    x3 = sample["B3"][0]
    printed = 35 * np.cos(sample.theta[:, 2]) - 100 * sample.x_c + 16
    np.testing.assert_allclose(printed / 100, x3 - sample.x_c - 2 * l2, atol=1e-12)
    in_millimetres = 35 * np.cos(sample.theta[:, 2]) - 1000 * sample.x_c + 16
    assert np.median(np.abs(in_millimetres / 1000 - (x3 - sample.x_c - 2 * l2))) > 0.1


def motor_derivative(sample: Sample, leg: int) -> FloatArray:
    """Return d f_leg / d theta_leg in cm^2/rad, by differences of fourth order."""

    def value(turn):
        return leg_gaps(sample, leg, sample.theta[:, leg - 1] + turn)[0]

    step = 1e-3
    slope = 8 * (value(step) - value(-step)) - (value(2 * step) - value(-2 * step))
    return np.asarray(1e4 * slope / (12 * step))


def test_eq_17_theta_1_factor_is_as_printed_in_centimetres(sample):
    s, c, z = np.sin(sample.theta[:, 0]), np.cos(sample.theta[:, 0]), 100 * sample.z_c
    printed = -2100 * s - 70 * z * c
    np.testing.assert_allclose(printed, motor_derivative(sample, 1), atol=1e-5)
    in_millimetres = -2100 * s - 70 * 1000 * sample.z_c * c
    assert np.median(np.abs(in_millimetres - motor_derivative(sample, 1))) > 1e3


def test_eq_17_theta_2_factor_lacks_x_c1(sample):
    s, c = np.sin(sample.theta[:, 1]), np.cos(sample.theta[:, 1])
    x, z, truth = 100 * sample.x_c, 100 * sample.z_c, motor_derivative(sample, 2)
    printed = 1400 * s - 70 * z * c
    ours = 70 * x * s + 700 * s - 70 * z * c
    np.testing.assert_allclose(ours, truth, atol=1e-5)
    assert np.median(np.abs(printed - truth)) > 100
    np.testing.assert_allclose(printed - truth, 70 * (10 - x) * s, atol=1e-5)  # right at x_C1 = l5


def test_eq_17_theta_3_factor_lacks_l6(sample):
    """It is printed with z_C1 in place of z_C3 = z_C1 + l6, as if F1 were E1; Eq. (10) is right."""
    s, c, cb = np.sin(sample.theta[:, 2]), np.cos(sample.theta[:, 2]), np.cos(sample.beta)
    x, z, truth = 100 * sample.x_c, 100 * sample.z_c, motor_derivative(sample, 3)
    printed = 350 * cb * s + 70 * x * s - 1120 * s - 70 * z * c
    ours = printed - 70 * c  # 70 l6, l6 = 1 cm
    np.testing.assert_allclose(ours, truth, atol=1e-5)
    assert np.median(np.abs(printed - truth)) > 10


def test_text_on_singularities_beta_pi_over_2_is_serial_and_beta_0_is_parallel():
    at_edge = inverse([-0.04, l7, 0.80])  # beta = pi/2
    beside = jacobian.factors(at_edge)
    assert abs(beside.serial[0]) < 1e-7  # cos(beta), of Eq. (17)
    assert abs(beside.parallel[0]) > 0.99  # sin(beta), of Eq. (16)
    assert np.isfinite(jacobian.velocity(at_edge)).all()  # J exists: no parallel singularity
    assert np.abs(jacobian.velocity(at_edge)[1]).max() < 1e-6  # and y is stuck: a serial one
    # beta -> 0: J grows without bound as 1/y, "a vertical plane ... parallel to the plane (xz)"
    beside_plane = [jacobian.velocity(inverse([-0.04, y, 0.80])) for y in (1e-3, 1e-4, 1e-5)]
    sizes = [np.abs(j[1]).max() for j in beside_plane]
    np.testing.assert_allclose(np.divide(sizes[1:], sizes[:-1]), 10, rtol=1e-2)


def test_conclusion_decoupling_is_partial():
    """Link 3' follows theta_1 and theta_2 alone, but every coordinate of P follows all three."""
    theta, step = inverse([-0.04, 0.028, 0.80]), 1e-4
    moved = theta + [0, 0, step]
    slot = DEFAULT_ASSEMBLY.index
    link3 = [forward_all(t).link3[slot] for t in (theta, moved)]
    np.testing.assert_array_equal(*link3)
    j = jacobian.velocity(theta)
    assert (np.abs(j[:2]) > 1e-2).all()
    assert (np.abs(j[2, :2]) > 1e-2).all()
    assert abs(j[2, 2]) < 1e-12  # the one zero: height is link 3's
    assert np.count_nonzero(np.abs(j) > 1e-9) == 8  # complete decoupling would leave three


def test_singularities_lack_the_constraint_singularity_z_c1_equal_z_b1():
    """There link 3' can turn about y, while every factor of Eqs. (16) and (17) is far from 0."""
    theta_1 = np.arccos(0.6)
    point, branch = oracle.level_rod_4(theta_1, np.arcsin(0.6)), AssemblyMode(1, 1)
    theta = inverse_all(point).theta
    theta = theta[np.abs(theta[:, 0] - theta_1) < 1e-9]
    slot = branch.index
    real = np.abs(forward_all(theta).position[:, slot] - point).max(axis=1) < 1e-9
    assert real.any()
    for angles in theta[real]:
        factors = jacobian.factors(angles, branch)
        assert np.abs(factors.parallel / [1, l4, l4**2]).min() > 0.3
        assert np.abs(factors.serial / [1, l3 * l4, l3 * l4, l3 * l4]).min() > 0.3
        assert jacobian.conditioning(angles, branch) > 0.1
        found = mobility(angles, branch)
        assert found.dof == 4
        np.testing.assert_allclose(np.abs(found.platform.rotations.basis), [[0, 1, 0]], atol=1e-9)
