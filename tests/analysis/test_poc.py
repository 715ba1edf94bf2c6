"""POC sets are pairs of subspaces, and Eqs. (1) to (5) combine them as in the paper."""

from types import SimpleNamespace

import numpy as np
import pytest
from examples import examples
from hypothesis import strategies as st

from tpm_gym.analysis.poc import (
    Chain,
    POCSet,
    Subspace,
    Unit,
    coupling_degrees,
    decompositions,
    parallel,
    parallelogram_4r,
    parallelogram_4s,
    revolute,
    serial,
)
from tpm_gym.arrays import FloatArray
from tpm_gym.errors import InputError

X, Y, Z = np.eye(3)

# Few directions, so that subspaces often share some.
vectors = st.lists(st.tuples(*[st.integers(-2, 2)] * 3), max_size=4)
subspaces = vectors.map(Subspace.span)
poc_sets = st.builds(POCSet, subspaces, subspaces)
directions = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.3)


def same(a: Subspace, b: Subspace) -> bool:
    return bool(np.allclose(a.projector, b.projector, rtol=0, atol=1e-9))


def holds(whole: Subspace, part: Subspace) -> bool:
    return bool(np.allclose(part.basis @ whole.projector, part.basis, rtol=0, atol=1e-9))


# Subspaces and POC sets


@examples(200, subspaces, subspaces)
def test_union_and_intersection_are_those_of_subspaces(a, b):
    union, common = a | b, a & b
    assert union.dim + common.dim == a.dim + b.dim
    assert holds(union, a)
    assert holds(union, b)
    assert holds(a, common)
    assert holds(b, common)
    assert same(union, b | a)
    assert same(common, b & a)
    assert same(a | a, a)
    assert same(a & a, a)
    assert same(a.complement.complement, a)


@examples(100, vectors, st.floats(1e-3, 1e3) | st.just(1e200))
def test_span_is_the_rank_whatever_the_lengths(rows, scale):
    subspace = Subspace.span(rows)
    assert subspace.dim == (np.linalg.matrix_rank(np.array(rows)) if rows else 0)
    assert same(subspace, Subspace.span(scale * np.array(rows)))
    np.testing.assert_allclose(subspace.basis @ subspace.basis.T, np.eye(subspace.dim), atol=1e-12)


@pytest.mark.parametrize("bad", [[[1.0, 2.0]], [1.0, 2.0, 3.0], [[np.nan, 0, 0]], [[np.inf, 0, 0]]])
def test_span_rejects_what_is_no_list_of_vectors(bad):
    with pytest.raises(InputError):
        Subspace.span(bad)


@examples(100, poc_sets, poc_sets)
def test_poc_sets_combine_by_column(a, b):
    for found, rule in ((serial([a, b]), Subspace.__or__), (parallel([a, b]), Subspace.__and__)):
        assert same(found.translations, rule(a.translations, b.translations))
        assert same(found.rotations, rule(a.rotations, b.rotations))
        assert found.dim == found.translations.dim + found.rotations.dim
    assert str(a) == f"t^{a.translations.dim} r^{a.rotations.dim}"


@examples(100, poc_sets, poc_sets, poc_sets)
def test_independent_equations_are_those_of_what_the_chains_so_far_share_and_the_next(a, b, c):
    """dim(U + V) = dim U + dim V - dim(U intersected with V), in each column."""
    expected = 0
    for column in ("translations", "rotations"):
        u, v, w = (getattr(poc, column) for poc in (a, b, c))
        expected += (u & v).dim + w.dim - (u & v & w).dim
    chains = [
        SimpleNamespace(name="", freedoms=0, actuated=0, poc=lambda _, one=one: one)
        for one in (a, b, c)
    ]
    assert decompositions(chains, np.zeros(3))[0][1].equations == expected


def test_equations_1_and_2_need_a_set():
    for equation in (serial, parallel):
        with pytest.raises(InputError):
            equation([])


# What joints contribute


@examples(100, directions, directions, directions)
def test_revolutes_translate_perpendicularly_to_axis_and_arm(axis, point, base):
    joint = revolute("R", np.array(axis), np.array(point))
    arm = np.subtract(base, point)
    poc = joint.poc(base)
    assert joint.freedoms == 1
    assert same(poc.rotations, Subspace.span([axis]))
    np.testing.assert_allclose(poc.translations.basis @ np.stack([axis, arm]).T, 0, atol=1e-7)
    on_axis = joint.poc(np.array(point) + 3 * np.array(axis))
    assert on_axis.translations.dim == 0
    if np.linalg.norm(np.cross(axis, arm)) > 1e-3:
        assert poc.translations.dim == 1


@examples(100, directions, st.integers(0, 2**32 - 1))
def test_three_parallel_revolutes_give_t2_r1(axis, seed):
    points = np.random.default_rng(seed).normal(size=(3, 3))
    chain = Chain("3R", tuple(revolute("R", np.array(axis), p) for p in points))
    poc = chain.poc([0.1, 0.2, 0.3])
    assert str(poc) == "t^2 r^1"
    assert same(poc.translations, Subspace.span([axis]).complement)
    assert str(Chain("2R", chain.units[:2]).poc(points[1])) == "t^1 r^1"


def far_link_freedoms(short: FloatArray, rod: FloatArray) -> FloatArray:
    """Return the null space (v, omega), (k, 6), of two rods of fixed length at the far link."""
    rows = [np.concatenate([rod, np.cross(side * short / 2, rod)]) for side in (1, -1)]
    return np.asarray(np.linalg.svd(np.array(rows))[2][2:])


@examples(100, directions, directions)
def test_4s_parallelogram_has_the_freedoms_that_its_rods_leave(short, rod):
    a, b = np.array(short), np.array(rod)
    if np.linalg.norm(np.cross(a, b)) < 1e-2:
        return
    unit = parallelogram_4s("Pa", a, b, np.zeros(3))
    freedoms = far_link_freedoms(a, b)
    poc = unit.poc(np.zeros(3))
    assert len(freedoms) == unit.freedoms == poc.dim == 4
    exact = freedoms.T @ freedoms
    np.testing.assert_allclose(exact[:3, :3], poc.translations.projector, atol=1e-9)
    np.testing.assert_allclose(exact[3:, 3:], poc.rotations.projector, atol=1e-9)
    np.testing.assert_allclose(exact[:3, 3:], 0, atol=1e-9)


@examples(100, directions, directions)
def test_4r_parallelogram_translates_along_the_tangent(short, rod):
    a, b = np.array(short), np.array(rod)
    if np.linalg.norm(np.cross(a, b)) < 1e-2:
        return
    poc = parallelogram_4r("Pa", a, b, np.zeros(3)).poc(X)
    assert str(poc) == "t^1 r^0"
    tangent = np.cross(np.cross(a, b), b)  # turning the rod about the revolutes' axis moves its end
    assert same(poc.translations, Subspace.span([tangent]))


# Eqs. 3a, 4 and 5


@pytest.mark.parametrize(
    ("decompositions", "kappa"),
    [
        ([[0, 0]], (0, 0)),
        ([[2, -2]], (2,)),
        ([[2, -2], [1, -1]], (1,)),
        ([[1, -1, 0]], (1, 0)),
        ([[2, -1, -1], [3, -3, 0]], (2,)),
    ],
)
def test_coupling_degree_is_half_the_least_sum(decompositions, kappa):
    assert coupling_degrees(decompositions) == kappa


@pytest.mark.parametrize("decompositions", [[], [[]], [[1]], [[0, 2]]])
def test_coupling_degree_needs_balanced_constraint_degrees(decompositions):
    with pytest.raises(InputError):
        coupling_degrees(decompositions)


def test_units_count_their_freedoms():
    unit = Unit("U", np.zeros(3), np.empty((0, 3)), np.stack([X, Y]))
    assert (unit.freedoms, str(unit.poc(np.zeros(3)))) == (2, "t^0 r^2")
    assert str(unit.poc(Z)) == "t^2 r^2"
