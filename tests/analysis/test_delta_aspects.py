"""Topology, workspace and aspects of the Delta, against its kinematics and an independent model."""

import numpy as np
import pytest
from delta import delta as tripod
from screws import projector, twists

from tpm_gym.analysis.delta import aspects, chains, reachable_set
from tpm_gym.analysis.poc import analyse
from tpm_gym.errors import ConfigurationError, InputError, UnreachableError
from tpm_gym.mechanism import DELTA
from tpm_gym.mechanism.delta.geometry import IRB_360, WORKING_MODES
from tpm_gym.mechanism.delta.kinematics import conditioning_at, forward_all, inverse_all

SHAPE = (40, 40, 40)


@pytest.mark.parametrize(("balls", "coupling"), [(False, 1.0), (True, 2.0)])
def test_chains_are_those_of_an_independent_model(balls, coupling):
    g, rng = IRB_360, np.random.default_rng(0)
    other = tripod(g.l1, g.l2, g.l3, g.l4)
    for point in rng.uniform(DELTA.region.low, DELTA.region.high, (4, 3)):
        theta = DELTA.inverse(point)
        found, at = chains(theta, geometry=g, balls=balls)
        np.testing.assert_allclose(at, point, atol=1e-12)
        topology = analyse(found, at)
        assert (str(topology.platform), topology.dof()) == ("t^3 r^0", 3)
        assert topology.coupling == (coupling,)
        for ours, theirs in zip(found, other.chains(point, theta, balls), strict=True):
            spans = [projector(twists(chain, at)) for chain in (ours, theirs)]
            np.testing.assert_allclose(*spans, atol=1e-6)
            ends = [np.array(chain.units[-1].point) for chain in (ours, theirs)]
            np.testing.assert_allclose(*ends, atol=1e-9)


def test_angles_without_an_assembly_have_no_chains():
    with pytest.raises(UnreachableError, match="spheres"):
        chains((3.0, 0.0, 0.0))
    with pytest.raises(InputError):
        chains((0.0, np.nan, 0.0))


@pytest.mark.parametrize("bends", [WORKING_MODES[7], WORKING_MODES[5]])
def test_aspects_divide_the_reachable_set_and_hold_one_assembly_mode(bends):
    whole, found = reachable_set(bends, shape=SHAPE), aspects(bends, shape=SHAPE, min_cells=1)
    assert np.sum([aspect.cells.mask for aspect in found], axis=0).max() == 1
    assert sum(aspect.cells.volume for aspect in found) == pytest.approx(whole.volume)
    for aspect in found[:4]:
        points = aspect.cells.centres()
        theta = inverse_all(points)[:, WORKING_MODES.index(bends)]
        side = (-1, 1).index(aspect.assembly)
        regular = conditioning_at(points, bends) > 1e-3
        np.testing.assert_allclose(
            forward_all(theta)[regular, side], points[regular], rtol=0, atol=1e-6
        )


def test_the_grid_holds_every_point_in_reach():
    cells = reachable_set(shape=SHAPE)
    low, high = np.array(cells.low), np.array(cells.low) + SHAPE * np.array(cells.spacing)
    points = np.random.default_rng(0).uniform(1.5 * low, 1.5 * high, (100_000, 3))
    reached = points[np.isfinite(inverse_all(points)).all(axis=(1, 2))]
    assert ((reached > low) & (reached < high)).all()
    volume = 1.5**3 * np.prod(high - low) * len(reached) / len(points)
    assert cells.volume == pytest.approx(volume, rel=0.03)


def test_the_mirror_at_the_base_of_a_working_mode_is_the_opposite_mode():
    def largest(bends, side):
        return next(one for one in aspects(bends, shape=SHAPE) if one.assembly == side)

    for bends in WORKING_MODES[7], WORKING_MODES[4]:
        one, two, three = bends
        ours, mirrored = largest(bends, 1), largest((-one, -two, -three), -1)
        np.testing.assert_array_equal(ours.cells.mask, mirrored.cells.mask[:, :, ::-1])


def test_the_machine_works_in_the_largest_aspect_within_the_stops():
    first, *others = aspects(shape=SHAPE, within_stops=True)
    assert first.assembly == DELTA.assembly_mode
    assert first.cells.volume > 20 * sum(other.cells.volume for other in others)
    cells = first.cells
    corners = np.array([DELTA.region.low, DELTA.region.high])
    low, high = np.floor((corners - cells.low) / cells.spacing).astype(int)
    assert cells.mask[tuple(slice(a, b + 1) for a, b in zip(low, high, strict=True))].all()


def test_shapes_that_are_not_possible_are_refused():
    with pytest.raises(ConfigurationError, match="shape"):
        aspects(shape=(1, 4, 4))
