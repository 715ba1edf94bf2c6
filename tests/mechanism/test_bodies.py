"""Masses and inertias equal a numerical integration over the solids that are drawn."""

from itertools import pairwise

import numpy as np
import pytest
from examples import examples
from hypothesis import strategies as st
from walk import turned

from tpm_gym.arrays import FloatArray
from tpm_gym.mechanism.bodies import LEVEL, Link, Solid

AXES = ("x", "y", "z")
lengths = st.floats(0.005, 0.5)
shares = st.one_of(st.just(0.0), st.floats(0.1, 0.95))
centres = st.tuples(*[st.floats(-0.5, 0.5)] * 3)
turns = st.one_of(st.just(LEVEL), st.tuples(*[st.floats(-3.2, 3.2)] * 3))
NODES, WEIGHTS = np.polynomial.legendre.leggauss(3)


def panels(*edges: float) -> tuple[FloatArray, FloatArray]:
    """Gauss nodes and weights on each interval between ``edges``; exact for cubics."""
    nodes, weights = [], []
    for low, high in pairwise(edges):
        nodes.append((low + high) / 2 + (high - low) / 2 * NODES)
        weights.append((high - low) / 2 * WEIGHTS)
    return np.concatenate(nodes), np.concatenate(weights)


def cloud(solid: Solid) -> tuple[FloatArray, FloatArray]:
    """Mass points (n, 3), (n,) of a solid in the link's frame, none of them in its hollow."""
    if solid.kind == "box":
        half, bore = np.array(solid.size) / 2, np.array(solid.bore) / 2
        rules = [panels(-h, -b, b, h) for h, b in zip(half.tolist(), bore.tolist(), strict=True)]
        grid = np.meshgrid(*[nodes for nodes, _ in rules], indexing="ij")
        weight = np.meshgrid(*[weights for _, weights in rules], indexing="ij")
        at = np.stack(grid, axis=-1).reshape(-1, 3)
        mass = solid.density * np.prod(weight, axis=0).ravel()
        filled = ~(np.abs(at) < bore).all(axis=-1)
        return at[filled] @ turned(solid.rpy).T + solid.centre, mass[filled]
    radius, length, _ = solid.size
    r, dr = panels(solid.bore[0], radius)
    h, dh = panels(-length / 2, length / 2)
    turn = np.arange(12) * np.pi / 6
    r_, h_, turn_ = (a.ravel() for a in np.meshgrid(r, h, turn, indexing="ij"))
    mass = solid.density * (r * dr)[:, None, None] * dh[:, None] * np.full(12, np.pi / 6)
    along = AXES.index(solid.axis)
    at = np.empty((r_.size, 3))
    at[:, along] = h_
    at[:, (along + 1) % 3], at[:, (along + 2) % 3] = r_ * np.cos(turn_), r_ * np.sin(turn_)
    return at @ turned(solid.rpy).T + solid.centre, mass.ravel()


def moments(at: FloatArray, mass: FloatArray, about: FloatArray) -> FloatArray:
    """Inertia tensor of mass points about a point."""
    arm = at - about
    squares = (arm**2).sum(axis=-1)
    tensor = np.eye(3) * (mass * squares).sum()
    return np.asarray(tensor - np.einsum("n,ni,nj->ij", mass, arm, arm))


@st.composite
def boxes(draw: st.DrawFn) -> Solid:
    size = draw(st.tuples(lengths, lengths, lengths))
    bore = tuple(edge * draw(st.one_of(shares, st.just(1.0))) for edge in size)
    if bore == size:
        bore = (0.0, 0.0, 0.0)
    density = draw(st.floats(100, 8000))
    return Solid("box", size, draw(centres), density, bore=bore, rpy=draw(turns))


@st.composite
def cylinders(draw: st.DrawFn) -> Solid:
    radius, length = draw(lengths), draw(lengths)
    return Solid(
        "cylinder",
        (radius, length, 0.0),
        draw(centres),
        draw(st.floats(100, 8000)),
        bore=(radius * draw(shares), length, 0.0),
        axis=draw(st.sampled_from(AXES)),
        rpy=draw(turns),
    )


@examples(150, st.one_of(boxes(), cylinders()))
def test_mass_and_inertia_of_solids_equal_an_integration(solid):
    at, mass = cloud(solid)
    assert solid.mass == pytest.approx(mass.sum(), rel=1e-9)
    tensor = moments(at, mass, np.array(solid.centre))
    np.testing.assert_allclose(solid.inertia, tensor, rtol=1e-9, atol=1e-9 * tensor.max())
    assert (np.abs(at - solid.centre).max(axis=0) <= solid.half_extent + 1e-12).all()


@examples(60, st.lists(st.one_of(boxes(), cylinders()), min_size=1, max_size=4))
def test_mass_properties_of_links_equal_an_integration(solids):
    link = Link("link", tuple(solids))
    clouds = [cloud(solid) for solid in solids]
    at, mass = (np.concatenate(parts) for parts in zip(*clouds, strict=True))
    centre = mass @ at / mass.sum()
    tensor = moments(at, mass, centre)
    assert link.mass == pytest.approx(mass.sum(), rel=1e-9)
    np.testing.assert_allclose(link.centre_of_mass, centre, atol=1e-9)
    np.testing.assert_allclose(link.inertia, tensor, rtol=1e-9, atol=1e-9 * tensor.max())


def test_parts_that_are_only_drawn_weigh_nothing():
    drawn = Solid("box", (0.4, 0.2, 0.1), (1.0, 0.0, 0.0), 0.0)
    solid = Solid("cylinder", (0.1, 0.4, 0.0), (0.0, 0.0, 0.0), 1000.0)
    with_drawn, alone = Link("a", (solid, drawn)), Link("a", (solid,))
    assert with_drawn.mass == alone.mass
    np.testing.assert_array_equal(with_drawn.inertia, alone.inertia)
