"""Reachable sets, aspects and boxes agree with brute force on the factors of the oracle."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import oracle
import pytest
from examples import examples
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

import tpm_gym
from tpm_gym.analysis import aspects, singularity
from tpm_gym.analysis.aspects import Aspect, Cells
from tpm_gym.arrays import FloatArray
from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics import ELBOWS_OUT, WORKING_MODES, WorkingMode, workspace
from tpm_gym.kinematics.geometry import PAPER, WIDE, Geometry

COARSE, FINE = (32, 8, 48), (64, 16, 96)
modes = st.sampled_from(WORKING_MODES)


def signs(points: FloatArray, mode: WorkingMode, g: Geometry) -> FloatArray:
    """Return signs (..., 4) of parallel factors and elevation by the oracle, or NaN."""
    parallel, _, elevation = oracle.factors_at(points, mode, g)
    return np.sign(np.concatenate([parallel, elevation[..., None]], axis=-1))


def of(aspect: Aspect) -> list[int]:
    """Return the signs of an aspect, in the order of ``signs``."""
    return [aspect.assembly.sin_beta, aspect.level3, aspect.assembly.planar, aspect.elevation]


@examples(20, oracle.geometries(), oracle.seeds(), modes)
def test_the_grid_covers_the_reachable_set(g, seed, mode):
    cells = aspects.reachable_set(mode, g, (24, 6, 24))
    everywhere = replace(cells, mask=np.ones_like(cells.mask)).centres()
    reachable = workspace.reachable(everywhere, mode, g)
    np.testing.assert_array_equal(cells.mask.ravel(), reachable)
    np.testing.assert_array_equal(workspace.reachable(cells.centres(), mode, g), True)
    points = oracle.reachable_points(np.random.default_rng(seed), 300, g)
    points = points[workspace.reachable(points, mode, g)]
    high = np.asarray(cells.low) + np.asarray(cells.spacing) * cells.mask.shape
    assert ((points >= cells.low) & (points <= high + 1e-12)).all()
    np.testing.assert_array_equal(cells.mask, cells.mask[:, ::-1])


def test_the_grid_is_no_wider_than_the_legs_reach():
    first, last = set(), set()
    for l2, l3, l5, l7 in product((0.07, 0.6), (0.1, 0.35), (0.01, 0.4), (0.05, 0.9)):
        g = replace(PAPER, l2=l2, l3=l3, l5=l5, l7=l7)
        ends: tuple[list[float], list[float]] = [], []
        for sign, side in zip((-1, 1), ends, strict=True):
            far = sign * (g.l3 + g.l4)  # legs 2 and 3 are stretched, and rod 4 is level
            beta = math.pi if sign < 0 else 0.0
            for x_c in (sign * g.l4, 2 * g.l5 - g.l1 + far):
                side.append(oracle.points(np.zeros(3), x_c, 0.0, beta, g)["P"][0])
            side.append(g.l1 + far - g.l2)
        low, high = max(ends[0]), min(ends[1])
        cells = aspects.reachable_set(geometry=g, shape=(16, 4, 16))
        first.add(ends[0].index(low))
        last.add(ends[1].index(high))
        assert cells.low[0] == pytest.approx(low)
        assert cells.low[0] + 16 * cells.spacing[0] == pytest.approx(high)
    assert first == last == {0, 1, 2}  # each leg is the nearest limit somewhere


@pytest.mark.parametrize("mode", [ELBOWS_OUT, WORKING_MODES[0]])
def test_volumes_are_those_of_monte_carlo_within_the_stated_error(mode):
    coarse, fine = (aspects.reachable_set(mode, shape=shape) for shape in (COARSE, FINE))
    rng = np.random.default_rng(1)
    low, high = [-1.6, -PAPER.l7, -1.3], [1.6, PAPER.l7, 1.3]
    draws = rng.uniform(low, high, (400_000, 3))
    inside = workspace.reachable(draws, mode)
    box = np.prod(np.subtract(high, low))
    volume, noise = box * inside.mean(), box * inside.std() / np.sqrt(len(draws))
    for cells in (coarse, fine):
        assert abs(cells.volume - volume) < cells.volume_error + 3 * noise
    # The bound is not lax, and of first order.
    assert coarse.volume_error < 0.12 * coarse.volume
    assert 1.7 < coarse.volume_error / fine.volume_error < 2.3


def test_volumes_of_aspects_converge():
    coarse, fine = (aspects.aspects(shape=shape) for shape in (COARSE, FINE))
    for one, other in zip(coarse[:6], fine[:6], strict=True):
        assert of(one) == of(other)
        assert abs(one.cells.volume - other.cells.volume) < one.cells.volume_error
        assert other.cells.volume_error < 0.75 * one.cells.volume_error
    assert coarse[0].cells.volume == pytest.approx(fine[0].cells.volume, rel=0.01)


VOLUMES = {  # dm^3 by the signs of level3, planar and elevation, in one half
    (1, -1, 1): [37.2],
    (-1, -1, -1): [30.1, 1.14],
    (1, -1, -1): [26.6],
    (-1, -1, 1): [8.77],
    (-1, 1, -1): [2.86],
    (1, 1, -1): [0.148],
    (-1, 1, 1): [0.0506],
}


@pytest.mark.slow
def test_elbows_out_has_sixteen_aspects():
    found = aspects.aspects(shape=(200, 12, 260))
    assert len(found) == 16
    for side in (-1, 1):
        half = [a for a in found if a.assembly.sin_beta == side]
        volumes = {signs: [] for signs in VOLUMES}
        for aspect in half:
            volumes[of(aspect)[1], of(aspect)[2], of(aspect)[3]].append(1e3 * aspect.cells.volume)
        for signs, expected in VOLUMES.items():
            assert len(volumes[signs]) == len(expected)
            assert volumes[signs] == pytest.approx(expected, rel=0.02)


def test_volume_error_counts_no_flat_faces():
    mask = np.zeros((6, 4, 6), dtype=bool)
    mask[1:5, 2:, 1:5] = True  # against y = 0 and y = l7; 12 of 16 columns are on the rim
    cells = Cells((0, 0, 0), (1, 1, 1), mask)
    assert cells.volume == 32
    assert cells.volume_error == 0.5 * 2 * 16  # 16 cells outside touch the rim, a layer
    assert len(cells.centres()) == 32
    whole = Cells((0, 0, 0), (1, 1, 1), np.ones((4, 4, 6), dtype=bool))
    assert whole.volume_error == 0.5 * 4 * 2 * (4 + 6)  # all cells beyond the grid are outside
    assert cells.centres()[0].tolist() == [1.5, 2.5, 1.5]


@examples(20, oracle.geometries(), modes)
def test_aspects_part_the_reachable_set_by_signs(g, mode):
    shape = (24, 6, 24)
    found = aspects.aspects(mode, g, shape, min_cells=1)
    reachable = aspects.reachable_set(mode, g, shape)
    np.testing.assert_array_equal(sum(a.cells.mask.astype(int) for a in found), reachable.mask)
    volumes = [a.cells.volume for a in found]
    assert volumes == sorted(volumes, reverse=True)
    for aspect in found:
        assert (signs(aspect.cells.centres(), mode, g) == of(aspect)).all()
        assert (aspect.branch, aspect.geometry) == (mode, g)
        assert ndimage.label(aspect.cells.mask)[1] == 1
        beside = ndimage.binary_dilation(aspect.cells.mask) & ~aspect.cells.mask & reachable.mask
        centres = replace(aspect.cells, mask=beside).centres()
        assert not (signs(centres, mode, g) == of(aspect)).all(axis=-1).any()
    # y -> -y turns every aspect into another
    masks = {(*of(a), a.cells.mask.tobytes()) for a in found}
    mirrored = {
        (-of(a)[0], *of(a)[1:], np.ascontiguousarray(a.cells.mask[:, ::-1]).tobytes())
        for a in found
    }
    assert masks == mirrored
    kept = aspects.aspects(mode, g, shape, min_cells=5)
    assert len(kept) == sum(a.cells.mask.sum() >= 5 for a in found)


@examples(15, oracle.geometries(), modes, st.sampled_from([0.5, 4.0]))
def test_sets_scale_with_the_lengths(g, mode, factor):
    both = (
        aspects.aspects(mode, lengths, (16, 4, 16)) for lengths in (g, oracle.scaled(g, factor))
    )
    for one, other in zip(*both, strict=True):
        np.testing.assert_array_equal(one.cells.mask, other.cells.mask)
        assert of(one) == of(other)
        assert other.cells.volume == pytest.approx(factor**3 * one.cells.volume)
        try:
            box = aspects.largest_box(one, 0.02)
        except ConfigurationError:
            continue
        scaled = aspects.largest_box(other, 0.02)
        np.testing.assert_allclose(scaled.region.low, np.multiply(factor, box.region.low))
        np.testing.assert_allclose(scaled.region.high, np.multiply(factor, box.region.high))
        assert scaled.conditioning == pytest.approx(box.conditioning)


shapes = st.tuples(*[st.integers(1, 6)] * 3)


def best_by_trying(mask: NDArray[np.bool_]) -> int:
    best = 0
    ranges = [[(a, b) for a in range(n) for b in range(a + 1, n)] for n in mask.shape]
    for (a, b), (c, d), (e, f) in product(*ranges):
        if mask[a : b + 1, c : d + 1, e : f + 1].all():
            best = max(best, (b - a) * (d - c) * (f - e))
    return best


@examples(200, shapes, oracle.seeds(), st.floats(0.4, 1.0))
def test_largest_block_is_that_of_trying_all(shape, seed, density):
    mask = np.random.default_rng(seed).random(shape) < density
    found, best = aspects.largest_block(mask), best_by_trying(mask)
    if found is None:
        assert best == 0
        return
    first, last = found
    assert np.prod(np.subtract(last, first)) == best
    assert mask[tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))].all()


@pytest.mark.parametrize("threshold", [0.0, 0.05, 0.1])
def test_boxes_are_in_the_aspect_and_conditioned_well(threshold):
    aspect = aspects.aspects(shape=FINE)[1]
    box = aspects.largest_box(aspect, threshold)
    points = oracle.grid(box.region.low, box.region.high, (14, 14, 14))
    assert (signs(points, aspect.branch, PAPER) == of(aspect)).all()
    values = workspace.conditioning_at(points, aspect.branch, aspect.assembly)
    assert values.min() > 0.97 * threshold  # between the nodes, too
    assert values.min() == pytest.approx(box.conditioning, rel=0.03)
    assert box.conditioning >= threshold
    assert box.volume == pytest.approx(np.prod(np.subtract(box.region.high, box.region.low)))
    centres = aspect.cells.centres()
    for corner in (box.region.low, box.region.high):
        assert np.abs(centres - corner).max(axis=-1).min() < 1e-12
    if threshold:
        assert box.volume < aspects.largest_box(aspect, threshold / 2).volume


@pytest.mark.parametrize("rank", [0, 3, 5])
def test_samples_are_uniform_over_the_aspect_itself(rank):
    aspect, count = aspects.aspects(shape=COARSE)[rank], 20_000
    points = aspects.sample(np.random.default_rng(2), aspect, count)
    assert points.shape == (count, 3)
    assert (signs(points, ELBOWS_OUT, PAPER) == of(aspect)).all()
    # Planes through faces of a much finer grid divide the samples like its cells.
    fine = aspects.aspects(shape=(96, 24, 144))[rank]
    assert of(fine) == of(aspect)
    centres = fine.cells.centres()
    edges = fine.cells.spacing
    middle = fine.cells.low + np.round((centres.mean(axis=0) - fine.cells.low) / edges) * edges
    for axis in range(3):
        share = (centres[:, axis] < middle[axis]).mean()
        assert abs((points[:, axis] < middle[axis]).mean() - share) < 0.02
    # Cells with a centre outside have samples too, and other cells are not full.
    corner = np.floor((points - aspect.cells.low) / aspect.cells.spacing).astype(int)
    own = aspect.cells.mask[tuple(corner.T)]
    assert 0.5 < own.mean() < 0.999


def test_samples_depend_on_the_rng_alone_and_are_not_singular():
    aspect = aspects.aspects(shape=COARSE)[0]
    first, second = (aspects.sample(np.random.default_rng(3), aspect, 50) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert len(np.unique(first, axis=0)) == 50
    found = singularity.nearest_singularity(first, aspect.branch, aspect.assembly)
    assert found.valid.all()
    assert (found.distance > 0).all()
    assert aspects.sample(np.random.default_rng(3), aspect, 0).shape == (0, 3)


@pytest.mark.parametrize(
    "shape",
    [(8, 8), (8, 7, 8), (1, 8, 8), (8, 8, 0), (8.5, 8, 8), (8, -2, 8), (8, 8, 8, 8)]
    + [8, "888", None, (float("inf"), 8, 8)],
)
def test_grids_that_are_none_are_refused(shape):
    for function in (aspects.reachable_set, aspects.aspects):
        with pytest.raises(ConfigurationError) as caught:
            function(ELBOWS_OUT, PAPER, shape)
        assert caught.value.name == "shape"
        assert caught.value.value == shape


def test_bad_arguments_are_refused():
    aspect = aspects.aspects(shape=COARSE)[0]
    for threshold in (-0.1, 1.1, float("nan"), "0.1", 0.9):  # no box is as good as the last
        with pytest.raises(ConfigurationError) as caught:
            aspects.largest_box(aspect, threshold)
        assert caught.value.name == "threshold"
    rng = np.random.default_rng(4)
    for count in (-1, 2.5, float("nan")):
        with pytest.raises(ConfigurationError, match="count"):
            aspects.sample(rng, aspect, count)
    empty = replace(aspect, cells=replace(aspect.cells, mask=np.zeros(COARSE, dtype=bool)))
    with pytest.raises(ConfigurationError, match="aspect"):
        aspects.sample(rng, empty, 1)
    for few in (0, float("nan")):
        with pytest.raises(ConfigurationError, match="min_cells"):
            aspects.aspects(shape=COARSE, min_cells=few)


def test_mechanisms_that_reach_nothing_have_no_aspects():
    g = Geometry(l1=0.3, l2=1.5, l3=0.2, l4=0.15, l5=0.02, l6=0.0, l7=0.05)
    cells = aspects.reachable_set(geometry=g, shape=COARSE)
    assert aspects.aspects(geometry=g, shape=COARSE) == ()
    assert cells.volume == cells.volume_error == 0
    assert min(cells.spacing) > 0


def largest(g: Geometry, shape: tuple[int, int, int]) -> aspects.Box:
    """Return the largest box with conditioning 0.1 and y > 0 over all aspects."""
    boxes = []
    for aspect in aspects.aspects(geometry=g, shape=shape):
        if aspect.assembly.sin_beta > 0:
            try:
                boxes.append(aspects.largest_box(aspect, 0.1))
            except ConfigurationError:
                continue
    return max(boxes, key=lambda box: box.volume)


def test_wide_is_the_paper_s_mechanism_with_a_deeper_workspace():
    assert tpm_gym.WIDE is WIDE
    assert replace(WIDE, l7=PAPER.l7) == PAPER
    narrow, wide = (largest(g, (32, 24, 48)) for g in (PAPER, WIDE))
    depth = np.subtract(wide.region.high, wide.region.low)[1]
    assert depth > 0.25
    assert wide.volume > 10 * narrow.volume


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(64, 32, 80), (96, 64, 120)])
def test_wide_meets_its_criterion(shape):
    lengths = np.arange(1, 10) / 10
    volumes = [largest(replace(PAPER, l7=l7), shape).volume for l7 in lengths]
    assert lengths[np.argmax(volumes)] == WIDE.l7
    assert 0.04 < max(volumes) < 0.05
