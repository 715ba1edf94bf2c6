"""Every real branch closes every loop to 1e-12 m, and none is missed.

The root finder (tests/support/roots.py) is independent of the package: it is given the closure
equations, written out from the table of points.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import oracle
import pytest
from assemblies import assemblies
from examples import examples
from hypothesis import strategies as st
from roots import circle_roots, unit, unmatched

from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics import ASSEMBLY_MODES, forward_all, inverse_all, jacobian
from tpm_gym.kinematics.geometry import PAPER, WIDE, Geometry

Solve = Callable[..., Any]
CLOSED = 1e-12
BLOCK = 20_000


def angles(rng: np.random.Generator, count: int) -> FloatArray:
    return rng.uniform([-np.pi, 0, -np.pi], [np.pi, 2 * np.pi, np.pi], (count, 3))


def positions(rng: np.random.Generator, count: int, g: Geometry) -> FloatArray:
    """Points of the box around all that the rods reach; about half have a posture."""
    reach = g.l3 + g.l4
    low, high = [g.l1 - g.l2 - reach, -g.l7, -reach], [g.l2 + g.l7 + g.l4, g.l7, reach]
    return rng.uniform(low, high, (count, 3))


def draw(solve: Solve, rng: np.random.Generator, count: int, g: Geometry) -> FloatArray:
    return angles(rng, count) if solve is forward_all else positions(rng, count, g)


def gaps(found: Any, given: FloatArray, g: Geometry) -> FloatArray:
    """The largest opening of any loop, m, of each branch (n,) found for the inputs given."""
    s = oracle.postures(found, given, g)
    rods = np.abs(np.linalg.norm(oracle.rods(s.p), axis=-1) - g.l4).max(axis=-1)
    worst: FloatArray = np.maximum(rods, np.linalg.norm(s.p["P"] - s.position, axis=-1))
    assert np.isfinite(worst).all()
    return worst


def worst(solve: Solve, count: int, g: Geometry, seed: int) -> tuple[float, int]:
    """The largest gap over all branches of random inputs, and the number of branches."""
    rng, largest, branches = np.random.default_rng(seed), 0.0, 0
    for _ in range(0, count, BLOCK):
        given = draw(solve, rng, min(BLOCK, count), g)
        gap = gaps(solve(given, g), given, g)
        largest, branches = max(largest, float(gap.max())), branches + len(gap)
    return largest, branches


both_ways = pytest.mark.parametrize("solve", [forward_all, inverse_all])
both_lengths = pytest.mark.parametrize("g", [PAPER, WIDE])


@both_lengths
@both_ways
@pytest.mark.parametrize("count", [10_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_random_inputs_close(count, solve, g):
    gap, branches = worst(solve, count, g, seed=1)
    assert gap < CLOSED
    assert branches > 0.2 * count


@examples(40, oracle.geometries(), oracle.seeds())
def test_any_geometry_closes(g, seed):
    assert worst(forward_all, 500, g, seed)[0] < CLOSED
    assert worst(inverse_all, 500, g, seed)[0] < CLOSED


def numeric_forward(theta: FloatArray, g: Geometry) -> list[FloatArray]:
    """Positions (k, 3) of all assemblies of each theta, with link 3' level."""
    return [found[:, :3] for found in assemblies(theta, g, (False,))]


def numeric_inverse(points: FloatArray, g: Geometry) -> list[FloatArray]:
    """Angles (k, 4), beta and theta, of all postures of each point."""
    row, beta = circle_roots(lambda r, b: g.l7 * np.sin(b) - points[:, 1][r], len(points))
    x, y, z = points[row].T
    x_c, z_c = x - g.l2 - g.l7 * np.cos(beta), z - 2 * g.l6
    # C_i - A_i along the arm's level direction, up, and across
    level = [-g.l1 + 0 * x, x_c - 2 * g.l5 + g.l1, x + g.l2 - g.l1]
    up, across = [z_c, z_c, z - g.l6], [x_c, 0 * x, y]

    def loop(leg):
        def gap(index, theta):
            a = level[leg][index] - g.l3 * np.cos(theta)
            b = up[leg][index] - g.l3 * np.sin(theta)
            return a**2 + b**2 + across[leg][index] ** 2 - g.l4**2

        return gap

    legs = [circle_roots(loop(leg), len(row)) for leg in range(3)]
    found: list[list[list[float]]] = [[] for _ in points]
    ends = [np.searchsorted(index, np.arange(len(row) + 1)) for index, _ in legs]
    for i in range(len(row)):
        one, two, three = (
            roots[end[i] : end[i + 1]] for (_, roots), end in zip(legs, ends, strict=True)
        )
        found[row[i]] += [[beta[i], a, b, c] for a in one for b in two for c in three]
    return [np.array(some).reshape(-1, 4) for some in found]


def both(solve: Solve, some: FloatArray, g: Geometry) -> tuple[list[FloatArray], list[FloatArray]]:
    """The solutions of each input by the root finder, and ours."""
    found = solve(some, g)
    if solve is forward_all:
        ours = [p[valid] for p, valid in zip(found.position, found.valid, strict=True)]
        return numeric_forward(some, g), ours
    all_angles = np.concatenate([found.beta[..., None], found.theta], axis=-1)
    ours = [unit(rows[valid]) for rows, valid in zip(all_angles, found.valid, strict=True)]
    return [unit(roots) for roots in numeric_inverse(some, g)], ours


def check(solve: Solve, count: int, g: Geometry, seed: int) -> int:
    given = draw(solve, np.random.default_rng(seed), count, g)
    other, compared, worst = 0, 0, 0.0
    for some in np.split(given, range(500, count, 500)):
        result = unmatched(*both(solve, some, g))
        other, compared, worst = other + result[0], compared + result[1], max(worst, result[2])
    name = solve.__name__
    print(f"{name}, l7 {g.l7}: {other} of {count} differ; {compared} roots, {worst:.1e} apart")
    assert other == 0
    # Near tangency, a root is known to the square root of rounding.
    assert worst < 1e-6
    return compared


@both_lengths
@pytest.mark.parametrize("count", [200, pytest.param(10_000, marks=pytest.mark.slow)])
def test_no_branch_is_missed(count, g):
    assert check(forward_all, count, g, seed=3) > 0.2 * count
    assert check(inverse_all, count, g, seed=4) > 4 * count


@examples(10, oracle.geometries(), oracle.seeds())
def test_no_branch_is_missed_for_any_geometry(g, seed):
    check(forward_all, 40, g, seed)
    check(inverse_all, 40, g, seed)


def test_the_root_finder_finds_pairs_between_its_samples():
    offset = np.array([1 - 1e-9, 1 + 1e-9, -1 + 1e-12, 0.3, -1 - 1e-12])
    rows, roots = circle_roots(lambda row, a: np.cos(a - 0.7) - offset[row], 5)
    assert rows.tolist() == [0, 0, 2, 2, 3, 3]
    np.testing.assert_allclose(np.cos(roots - 0.7), offset[rows], rtol=0, atol=1e-15)


OFFS = [-1e-6, -1e-9, -1e-11, 1e-11, 1e-9, 1e-6]


@pytest.mark.parametrize("off", OFFS)
def test_postures_about_to_merge_close_and_none_is_missed(off):
    """Leg 2 within a relative ``off`` of being folded."""
    rng, g = np.random.default_rng(7), PAPER
    points = positions(rng, 400, g)
    radius, beta = (g.l4 - g.l3) * (1 + off), np.arcsin(points[:, 1] / g.l7)
    turn = rng.uniform(-np.pi, np.pi, 400)
    x_c, z_c = 2 * g.l5 - g.l1 + radius * np.cos(turn), radius * np.sin(turn)
    points[:, 0], points[:, 2] = x_c + g.l2 + g.l7 * np.cos(beta), z_c + 2 * g.l6
    found = inverse_all(points, g)
    right = found.valid[:, 8:].any(axis=-1)  # cos(beta) > 0, as the points were made
    assert right.sum() > 100 if off > 0 else not right.any()
    assert gaps(found, points, g).max() < CLOSED
    numeric = numeric_inverse(points, g)
    assert [len(roots) for roots in numeric] == found.valid.sum(axis=-1).tolist()


@pytest.mark.parametrize("off", OFFS)
def test_circles_about_to_touch_close_and_no_assembly_is_missed(off):
    """The circle of B1C1 within a relative ``off`` of touching that of B2C2 from inside."""
    rng, g = np.random.default_rng(8), WIDE
    theta = angles(rng, 400)
    y1, z1 = g.l1 + g.l3 * np.cos(theta[:, 0]), g.l3 * np.sin(theta[:, 0])
    touching = (g.l4 - np.sqrt(g.l4**2 - y1**2)) * (1 + off)

    def apart(row, turn):
        x2, z2 = -g.l1 + g.l3 * np.cos(turn) + 2 * g.l5, g.l3 * np.sin(turn)
        return np.hypot(x2, z2 - z1[row]) - touching[row]

    row, turn = circle_roots(apart, len(theta))
    theta = np.stack([theta[row, 0], turn, theta[row, 2]], axis=-1)
    found = forward_all(theta, g)
    assert found.valid.any(axis=-1).sum() > 50 if off > 0 else not found.valid.any()
    assert gaps(found, theta, g).max(initial=0.0) < CLOSED
    numeric = numeric_forward(theta, g)
    assert [len(roots) for roots in numeric] == found.valid.sum(axis=-1).tolist()


@pytest.mark.parametrize("angle", [1e-1, 1e-2, 1e-4, 1e-5, 1e-6, 1e-7, 0.0])
@pytest.mark.parametrize("folded", [False, True])
def test_assemblies_about_to_merge_at_y_0_are_not_missed(angle, folded):
    """Link 7 within ``angle`` of beta = 0 or pi: rounding alone can make cos(beta) exceed 1."""
    g, points = PAPER, positions(np.random.default_rng(9), 1500, PAPER)
    points[:, 1] = g.l7 * np.sin(angle)
    posture = inverse_all(points)
    valid = posture.valid.copy()
    valid[:, slice(8, 16) if folded else slice(0, 8)] = False
    theta, target = posture.theta[valid], points[np.nonzero(valid)[0]]
    found = forward_all(theta)
    errors = np.abs(found.position - target[:, None]).max(axis=-1)
    missed = np.where(found.valid, errors, np.inf).min(axis=-1) > 1e-6
    assert len(target) > 5_000
    # y goes with the square root of rounding there, which grows as 1 / |level3 planar|: within a
    # hair of those factors' zeros a point may be found farther off, but hardly ever.
    assert missed.mean() < 1e-3
    assert gaps(found, theta, g).max() < CLOSED


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_edge_in_y_belongs_to_the_workspace_and_nothing_beyond(sign):
    points = oracle.vector(-0.05, sign * PAPER.l7 * np.array([1, 1 + 1e-15, 1 + 1e-11]), 0.78)
    found = inverse_all(points)
    assert found.valid.all(axis=-1).tolist() == [True, True, False]
    assert not found.valid[2].any()
    assert gaps(found, points, PAPER).max() < CLOSED


@examples(40, oracle.geometries(), oracle.seeds(), st.floats(0.05, 20))
def test_lengths_scale_positions_alone(g, seed, factor):
    bigger = oracle.scaled(g, factor)
    rng = np.random.default_rng(seed)
    points = oracle.reachable_points(rng, 50, g)
    one, other = inverse_all(points, g), inverse_all(factor * points, bigger)
    np.testing.assert_array_equal(one.valid, other.valid)
    np.testing.assert_allclose(np.exp(1j * one.theta), np.exp(1j * other.theta), atol=1e-6)
    np.testing.assert_allclose(one.beta, other.beta, rtol=0, atol=1e-7)
    theta = angles(rng, 200)
    small, large = forward_all(theta, g), forward_all(theta, bigger)
    np.testing.assert_array_equal(small.valid, large.valid)
    np.testing.assert_allclose(factor * small.position, large.position, rtol=0, atol=1e-6 * factor)
    for mode in ASSEMBLY_MODES:
        real = theta[small.valid[:, mode.index]]
        values = [jacobian.conditioning(real, mode, lengths) for lengths in (g, bigger)]
        np.testing.assert_allclose(*values, rtol=0, atol=1e-7)


@examples(40, oracle.geometries(), oracle.seeds())
def test_the_mechanism_is_symmetric_in_y(g, seed):
    rng = np.random.default_rng(seed)
    points = oracle.reachable_points(rng, 50, g)
    one, other = inverse_all(points, g), inverse_all(points * [1, -1, 1], g)
    np.testing.assert_array_equal(one.theta, other.theta)
    np.testing.assert_array_equal(one.beta, -other.beta)
    theta = angles(rng, 200)
    found = forward_all(theta, g)
    mirrored = found.position[:, [1, 0, 3, 2]] * [1, -1, 1]
    np.testing.assert_array_equal(found.position, mirrored)
    for planar in (0, 2):
        real = theta[found.valid[:, planar]]
        values = [jacobian.conditioning(real, ASSEMBLY_MODES[planar + i], g) for i in (0, 1)]
        np.testing.assert_allclose(*values, rtol=0, atol=1e-12)
