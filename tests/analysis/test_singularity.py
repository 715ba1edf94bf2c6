"""Singularities agree with the oracle's factors, and their distances with brute force."""

import math

import numpy as np
import oracle
import pytest
from examples import examples
from hypothesis import strategies as st

from tpm_gym.analysis import sheets, singularity
from tpm_gym.analysis.singularity import FACTORS, SingularityType, nearest_singularity
from tpm_gym.arrays import FloatArray
from tpm_gym.errors import ConfigurationError, InputError, UnreachableError
from tpm_gym.kinematics import (
    ASSEMBLY_MODES,
    ELBOWS_OUT,
    WORKING_MODES,
    AssemblyMode,
    WorkingMode,
    inverse,
    workspace,
)
from tpm_gym.kinematics.geometry import PAPER, Geometry

HOME = np.array([-0.05, 0.03, 0.78])
LEVEL = np.array([-0.5063602842493994, 0.03, 0.3])  # 1/cond(J) is 0.23 there, and rods 4 lie level
LEVEL_BETA = np.arcsin(0.03 / PAPER.l7)
SIDES = [AssemblyMode(planar, 1) for planar in (-1, 1)]


def oracle_factors(points: FloatArray, mode: WorkingMode, g: Geometry) -> FloatArray:
    """Return dimensionless factors (..., 8) by the oracle; NaN where not reachable."""
    sizes = np.array([1, g.l4, g.l4**2, 1, g.l3 * g.l4, g.l3 * g.l4, g.l3 * g.l4, g.l4])
    *factors, elevation = oracle.factors_at(points, mode, g)
    return np.concatenate([*factors, elevation[..., None]], axis=-1) / sizes


def rays(count: int, seed: int) -> FloatArray:
    draws = np.random.default_rng(seed).normal(size=(count, 3))
    return draws / np.linalg.norm(draws, axis=-1, keepdims=True)


def ball_is_clear(
    point: FloatArray, radius: float, mode: WorkingMode, g: Geometry, count: int
) -> bool:
    """Return whether no sign changes within 0.999 of the radius, by the oracle.

    Points are as dense on the inner spheres as on the outer ones: ``count`` on the largest.
    """
    steps = np.append(np.linspace(0.05, 0.95, 19), [0.99, 0.999])
    spheres = [step * rays(math.ceil(step**2 * count), seed) for seed, step in enumerate(steps)]
    ball = point + radius * np.concatenate(spheres)
    clear = np.sign(oracle_factors(ball, mode, g)) == np.sign(oracle_factors(point, mode, g))
    return bool(clear.all())


def assert_feet_are_singular(
    points: FloatArray, found: singularity.NearestSingularity, mode: WorkingMode, g: Geometry
) -> None:
    reach = np.linalg.norm(found.point - points, axis=-1)
    np.testing.assert_allclose(reach, found.distance, rtol=0, atol=1e-12)
    # A foot is on the boundary up to rounding; seen from just inside, its factor has to be zero.
    # Legs' factors and cos(beta) rise as the square root of the distance, and next to y = l7 ever
    # more steeply; so the squares of two values on the way have to lead to zero.
    near, far = (
        oracle_factors(found.point + depth * (points - found.point), mode, g) ** 2
        for depth in (1e-11, 2e-11)
    )
    squares = np.abs(2 * near - far)[np.arange(len(points)), found.factor]
    assert squares.max() < 1e-6**2


@examples(40, oracle.geometries(), oracle.seeds(), st.sampled_from(WORKING_MODES))
def test_factors_at_points_are_the_oracle_s(g, seed, mode):
    points = oracle.reachable_points(np.random.default_rng(seed), 100, g)
    found = singularity.factors_at(points, mode, g)
    values = singularity.dimensionless(found, g)
    np.testing.assert_allclose(values, oracle_factors(points, mode, g), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(np.isfinite(values).all(-1), workspace.reachable(points, mode, g))
    bigger = singularity.factors_at(3 * points, mode, oracle.scaled(g, 3))
    np.testing.assert_allclose(
        singularity.dimensionless(bigger, oracle.scaled(g, 3)), values, atol=1e-6
    )
    mirrored = singularity.factors_at(points * [1, -1, 1], mode, g)
    np.testing.assert_allclose(mirrored.parallel, found.parallel * [-1, 1, 1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(mirrored.serial, found.serial, rtol=0, atol=1e-12)


@examples(30, oracle.geometries(), oracle.seeds(), st.sampled_from(WORKING_MODES))
def test_generic_points_are_regular_and_their_mode_is_their_signs(g, seed, mode):
    points = oracle.reachable_points(np.random.default_rng(seed), 100, g)
    points = points[workspace.reachable(points, mode, g)]
    found = singularity.classify_at(points, mode, g, tolerance=1e-9)
    assert (found.kind == SingularityType.NONE).all()
    assert not found.vanishing.any()
    assert (np.sign(found.factors[:, 3:7]) == mode.signs).all()


@pytest.mark.parametrize("mode", WORKING_MODES)
def test_both_ways_of_naming_a_configuration_agree(mode):
    points = oracle.reachable_points(np.random.default_rng(3), 400, PAPER)
    slots = workspace.assembly_of(points, mode)
    for assembly in ASSEMBLY_MODES:
        here = points[slots == assembly.index]
        theta = inverse(here, mode)
        for tolerance in (1e-6, 0.05, 0.3):
            at = singularity.classify_at(here, mode, tolerance=tolerance)
            by = singularity.classify(theta, assembly, tolerance=tolerance)
            assert at.tolerance == tolerance
            close = np.abs(np.abs(at.factors) - tolerance).min(axis=-1) < 1e-6
            np.testing.assert_array_equal(at.kind[~close], by.kind[~close])
            np.testing.assert_array_equal(at.vanishing[~close], by.vanishing[~close])
            np.testing.assert_array_equal(at.vanishing, np.abs(at.factors) <= tolerance)


def vanishing(found: singularity.Classification) -> list[str]:
    return [name for name, zero in zip(FACTORS, found.vanishing, strict=True) if zero]


def edge_of_leg3(x: float, y: float, g: Geometry = PAPER) -> FloatArray:
    """Return the lowest point above (x, y) that leg 3 reaches, folded."""
    level = np.sqrt(g.l4**2 - y**2) - g.l3
    return np.array([x, y, g.l6 + np.sqrt(level**2 - (x + g.l2 - g.l1) ** 2)])


def test_the_kinds():
    plane, edge = HOME * [1, 0, 1], np.array([HOME[0], PAPER.l7, HOME[2]])
    folded = edge_of_leg3(0.2, 0.03)
    cases = [
        (HOME, SingularityType.NONE, []),
        (plane, SingularityType.PARALLEL, ["sin_beta"]),
        (edge, SingularityType.SERIAL, ["cos_beta"]),
        (edge * [1, -1, 1], SingularityType.SERIAL, ["cos_beta"]),
        (folded, SingularityType.SERIAL, ["leg3"]),
        (edge_of_leg3(0.2, 0.0), SingularityType.BOTH, ["sin_beta", "leg3"]),
        (LEVEL, SingularityType.CONSTRAINT, ["elevation"]),
        (
            LEVEL * [1, 0, 1] + [PAPER.l7 * (1 - np.cos(LEVEL_BETA)), 0, 0],
            SingularityType.PARALLEL | SingularityType.CONSTRAINT,
            ["sin_beta", "elevation"],
        ),
    ]
    for point, kind, names in cases:
        found = singularity.classify_at(point)
        assert found.kind == kind, point
        assert vanishing(found) == names
        assert found.kind.shape == ()
    together = singularity.classify_at(np.array([point for point, _, _ in cases]))
    assert together.kind.tolist() == [int(kind) for _, kind, _ in cases]
    assert SingularityType.BOTH == SingularityType.SERIAL | SingularityType.PARALLEL


def test_constraint_singularities_are_those_of_the_arm_that_levels_the_rods():
    """z_C1 = z_B1 on half of the modes that reach the point, and no other factor is small there."""
    cos1 = 0.6
    point = oracle.level_rod_4(np.arccos(cos1), beta=0.6)
    kinds = []
    for mode in WORKING_MODES:
        if mode.cos_beta == 1 and workspace.reachable(point, mode):
            found = singularity.classify_at(point, mode)
            slot = int(workspace.assembly_of(point, mode))
            theta = inverse(point, mode)
            level = abs(np.cos(theta[0]) - cos1) < 1e-9
            assert found.kind == singularity.classify(theta, ASSEMBLY_MODES[slot]).kind
            assert vanishing(found) == (["elevation"] if level else [])
            distance = nearest_singularity(point, mode, ASSEMBLY_MODES[slot]).distance
            assert (distance < 1e-12) == level
            kinds.append(level)
    assert set(kinds) == {True, False}


@pytest.mark.parametrize("assembly", SIDES)
@pytest.mark.parametrize(
    ("mode", "count"),
    [(mode, 1000) for mode in (ELBOWS_OUT, WORKING_MODES[0], WORKING_MODES[14])]
    + [pytest.param(mode, 20_000, marks=pytest.mark.slow) for mode in WORKING_MODES],
)
def test_distance_is_that_of_brute_force(mode, assembly, count):
    compare(mode, assembly, PAPER, points=40, count=count)


def compare(
    mode: WorkingMode, assembly: AssemblyMode, g: Geometry, points: int, count: int, seed: int = 4
) -> None:
    some = oracle.reachable_points(np.random.default_rng(seed), 6000, g)
    near = np.abs(some[:, 1] - np.where(some[:, 1] > 0, 0.5, -0.5) * g.l7) < 0.3 * g.l7
    some = some[near]  # elsewhere the planes are the answer, and they are exact
    found = nearest_singularity(some[:200], mode, assembly, g)
    expected = workspace.assembly_of(some[:200], mode, g) == assembly.index
    np.testing.assert_array_equal(found.valid, expected)
    curved = ~np.isin(found.factor, (0, 3, -1))
    order = np.argsort(~curved, kind="stable")[:points]  # the curved surfaces first
    order = order[found.valid[order]]
    if not len(order):
        return
    part = nearest_singularity(some[order], mode, assembly, g)
    assert_feet_are_singular(some[order], part, mode, g)
    for index in order:
        assert ball_is_clear(some[index], float(found.distance[index]), mode, g, count)


@examples(4, oracle.geometries(), oracle.seeds(), st.sampled_from(WORKING_MODES))
def test_distance_for_any_geometry(g, seed, mode):
    for assembly in SIDES:
        compare(mode, assembly, g, points=5, count=200, seed=seed)


@examples(4, oracle.geometries(), oracle.seeds(), st.floats(0.1, 10))
def test_distance_scales_and_is_symmetric_in_y(g, seed, factor):
    points = oracle.reachable_points(np.random.default_rng(seed), 12, g)
    for assembly in SIDES:
        found = nearest_singularity(points, ELBOWS_OUT, assembly, g)
        other = AssemblyMode(assembly.planar, -assembly.sin_beta)
        mirrored = nearest_singularity(points * [1, -1, 1], ELBOWS_OUT, other, g)
        np.testing.assert_array_equal(found.distance, mirrored.distance)
        np.testing.assert_array_equal(found.point, mirrored.point * [1, -1, 1])
        bigger = nearest_singularity(
            factor * points, ELBOWS_OUT, assembly, oracle.scaled(g, factor)
        )
        np.testing.assert_array_equal(found.valid, bigger.valid)
        np.testing.assert_allclose(factor * found.distance, bigger.distance, rtol=1e-4)


def test_distance_to_the_planes_is_exact_in_the_middle_of_the_workspace():
    y = np.linspace(0, PAPER.l7, 11)
    found = nearest_singularity(oracle.vector(-0.05, y, 0.78))
    np.testing.assert_array_equal(found.distance, np.minimum(y, PAPER.l7 - y))
    assert set(found.factor.tolist()) == {0, 3}
    np.testing.assert_array_equal(found.point[:5], oracle.vector(-0.05, 0 * y[:5], 0.78))


def test_every_surface_is_met_somewhere():
    points = oracle.reachable_points(np.random.default_rng(5), 6000, PAPER)
    found = nearest_singularity(points[:2500], ELBOWS_OUT, SIDES[0])
    assert set(found.factor[found.valid].tolist()) == set(range(8))
    assert set(found.factor[~found.valid].tolist()) == {-1}
    assert np.isnan(found.distance[~found.valid]).all()
    assert np.isnan(found.point[~found.valid]).all()
    # so far from any singularity, the conditioning is not zero
    clear = points[:2500][found.valid & (found.distance > 0.02)]
    assert workspace.conditioning_at(clear, ELBOWS_OUT, SIDES[0]).min() > 1e-4


@pytest.mark.parametrize("shape", [(), (4,), (2, 3), (0,)])
def test_leading_shapes(shape):
    points = np.broadcast_to(HOME, (*shape, 3))
    found = nearest_singularity(points)
    assert found.distance.shape == found.factor.shape == found.valid.shape == shape
    assert found.point.shape == (*shape, 3)
    assert found.valid.all()
    kinds = singularity.classify_at(points)
    assert kinds.kind.shape == shape
    assert kinds.vanishing.shape == kinds.factors.shape == (*shape, 8)


def test_points_that_are_none_are_masked_in_batches():
    points = np.array([HOME, [np.nan, 0, 0], [np.inf, 0, 1], [1e200, 0.01, 1e200], [0, 0.06, 0.78]])
    found = nearest_singularity(points)
    assert found.valid.tolist() == [True, False, False, False, False]
    assert not nearest_singularity(HOME * [1, -1, 1]).valid
    for values in singularity.factors_at(points):
        assert np.isfinite(values[0]).all()
        assert np.isnan(values[1:]).all()


def test_bad_input_is_refused():
    theta = inverse(HOME)
    for function in (singularity.classify_at, singularity.classify, nearest_singularity):
        for wrong in ([0.0, 0.0], 1.0, "abc", ["1", "2", "3"], [[1.0], [2.0, 3.0]], [10**400] * 3):
            with pytest.raises(InputError):
                function(wrong)
    with pytest.raises(InputError):
        singularity.classify([theta, [np.nan, 0, 0]])
    for function, good, unreachable in (
        (singularity.classify_at, HOME, [0, 0.03, 5]),
        (singularity.classify, theta, [0.0, np.pi, -2.0]),
    ):
        with pytest.raises(UnreachableError):
            function([good, unreachable])
        for tolerance in (0.0, -1e-6, 1.0, float("nan"), "0.1"):
            with pytest.raises(ConfigurationError) as caught:
                function(good, tolerance=tolerance)
            assert caught.value.name == "tolerance"


def test_a_surface_is_found_where_its_working_mode_ends_beside_it():
    g = Geometry(l1=0.2655, l2=0.7646, l3=1.1043, l4=1.4283, l5=0.0666, l6=0.17, l7=0.0423)
    point, mode = np.array([0.12752, 0.02962, 0.15762]), WorkingMode(1, 1, 1, -1)
    found = nearest_singularity(point, mode, AssemblyMode(1, 1), g)
    assert FACTORS[found.factor] == "planar"
    inside = found.distance * np.random.default_rng(0).normal(size=(20_000, 3)) / 2
    inside *= np.minimum(1.0, 0.999 * found.distance / np.linalg.norm(inside, axis=1))[:, None]
    assert (singularity.factors_at(point + inside, mode, g).planar > 0).all()


def test_without_a_surface_of_level3_there_are_the_others():
    g = Geometry(l1=0.3, l2=0.07, l3=0.9, l4=0.7, l5=0.1, l6=0.01, l7=0.75)  # rod 11 < link 7
    points = oracle.reachable_points(np.random.default_rng(0), 2000, g)
    found = nearest_singularity(points, ELBOWS_OUT, SIDES[0], g)
    assert found.valid.any()
    assert (found.factor[found.valid] != FACTORS.index("level3")).all()


def test_curves_serve_all_callers_and_cannot_be_changed():
    x, *_ = sheets.curves("leg1", ELBOWS_OUT, PAPER)
    with pytest.raises(ValueError, match="read-only"):
        x += 1.0
    with pytest.raises(InputError, match="level3, planar, leg1"):
        sheets.curves("leg3", ELBOWS_OUT, PAPER)
