"""Link 3' turned: no assembly is missed or invented, all close, and their rates are right."""

import numpy as np
import oracle
import pytest
from assemblies import assemblies
from examples import examples
from hypothesis import example
from roots import unmatched

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import InputError
from tpm_gym.kinematics import (
    ROTATED_MODES,
    RotatedPostures,
    forward_all,
    forward_rotated,
    inverse_rotated,
    rotated,
)
from tpm_gym.kinematics.geometry import PAPER, WIDE, Geometry

CLOSED = 1e-12
TWICE = np.array([2.9273867, 6.19840851, 2.63588765])
EIGHT = np.array([-2.22, -1.27, -2.11])

THIRD = np.linspace(-3.0, 3.0, 61)


def angles(rng: np.random.Generator, count: int) -> FloatArray:
    return rng.uniform(-np.pi, np.pi, (count, 3))


def random_geometry(seed: int) -> Geometry:
    rng = np.random.default_rng(seed)
    l1, arm = rng.uniform(0.15, 0.5), rng.choice([rng.uniform(0.6, 0.95), rng.uniform(1.05, 1.6)])
    low, high = (0.02, 0.5, 0.03, 0.0, 0.02), (0.15, 1.2, 0.14, 0.05, 0.15)
    l2, l4, l5, l6, l7 = rng.uniform(low, high)
    return Geometry(l1, l2, l1 * arm, l4, l5, l6, l7)


def gap(found: RotatedPostures, g: Geometry) -> float:
    """The widest opening of any of the six rods, m, from the points written out."""
    s = found.valid
    theta, (x_c, z_c), beta = found.theta[s], found.link3[s].T, found.beta[s]
    turn = oracle.turn_about_y(found.tilt[s])
    zero = 0 * beta
    flat = oracle.points(theta, zero, zero, beta, g)  # C1 = O, not turned
    c1 = oracle.vector(x_c, 0.0, z_c)
    half_x, half_y = np.array([g.l5, 0, 0]), np.array([0, g.l5, 0])
    ends = {name: c1 + np.einsum("nij,nj->ni", turn, flat[name]) for name in ("C2", "C3", "P")}
    across = turn @ half_x
    rods = [
        *(c1 + side * across - flat["B1"] - side * half_x for side in (1, -1)),
        ends["C2"] - flat["B2"],
        *(ends["C3"] + side * (turn @ half_y) - flat["B3"] - side * half_y for side in (1, -1)),
    ]
    np.testing.assert_allclose(found.orientation[s], turn, atol=1e-15)
    np.testing.assert_allclose(found.position[s], ends["P"], atol=1e-15)
    return max(float(np.abs(np.linalg.norm(rod, axis=-1) - g.l4).max(initial=0)) for rod in rods)


def ours(theta: FloatArray, g: Geometry) -> list[FloatArray]:
    level, turned = forward_all(theta, g), forward_rotated(theta, g)
    assert gap(turned, g) < CLOSED
    tilt = np.concatenate([0 * level.beta, turned.tilt], axis=-1)[..., None]
    position = np.concatenate([level.position, turned.position], axis=-2)
    rows = np.concatenate([position, np.cos(tilt), np.sin(tilt)], axis=-1)
    valid = np.concatenate([level.valid, turned.valid], axis=-1)
    return [some[real] for some, real in zip(rows, valid, strict=True)]


FEW = [(300, g) for g in (PAPER, WIDE, random_geometry(0), random_geometry(1))]
MANY = [(10_000, g) for g in (PAPER, WIDE, *map(random_geometry, range(20)))]


@pytest.mark.parametrize(
    ("count", "g"), [*FEW, *(pytest.param(*case, marks=pytest.mark.slow) for case in MANY)]
)
def test_no_assembly_of_either_mode_is_missed_or_invented(count, g):
    given, other, compared, worst = angles(np.random.default_rng(1), count), 0, 0, 0.0
    for some in np.split(given, range(500, count, 500)):
        result = unmatched(assemblies(some, g), ours(some, g))
        other, compared, worst = other + result[0], compared + result[1], max(worst, result[2])
    print(f"{g}: {other} of {count} differ; {compared} assemblies, {worst:.1e} apart")
    assert other == 0
    assert worst < 1e-6
    assert compared > 0.1 * count


def test_the_assembly_of_an_independent_check():
    found = forward_rotated(TWICE)
    assert np.flatnonzero(found.valid).tolist() == [4, 5]
    np.testing.assert_allclose(np.degrees(found.tilt[4:6]), -127.60, atol=0.005)


def test_there_are_eight_at_most_and_eight_there_are():
    assert [mode.index for mode in ROTATED_MODES] == list(range(8))
    found = forward_rotated(EIGHT)
    assert found.valid.all()
    assert gap(found, PAPER) < CLOSED
    rows = np.concatenate([found.position, found.tilt[:, None]], axis=-1)
    apart = np.linalg.norm(rows[:, None] - rows, axis=-1) + np.eye(8)
    assert apart.min() > 1e-3


@examples(25, oracle.geometries(), oracle.seeds())
@example(PAPER, 1)
def test_slots_have_the_signs_of_their_names(g, seed):
    found = forward_rotated(angles(np.random.default_rng(seed), 1000), g)
    parallel = rotated.factors(found).parallel
    # Seen along y, rods longer than links 3: else the sign is another one
    long = (g.l4**2 - (g.l1 + g.l3 * np.cos(found.theta[..., 0])) ** 2) > 4 * g.l5**2
    for mode in ROTATED_MODES:
        here = found.valid[:, mode.index] & long[:, mode.index]
        sin_beta, _, planar = parallel[here, mode.index].T
        assert (np.sign(sin_beta) == mode.sin_beta).all()
        assert (np.sign(planar) == mode.planar).all()
        if mode.further > 0:
            first, second = found.tilt[here][:, [mode.index - 2, mode.index]].T % (2 * np.pi)
            assert not (first >= second).any()  # the first may lack rod 11


@examples(25, oracle.geometries(), oracle.seeds())
@example(PAPER, 1)
@example(WIDE, 1)
def test_inverse_closes_and_contains_the_angles_again(g, seed):
    given = forward_rotated(angles(np.random.default_rng(seed), 300), g)
    theta, position = given.theta[given.valid], given.position[given.valid]
    found = inverse_rotated(position, g)
    assert gap(found, g) < CLOSED
    at = np.broadcast_to(position[:, None], found.position.shape)[found.valid]
    np.testing.assert_allclose(found.position[found.valid], at, rtol=0, atol=1e-14)
    apart = np.abs(np.exp(1j * found.theta) - np.exp(1j * theta[:, None])).max(axis=-1)
    serial = rotated.factors(given).serial[given.valid] / [1, *[g.l3 * g.l4] * 3]
    far = np.abs(serial).min(axis=-1) > 1e-3  # nearer, two postures are about to merge
    assert far.sum() > 0.8 * len(far)
    assert (np.where(found.valid, apart, np.inf).min(axis=-1)[far]).max() < 1e-9


@examples(25, oracle.geometries(), oracle.seeds())
def test_inverse_then_forward_returns_in_every_slot(g, seed):
    reach = g.l3 + g.l4
    low, high = [-reach, -g.l7, -reach], [reach, g.l7, reach]
    some = np.random.default_rng(seed).uniform(low, high, (100, 3))
    found = inverse_rotated(some, g)
    tilt, position = found.tilt[found.valid], found.position[found.valid]
    again = forward_rotated(found.theta[found.valid], g)
    apart = np.abs(np.exp(1j * again.tilt) - np.exp(1j * tilt[:, None]))
    apart += np.linalg.norm(again.position - position[:, None], axis=-1)
    factors = rotated.factors(found)
    parallel = factors.parallel[found.valid] / [1.0, g.l4, g.l4**2]
    far = np.abs(parallel).min(axis=-1) > 1e-3
    assert np.where(again.valid, apart, np.inf).min(axis=-1)[far].max(initial=0) < 1e-9


def test_inverse_has_its_slots_in_order():
    points = np.random.default_rng(5).uniform([-0.8, -0.05, -1.1], [0.9, 0.05, 1.1], (2000, 3))
    found = inverse_rotated(points)
    cos, _, leg2, leg3 = np.moveaxis(rotated.factors(found).serial, -1, 0).reshape(
        4, -1, 2, 6, 2, 2
    )
    sign = np.array([-1.0, 1.0])
    for factor, expected in ((cos, sign[:, None, None, None]), (leg2, sign[:, None]), (leg3, sign)):
        assert not (factor * expected < 0).any()
    tilt = found.tilt.reshape(-1, 2, 6, 2, 2)
    assert not (np.diff(tilt, axis=2) < 0).any()
    assert found.valid.sum() > 5000


@examples(15, oracle.geometries(), oracle.seeds())
@example(PAPER, 1)
def test_velocity_is_the_derivative_and_its_determinant_is_the_factors(g, seed):
    theta, step = angles(np.random.default_rng(seed), 500), 1e-6
    found = forward_rotated(theta, g)
    factors, j = rotated.factors(found), rotated.velocity(found)
    size = np.array([1.0, g.l4, g.l4**2])
    far = found.valid & (np.abs(factors.parallel / size).min(axis=-1) > 0.02)
    far &= np.abs(factors.elevation) > 0.02 * g.l4
    assert far.sum() > 10
    for motor, by in enumerate(step * np.eye(3)):
        ahead, behind = forward_rotated(theta + by, g), forward_rotated(theta - by, g)
        for rows, a, b in (
            (j[..., :3, motor], ahead.position, behind.position),
            (j[..., 3:, motor], ahead.tilt[..., None], behind.tilt[..., None]),
        ):
            slope = ((a - b) / (2 * step))[far]
            still = np.abs(slope).max(axis=-1) < 1e3  # slots that were renumbered jump
            assert still.mean() > 0.99
            scale = np.maximum(1.0, np.abs(rows[far]))
            assert (np.abs(rows[far] - slope) / scale)[still].max() < 1e-3
    assert (j[far][:, 3, 2] == 0).all()  # motor 3 does not turn link 3'
    products = factors.serial[far].prod(axis=-1), factors.parallel[far].prod(axis=-1)
    determinant = np.linalg.det(j[far][:, :3])
    np.testing.assert_allclose(determinant * products[1], products[0], rtol=1e-8, atol=1e-12)


def test_where_rods_4a_4b_and_6_meet_in_a_point_the_planar_factor_is_zero():
    """Seen along y, its size over that of rod 6's moment about the crossing is regular."""
    found = forward_rotated(angles(np.random.default_rng(3), 3000))
    factors = rotated.factors(found)
    clear = found.valid & (np.abs(factors.elevation) > 0.05)
    rods, ends = found.rods[clear][..., [0, 2]], found.ends[clear][..., [0, 2]]

    def cross(a, b):
        return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])

    share = cross(ends[:, 1] - ends[:, 0], rods[:, 1]) / cross(rods[:, 0], rods[:, 1])
    crossing = ends[:, 0] + share[:, None] * rods[:, 0]
    moment = cross(ends[:, 2] - crossing, rods[:, 2])
    # It is the velocity of C2, per turn of link 3' about the crossing, along rod 6.
    np.testing.assert_allclose(-moment, factors.parallel[clear][:, 2], rtol=0, atol=1e-12)


def test_where_eq_6_has_one_circle_twice_both_ways_of_b1c1_are_found():
    """B2 + 2 l5 above B1: two tilts, and for each of them B1C1 can point either way."""
    theta_2 = np.arccos((PAPER.l1 - 2 * PAPER.l5) / PAPER.l3)
    pair = [np.pi - theta_2, theta_2]
    c1, tilt = rotated.link3_rotated(np.array([*pair, 0.0]))
    assert len(np.unique(tilt.round(9))) == 2
    assert len(np.unique(c1.round(9))) == 4
    theta = np.array([[*pair, theta_3] for theta_3 in THIRD])
    other, compared, worst = unmatched(assemblies(theta, PAPER), ours(theta, PAPER))
    assert (other, worst < 1e-6) == (0, True)
    assert compared > 2


def test_two_tilts_next_to_each_other_with_b1c1_either_way_are_both_found():
    """From a search: 7e-4 and 9e-4 rad apart."""
    theta = np.array([[1.688993009, 1.019125755, 2.181463313], [2.024924836, 0.840101917, -2.9699]])
    other, compared, worst = unmatched(
        assemblies(theta, random_geometry(2)), ours(theta, random_geometry(2))
    )
    assert (other, compared, worst < 1e-6) == (0, 8, True)


def test_where_b2_is_at_the_foot_of_rod_4b_what_is_found_closes():
    """Seen along y; there the first coefficient of the polynomial in exp(i phi) is zero."""
    theta_2 = np.arccos((PAPER.l1 - PAPER.l5) / PAPER.l3)
    pairs = [[turn, theta_2, theta_3] for turn in (theta_2, np.pi - theta_2) for theta_3 in THIRD]
    assert gap(forward_rotated(pairs), PAPER) < CLOSED


@pytest.mark.parametrize("shape", [(), (5,), (2, 3), (0,)])
def test_leading_shapes(shape):
    theta = np.random.default_rng(0).uniform(-3, 3, (*shape, 3))
    found, back = forward_rotated(theta), inverse_rotated(theta)
    for postures, slots in ((found, 8), (back, 48)):
        assert postures.theta.shape == (*shape, slots, 3)
        assert postures.position.shape == (*shape, slots, 3)
        assert postures.orientation.shape == (*shape, slots, 3, 3)
        assert postures.valid.shape == postures.tilt.shape == (*shape, slots)
        assert rotated.velocity(postures).shape == (*shape, slots, 4, 3)
        assert rotated.factors(postures).serial.shape == (*shape, slots, 4)
    for index in np.ndindex(*shape):
        np.testing.assert_array_equal(forward_rotated(theta[index]).tilt, found.tilt[index])


def test_what_is_not_finite_has_no_posture_and_what_is_no_array_is_refused():
    given = np.array([[np.nan, 0, 0], [0, np.inf, 0], TWICE, [0, 0, np.nan], [1e300, 1e300, 0]])
    assert forward_rotated(given).valid.sum(axis=-1).tolist()[:4] == [0, 0, 2, 0]
    assert not inverse_rotated([[np.nan, 0, 0], [0, np.inf, 0], [1e300, 0, 0]]).valid.any()
    assert not inverse_rotated([0, 1.001 * PAPER.l7, 0.7]).valid.any()
    for solve in (forward_rotated, inverse_rotated):
        for wrong in ([0, 0], "abc", [0, 0, 1j]):
            with pytest.raises(InputError):
                solve(wrong)
        with pytest.raises(InputError, match="geometry"):
            solve([0, 0, 0], 3)
