"""The plain-float kinematics of one configuration are the batched ones, on every branch."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tpm_gym.errors import SingularityError, TPMError, UnreachableError
from tpm_gym.kinematics import equations as single
from tpm_gym.kinematics import forward, forward_all, inverse, inverse_all, jacobian
from tpm_gym.kinematics.geometry import PAPER, WIDE, Geometry
from tpm_gym.kinematics.modes import (
    ASSEMBLY_MODES,
    DEFAULT_ASSEMBLY,
    ELBOWS_OUT,
    WORKING_MODES,
    AssemblyMode,
    WorkingMode,
)
from tpm_gym.kinematics.namespaces import PLAIN

FloatArray = NDArray[np.float64]
GEOMETRIES = [PAPER, WIDE, Geometry(l1=0.31, l2=0.06, l3=0.36, l4=0.79, l5=0.11, l6=0.02, l7=0.07)]


def outcome(call: Callable[[], Any]) -> Any:
    """A result, or the error with its values."""
    try:
        return call()
    except TPMError as error:
        return type(error), str(error), repr(vars(error))


@pytest.mark.parametrize("geometry", GEOMETRIES)
@pytest.mark.parametrize("branch", ASSEMBLY_MODES)
def test_assemblies_are_the_batched_ones_where_those_exist_and_else_refused(
    branch: AssemblyMode, geometry: Geometry
) -> None:
    thetas = np.random.default_rng(branch.index).uniform(-math.pi, math.pi, (800, 3))
    solutions = forward_all(thetas, geometry)
    for index, theta in enumerate(thetas.tolist()):
        if not solutions.valid[index, branch.index]:
            with pytest.raises(UnreachableError) as caught:
                single.assemble(theta, branch, geometry)
            assert caught.value.point == tuple(theta)
            continue
        found = single.assemble(theta, branch, geometry)
        np.testing.assert_allclose(found[:3], solutions.position[index, branch.index], atol=1e-12)
        np.testing.assert_allclose(found[3:5], solutions.link3[index, branch.index], atol=1e-12)
        beta = solutions.beta[index, branch.index]
        np.testing.assert_allclose(found[5:], (np.cos(beta), np.sin(beta)), atol=1e-10)
    assert 20 < solutions.valid[:, branch.index].sum() < 780


@pytest.mark.parametrize("geometry", GEOMETRIES)
@pytest.mark.parametrize("branch", WORKING_MODES)
def test_postures_are_the_batched_ones_where_those_exist_and_else_refused(
    branch: WorkingMode, geometry: Geometry
) -> None:
    rng = np.random.default_rng(branch.index)
    points = rng.uniform((-0.6, -1.1 * geometry.l7, -1.2), (0.6, 1.1 * geometry.l7, 1.2), (200, 3))
    solutions = inverse_all(points, geometry)
    for index, point in enumerate(points.tolist()):
        if not solutions.valid[index, branch.index]:
            with pytest.raises(UnreachableError) as caught:
                single.posture(point, branch, geometry)
            assert caught.value.point == tuple(point)
            continue
        found = single.posture(point, branch, geometry)
        np.testing.assert_allclose(found, solutions.theta[index, branch.index], atol=1e-12)
    assert 20 < solutions.valid[:, branch.index].sum() < 180


@pytest.mark.parametrize("geometry", GEOMETRIES)
@pytest.mark.parametrize("branch", ASSEMBLY_MODES)
def test_jacobians_and_conditioning_are_the_batched_ones(
    branch: AssemblyMode, geometry: Geometry
) -> None:
    thetas = np.random.default_rng(branch.index).uniform(-math.pi, math.pi, (600, 3))
    thetas = thetas[forward_all(thetas, geometry).valid[:, branch.index]]
    matrices = jacobian.velocity(thetas, branch, geometry)
    conditioning = jacobian.conditioning(thetas, branch, geometry)
    for theta, matrix, expected in zip(thetas.tolist(), matrices, conditioning, strict=True):
        assembly, rows, found = single.evaluate(theta, branch, geometry)
        assert assembly == single.assemble(theta, branch, geometry)
        np.testing.assert_allclose(rows, matrix, rtol=1e-9, atol=1e-9 * np.abs(matrix).max())
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_single_points_and_batches_of_one_agree_in_the_public_functions() -> None:
    rng = np.random.default_rng(0)
    for point in rng.uniform((-0.3, -0.06, 0.5), (0.2, 0.06, 1.0), (300, 3)):
        one, many = (outcome(lambda p=p: inverse(p)) for p in (point, point[None]))
        if isinstance(one, tuple):
            assert one == many
            continue
        np.testing.assert_allclose(one, many[0], atol=1e-12)
        for function, atol in ((forward, 1e-12), (jacobian.velocity, 1e-9)):
            single_one = outcome(lambda f=function, t=one: f(t))
            batched = outcome(lambda f=function, t=one: f(t[None]))
            if isinstance(single_one, tuple):
                assert single_one[0] == batched[0]
            else:
                np.testing.assert_allclose(single_one, batched[0], atol=atol)


# -- singularities ---------------------------------------------------------------------------------


@pytest.mark.parametrize("x", [-0.2, 0.0, 0.1])
def test_on_the_plane_y_0_the_factor_is_named_and_what_exists_is_still_given(x: float) -> None:
    theta = single.posture((x, 0.0, 0.80), ELBOWS_OUT, PAPER)
    assembly = single.assemble(theta, DEFAULT_ASSEMBLY, PAPER)
    # cos(beta) is known to rounding, y to its square root.
    np.testing.assert_allclose(assembly[:3], (x, 0.0, 0.80), atol=1e-6)
    with pytest.raises(SingularityError) as caught:
        single.evaluate(theta, DEFAULT_ASSEMBLY, PAPER)
    assert caught.value.factor == "sin(beta)"
    assert abs(caught.value.value) < single.SINGULAR
    with pytest.raises(SingularityError):
        jacobian.velocity(np.array([theta]))


def exists(theta: FloatArray) -> bool:
    try:
        single.assemble(theta.tolist(), DEFAULT_ASSEMBLY, PAPER)
    except UnreachableError:
        return False
    return True


def test_where_an_assembly_ends_it_meets_another_and_the_factor_is_named() -> None:
    rng = np.random.default_rng(3)
    factors = set()
    for _ in range(300):
        inside, outside = rng.uniform(-math.pi, math.pi, (2, 3))
        if not exists(inside) or exists(outside):
            continue
        for _ in range(60):
            middle = (inside + outside) / 2
            inside, outside = (middle, outside) if exists(middle) else (inside, middle)
        with pytest.raises(SingularityError) as caught:
            single.evaluate(inside.tolist(), DEFAULT_ASSEMBLY, PAPER)
        factors.add(caught.value.factor)
        with pytest.raises((SingularityError, UnreachableError)):  # rounding decides which
            jacobian.velocity(inside[None])
    assert "sin(beta)" in factors


@pytest.mark.parametrize("side", [-1, 1])
def test_at_the_edge_y_l7_postures_exist_and_the_conditioning_is_zero(side: int) -> None:
    edge = side * PAPER.l7
    mode = AssemblyMode(DEFAULT_ASSEMBLY.planar, side)
    theta = single.posture((0.0, edge, 0.80), ELBOWS_OUT, PAPER)
    _, rows, conditioning = single.evaluate(theta, mode, PAPER)
    assert conditioning < 1e-7
    assert abs(np.linalg.det(rows)) < 1e-6
    with pytest.raises(UnreachableError):
        single.posture((0.0, edge * (1 + 1e-9), 0.80), ELBOWS_OUT, PAPER)


# -- conditioning ----------------------------------------------------------------------------------


def with_singular_values(rng: np.random.Generator, values: list[float]) -> FloatArray:
    left, _, right = np.linalg.svd(rng.normal(size=(3, 3)))
    return np.asarray(left @ np.diag(values) @ right)


def error(matrix: FloatArray) -> float:
    """Of the conditioning, against numpy's singular values."""
    values = np.linalg.svd(matrix, compute_uv=False)
    expected = values[2] / values[0] if values[0] else 0.0
    found = single.conditioning(matrix.tolist(), PLAIN)
    assert 0 <= found <= 1 + 1e-12
    return float(abs(found - expected))


def test_the_conditioning_is_that_of_the_singular_values() -> None:
    rng = np.random.default_rng(1)
    assert max(map(error, rng.normal(size=(500, 3, 3)))) < 1e-12
    for exact in ([1, 1, 1], [1, 1, 0], [1, 0, 0], [1, 1, 1e-9], [1, 1e-9, 1e-9], [0, 0, 0]):
        assert error(np.diag(exact)) < 1e-15
    for _ in range(500):
        size, middle, small = 10 ** rng.uniform((-3, -3, -6), (3, -0.05, 0))
        matrix = with_singular_values(rng, [size, size * middle, size * middle * small])
        assert error(matrix) < 1e-12


def test_where_the_two_largest_singular_values_coincide_some_digits_are_lost() -> None:
    rng = np.random.default_rng(4)
    for _ in range(300):
        near, small = 1 - 10 ** rng.uniform(-16, -3), 10 ** rng.uniform(-6, 0)
        assert error(with_singular_values(rng, [1.0, near, near * small])) < 1e-8


def test_the_conditioning_keeps_its_digits_where_it_is_small() -> None:
    # The root of the smallest eigenvalue of J J^T would have none left below 1e-8.
    rng = np.random.default_rng(2)
    for smallest in (1e-4, 1e-8, 1e-11):
        matrix = with_singular_values(rng, [1.0, 0.3, smallest])
        assert single.conditioning(matrix.tolist(), PLAIN) == pytest.approx(smallest, rel=1e-3)
