"""Meshes of singular surfaces are singular, and those of cells enclose the cells."""

import numpy as np
import pytest

from tpm_gym import PAPER, WIDE
from tpm_gym.analysis.aspects import aspects
from tpm_gym.analysis.singularity import FACTORS, dimensionless
from tpm_gym.kinematics import ELBOWS_OUT, WorkingMode
from tpm_gym.kinematics.jacobian import factors_at
from tpm_gym.viewer.meshes import Mesh, cells_mesh, clipped, grid_mesh, surface

MODES = ELBOWS_OUT, WorkingMode(-1, 1, 1, -1)


def volume(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return float(np.einsum("ni,ni->", a, np.cross(b, c)) / 6)


@pytest.mark.parametrize("geometry", [PAPER, WIDE], ids=["paper", "wide"])
@pytest.mark.parametrize("mode", MODES, ids=["out", "mixed"])
@pytest.mark.parametrize("factor", FACTORS)
def test_a_factor_is_zero_on_its_whole_surface_in_the_working_mode(factor, mode, geometry):
    mesh = surface(factor, mode, geometry)
    assert len(mesh.faces) > 1000
    values = factors_at(mesh.vertices, mode, geometry)  # NaN where the mode does not reach
    found = dimensionless(values, geometry)[:, FACTORS.index(factor)]
    # Rounding on the boundary of a leg gives its factor the square root of rounding.
    assert np.abs(found).max() < 1e-6
    assert np.isfinite(found).all()


def test_the_mesh_of_an_aspect_encloses_its_volume_with_the_outside_in_front():
    for aspect in aspects(ELBOWS_OUT, WIDE)[:4]:
        mesh = cells_mesh(aspect.cells)
        assert volume(mesh) == pytest.approx(aspect.cells.volume, rel=0.1)
        edges = np.sort(np.concatenate([mesh.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]))
        _, counts = np.unique(edges, axis=0, return_counts=True)
        assert (counts % 2 == 0).all()  # closed


def test_a_clipped_grid_ends_at_the_boundary():
    x, y = np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41), indexing="ij")
    grid = np.stack([x, y, 0 * x], axis=-1)[None]

    def inside(points):
        return np.hypot(points[..., 0], points[..., 1]) <= 0.8

    points = clipped(grid, inside)
    real = ~np.isnan(points[..., 0])
    moved = real & ~inside(grid)
    radius = np.hypot(points[..., 0], points[..., 1])[moved]
    assert moved.sum() > 50
    assert radius == pytest.approx(np.full(len(radius), 0.8), abs=0.05 / 2**7)
    assert np.array_equal(points[inside(grid)], grid[inside(grid)])
    # The mesh has no teeth at the boundary: it fills the disc.
    a, b, c = np.moveaxis((mesh := grid_mesh(points)).vertices[mesh.faces], 1, 0)
    areas = np.cross(b - a, c - a)[:, 2] / 2
    assert (areas >= 0).all()
    assert areas.sum() == pytest.approx(np.pi * 0.8**2, rel=0.005)
