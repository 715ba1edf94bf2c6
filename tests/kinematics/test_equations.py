"""The one text gives the same in arrays and tensors, and tensors differentiate it."""

import math
from typing import Any

import numpy as np
import oracle
import pytest
import torch
from torch.autograd import gradcheck

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import SingularityError, UnreachableError
from tpm_gym.kinematics import (
    ASSEMBLY_MODES,
    DEFAULT_ASSEMBLY,
    ELBOWS_OUT,
    WORKING_MODES,
    equations,
    forward,
    forward_all,
    inverse,
    inverse_all,
    jacobian,
    workspace,
)
from tpm_gym.kinematics.geometry import PAPER, WIDE, Geometry, Lengths
from tpm_gym.kinematics.namespaces import NUMPY
from tpm_gym.mechanism.delta import kinematics as delta
from tpm_gym.mechanism.delta.geometry import IRB_360, DeltaLengths

GEOMETRIES = [PAPER, WIDE, Geometry(l1=0.31, l2=0.06, l3=0.36, l4=0.79, l5=0.11, l6=0.02, l7=0.07)]
LOW, HIGH = (-0.24, 0.012, 0.66), (0.12, 0.046, 0.90)


def angles(seed: int, count: int) -> FloatArray:
    return np.random.default_rng(seed).uniform(-math.pi, math.pi, (count, 3))


def places(seed: int, count: int, g: Geometry) -> FloatArray:
    reach = np.array([0.6, 1.1 * g.l7, 1.2])
    return np.random.default_rng(seed).uniform(-reach, reach, (count, 3))


def assert_same(tensors: Any, arrays: Any, names: tuple[str, ...], atol: float) -> None:
    np.testing.assert_array_equal(tensors.valid, arrays.valid)
    for name in names:
        found, expected = getattr(tensors, name), getattr(arrays, name)
        assert found.dtype == torch.float64
        np.testing.assert_allclose(found, expected, rtol=0, atol=atol)  # NaN equals NaN


def parts(found: Any) -> tuple[Any, ...]:
    """Return the values of a named tuple or a dataclass."""
    return tuple(found) if isinstance(found, tuple) else tuple(vars(found).values())


# -- the same everywhere ---------------------------------------------------------------------------


@pytest.mark.parametrize("g", GEOMETRIES)
def test_what_rounding_pushes_over_an_edge_is_on_it(g):
    inside, beyond = (0.05, 0.5 * g.l7, 0.75), (0.05, 0.5 * g.l7, 3.0)
    for _ in range(60):  # until nothing lies between the two: leg 1 to 3, whichever ends first
        between = tuple((a + b) / 2 for a, b in zip(inside, beyond, strict=True))
        reached = inverse_all(between, g).valid[ELBOWS_OUT.index]
        inside, beyond = (between, beyond) if reached else (inside, between)
    for point in [inside] + [(0.05, sign * np.nextafter(g.l7, np.inf), 0.75) for sign in (-1, 1)]:
        inverse(point, ELBOWS_OUT, g)
    with pytest.raises(UnreachableError):
        inverse(beyond, ELBOWS_OUT, g)


# Where the cosine of the angle that the cubic's roots lie on is rounded to more than 1
@pytest.mark.parametrize(
    ("theta", "g"),
    [
        ((0.2248458852711428, -0.8083631374888043, 0.8632312500612471), PAPER),
        ((-2.2912464026315247, 0.544275213294847, 0.27117719284950903), WIDE),
    ],
)
def test_two_singular_values_that_coincide_are_a_conditioning_too(theta, g):
    single = jacobian.evaluate(theta, DEFAULT_ASSEMBLY, g)
    values = np.linalg.svd(single.velocity, compute_uv=False)
    assert single.conditioning == pytest.approx(values[2] / values[0], abs=1e-8)


@pytest.mark.parametrize("g", GEOMETRIES)
def test_tensors_give_what_arrays_give(g):
    thetas, points = angles(1, 5000), places(2, 5000, g)
    names = ("position", "beta", "link3")
    assert_same(forward_all(torch.tensor(thetas), g), forward_all(thetas, g), names, 1e-12)
    names = ("theta", "beta")
    assert_same(inverse_all(torch.tensor(points), g), inverse_all(points, g), names, 1e-12)
    thetas = thetas[forward_all(thetas, g).valid[:, DEFAULT_ASSEMBLY.index]]
    for function in (forward, jacobian.parallel, jacobian.serial, jacobian.conditioning):
        found = function(torch.tensor(thetas), geometry=g)
        np.testing.assert_allclose(found, function(thetas, geometry=g), rtol=0, atol=1e-11)
    for function in (jacobian.evaluate, jacobian.factors):
        both = function(torch.tensor(thetas), geometry=g), function(thetas, geometry=g)
        for found, expected in zip(*map(parts, both), strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-11)
    at_points = (workspace.reachable, workspace.assembly_of, workspace.conditioning_at)
    for function in at_points:
        found = function(torch.tensor(points), geometry=g)
        np.testing.assert_allclose(found, function(points, geometry=g), rtol=0, atol=1e-12)


@pytest.mark.parametrize("shape", [(3,), (0, 3), (2, 5, 3)])
def test_tensors_stay_on_their_device_in_every_shape(shape):
    # "meta" holds no numbers, and refuses to compute with tensors of another device.
    somewhere = torch.zeros(shape, dtype=torch.float32, device="meta")
    found = [*vars(inverse_all(somewhere)).values(), *vars(forward_all(somewhere)).values()]
    tensors = [value for value in found if isinstance(value, torch.Tensor)]
    assert len(tensors) == 6
    assert {value.device.type for value in tensors} == {"meta"}
    assert {value.shape[: len(shape) - 1] for value in tensors} == {shape[:-1]}
    assert {value.dtype for value in tensors} == {torch.float64, torch.bool}


# -- derivatives -----------------------------------------------------------------------------------


@pytest.mark.parametrize("branch", ASSEMBLY_MODES)
@pytest.mark.parametrize(
    "function",
    [forward, jacobian.parallel, jacobian.serial, jacobian.velocity, jacobian.conditioning]
    + [jacobian.factors, jacobian.evaluate],
)
def test_derivatives_are_those_of_finite_differences(function, branch):
    def values(theta):
        found = function(theta, branch)
        return found if isinstance(found, torch.Tensor) else parts(found)

    theta = oracle.angles_on(branch, np.random.default_rng(3), 100, PAPER, clear=0.3)[:3]
    assert len(theta) == 3
    assert gradcheck(values, (torch.tensor(theta, requires_grad=True),))


@pytest.mark.parametrize("branch", [mode for mode in WORKING_MODES if mode.cos_beta > 0])
def test_derivatives_at_points_are_those_of_finite_differences(branch):
    points = np.random.default_rng(4).uniform(LOW, HIGH, (3, 3))
    tensor = torch.tensor(points, requires_grad=True)
    slot = int(workspace.assembly_of(points[0], branch))
    assert gradcheck(lambda p: inverse(p, branch), (tensor,))
    assert gradcheck(
        lambda p: workspace.conditioning_at(p, branch, ASSEMBLY_MODES[slot]), (tensor,)
    )


@pytest.mark.parametrize("branch", [mode for mode in WORKING_MODES if mode.cos_beta > 0])
def test_derivatives_by_the_lengths_are_those_of_finite_differences(branch):
    points = torch.tensor(np.random.default_rng(4).uniform(LOW, HIGH, (3, 3)))
    slot = int(workspace.assembly_of(points[0], branch))

    def values(lengths):
        g = Lengths(*lengths)
        factors = jacobian.factors_at(points, branch, g)
        found = workspace.conditioning_at(points, branch, ASSEMBLY_MODES[slot], g)
        return found, *factors

    lengths = torch.tensor(np.array(PAPER.lengths), requires_grad=True)
    assert gradcheck(values, (lengths,))


def test_branches_that_do_not_exist_leave_the_derivatives_of_the_others_finite():
    points, thetas = places(5, 3000, PAPER), angles(6, 3000)
    for function, given in ((inverse_all, points), (forward_all, thetas)):
        tensor = torch.tensor(given, requires_grad=True)
        found = function(tensor)
        assert 0 < found.valid.double().mean() < 0.9
        values = [v for v in vars(found).values() if getattr(v, "requires_grad", False)]
        sum(value[found.valid].sum() for value in values).backward()
        assert torch.isfinite(tensor.grad).all()
        assert (tensor.grad != 0).any(dim=-1).equal(found.valid.any(dim=-1))


@pytest.mark.parametrize(
    ("function", "kind", "g", "inputs"),
    [
        (workspace.conditioning_at, Lengths, PAPER, places(5, 3000, PAPER)),
        (workspace.conditioning_at, Lengths, PAPER, [[-0.04, 0.0, 0.8], [-0.04, 0.03, 0.8]]),
        (delta.conditioning_at, DeltaLengths, IRB_360, places(5, 3000, WIDE)),
        (delta.jacobian, DeltaLengths, IRB_360, angles(6, 3000)),
    ],
    ids=["reach", "y = 0", "Delta", "Jacobian"],
)
def test_rows_without_a_value_leave_the_derivatives_by_the_lengths_finite(
    function, kind, g, inputs
):
    derivatives, there = [], torch.ones(len(inputs), dtype=torch.bool)
    for _ in range(2):  # all rows, then those with a value
        lengths = torch.tensor([*vars(g).values()], requires_grad=True, dtype=torch.float64)
        given = torch.as_tensor(inputs, dtype=torch.float64)[there]
        found = function(given, geometry=kind(*lengths)).nan_to_num(0.0)
        found.sum().backward()
        derivatives.append(lengths.grad)
        there = (found != 0).reshape(len(found), -1).any(-1)
    assert 0 < sum(there) < len(inputs)
    torch.testing.assert_close(*derivatives)


# -- singularities ---------------------------------------------------------------------------------


def exists(theta: FloatArray) -> bool:
    return bool(forward_all(theta).valid[DEFAULT_ASSEMBLY.index])


def test_where_an_assembly_ends_it_meets_another_and_the_factor_is_named():
    factors = set()
    for inside, outside in zip(angles(7, 300), angles(8, 300), strict=True):
        if not exists(inside) or exists(outside):
            continue
        for _ in range(60):
            middle = (inside + outside) / 2
            inside, outside = (middle, outside) if exists(middle) else (inside, middle)
        with pytest.raises((SingularityError, UnreachableError)) as caught:  # rounding decides
            jacobian.velocity(inside)
        factors.add(getattr(caught.value, "factor", None))
    assert "sin(beta)" in factors


# -- conditioning ----------------------------------------------------------------------------------


def with_singular_values(rng: np.random.Generator, values: list[float]) -> FloatArray:
    left, _, right = np.linalg.svd(rng.normal(size=(3, 3)))
    return np.asarray(left @ np.diag(values) @ right)


def error(matrices: FloatArray) -> float:
    """The largest error of the conditioning, against numpy's singular values."""
    matrices = matrices.reshape(-1, 3, 3)
    values = np.linalg.svd(matrices, compute_uv=False)
    expected = values[:, 2] / np.where(values[:, 0] > 0, values[:, 0], 1.0)
    found = equations.conditioning(np.moveaxis(matrices, 0, -1), NUMPY)
    assert ((found >= 0) & (found <= 1)).all()
    return float(np.abs(found - expected).max())


def test_the_conditioning_is_that_of_the_singular_values():
    rng = np.random.default_rng(1)
    assert error(rng.normal(size=(500, 3, 3))) < 1e-12
    for exact in ([1, 1, 1], [1, 1, 0], [1, 0, 0], [1, 1, 1e-9], [1, 1e-9, 1e-9], [0, 0, 0]):
        assert error(np.diag(exact)) < 1e-15
    for _ in range(500):
        size, middle, small = 10 ** rng.uniform((-3, -3, -6), (3, -0.05, 0))
        assert (
            error(with_singular_values(rng, [size, size * middle, size * middle * small])) < 1e-12
        )
    for _ in range(300):  # where the two largest coincide, some digits are lost
        near, small = 1 - 10 ** rng.uniform(-16, -3), 10 ** rng.uniform(-6, 0)
        assert error(with_singular_values(rng, [1.0, near, near * small])) < 1e-8
    # The root of the smallest eigenvalue of J J^T would have no digit left below 1e-8.
    for smallest in (1e-4, 1e-8, 1e-11):
        matrix = with_singular_values(rng, [1.0, 0.3, smallest])
        assert equations.conditioning(matrix, NUMPY) == pytest.approx(smallest, rel=1e-3)


@pytest.mark.parametrize("g", GEOMETRIES)
def test_the_conditioning_of_the_mechanism_is_that_of_its_singular_values_everywhere(g):
    thetas = angles(9, 20_000)
    for branch in ASSEMBLY_MODES:
        real = thetas[forward_all(thetas, g).valid[:, branch.index]]
        values = np.linalg.svd(jacobian.velocity(real, branch, g), compute_uv=False)
        found = jacobian.conditioning(real, branch, g)
        np.testing.assert_allclose(found, values[:, 2] / values[:, 0], rtol=1e-8, atol=1e-12)


def test_the_conditioning_falls_to_zero_in_proportion_to_y():
    points = np.random.default_rng(10).uniform(LOW, HIGH, (200, 3))
    heights = 10.0 ** -np.arange(4, 20)
    ratios = [workspace.conditioning_at(points * [1, 0, 1] + [0, y, 0]) / y for y in heights]
    assert np.min(ratios) > 1
    assert np.max(ratios) < 20
    np.testing.assert_allclose(ratios, ratios[:1] * len(ratios), rtol=2e-3)


@pytest.mark.parametrize("factor", [1, 2])
def test_the_conditioning_is_zero_where_level3_or_the_planar_factor_is(factor):
    def sign(points):
        return np.sign(jacobian.factors_at(points).parallel[:, factor])

    one = places(11, 60_000, PAPER)
    other = one + np.random.default_rng(12).normal(0.0, 0.03, one.shape) * [1, 0, 1]
    across = sign(one) * sign(other) < 0
    one, other = one[across], other[across]
    assert len(one) > 20
    for _ in range(60):
        middle = (one + other) / 2
        same = (sign(middle) == sign(one))[:, None]
        one, other = np.where(same, middle, one), np.where(same, other, middle)
    for mode in ASSEMBLY_MODES:
        assert workspace.conditioning_at(one, assembly=mode).max() < 1e-9
