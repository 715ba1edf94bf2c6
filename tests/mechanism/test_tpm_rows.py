"""Compiled rows are what arrays of numpy give; each row is computed by itself."""

import math
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from machines import anywhere, each_machine

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import ConfigurationError, InputError
from tpm_gym.kinematics import ASSEMBLY_MODES, WORKING_MODES, forward_all, inverse_all, jacobian
from tpm_gym.kinematics.geometry import PAPER, WIDE, Geometry
from tpm_gym.mechanism import DELTA, PAPER_TPM, TPM
from tpm_gym.mechanism.tpm.rows import LOOPS

GEOMETRIES = [PAPER, WIDE, Geometry(l1=0.31, l2=0.06, l3=0.36, l4=0.79, l5=0.11, l6=0.02, l7=0.07)]


class Anywhere(TPM):
    """A machine that need not have a region in which it works."""

    def __post_init__(self) -> None:
        """Check nothing."""


def machine_of(g: Geometry, **modes: Any) -> TPM:
    values = {**vars(PAPER_TPM), "geometry": g, **modes}
    return Anywhere(**{field.name: values[field.name] for field in fields(PAPER_TPM)})


@pytest.mark.parametrize("g", GEOMETRIES)
@pytest.mark.parametrize("branch", ASSEMBLY_MODES)
def test_angles_give_what_arrays_of_numpy_give(branch, g):
    machine = machine_of(g, assembly_mode=branch)
    theta = np.random.default_rng(branch.index).uniform(-math.pi, math.pi, (600, 3))
    solutions = forward_all(theta, g)
    valid = solutions.valid[:, branch.index]
    assert 20 < valid.sum() < 580
    found = machine.evaluate(theta)
    for array in found[:3]:
        np.testing.assert_array_equal(np.isnan(array).reshape(600, -1).all(axis=1), ~valid)
    expected = jacobian.evaluate(theta[valid], branch, g)
    np.testing.assert_allclose(found.position[valid], expected.position, rtol=0, atol=1e-12)
    scale = np.abs(expected.velocity).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(found.jacobian[valid] / scale, expected.velocity / scale, atol=1e-9)
    np.testing.assert_allclose(
        found.conditioning[valid], expected.conditioning, rtol=1e-9, atol=1e-12
    )
    turned = np.cos(solutions.beta[:, branch.index]) * machine.working_mode.cos_beta > 0
    np.testing.assert_array_equal(found.working, valid & turned)
    position = np.where((valid & turned)[:, None], found.position, np.nan)
    np.testing.assert_array_equal(machine.forward(theta), position)


@pytest.mark.parametrize("g", GEOMETRIES)
@pytest.mark.parametrize("branch", WORKING_MODES)
def test_points_give_what_arrays_of_numpy_give(branch, g):
    reach = np.array([0.6, 1.1 * g.l7, 1.2])
    points = np.random.default_rng(branch.index).uniform(-reach, reach, (200, 3))
    solutions = inverse_all(points, g)
    valid, expected = solutions.valid[:, branch.index], solutions.theta[:, branch.index]
    assert 20 < valid.sum() < 180
    machine = machine_of(g, working_mode=branch)
    np.testing.assert_allclose(machine.inverse(points), expected, rtol=0, atol=1e-12)
    for mode in ASSEMBLY_MODES:
        machine = machine_of(g, working_mode=branch, assembly_mode=mode)
        expected = jacobian.conditioning_at(points, branch, mode, g)
        np.testing.assert_allclose(machine.conditioning_at(points), expected, rtol=1e-6, atol=1e-5)


def test_where_a_divisor_is_zero_there_is_no_solution():
    g = replace(PAPER, l6=0.0)
    machine, same = machine_of(g), math.acos((g.l1 - 2 * g.l5) / g.l3)
    concentric = (same, same, 0.5)  # the circles of C1 have one centre
    for reading in (machine.evaluate(concentric), machine.evaluate((math.inf, 1.0, math.nan))):
        assert all(np.isnan(array).all() for array in reading[:3])
        assert not reading.working
    on_pivot = (2 * g.l5 - g.l1 + g.l2 + g.l7, 0.0, 0.0)  # C2 is on A2
    assert np.isnan(machine.inverse([on_pivot, (math.nan, 0.0, 1.0)])).all()
    assert machine.conditioning_at(on_pivot) == 0.0


def operations(machine: TPM) -> list[Callable[..., Any]]:
    """Functions of positions, joint positions, velocities and parameters."""
    return [
        lambda p, t, v, b: machine.inverse(p, b),
        lambda p, t, v, b: machine.forward(t, b),
        lambda p, t, v, b: machine.evaluate(t, b),
        lambda p, t, v, b: machine.mode_left(t, p, b),
        lambda p, t, v, b: machine.torque(t, v, 3 * v, -v, b),
        lambda p, t, v, b: machine.motion(t, v, b),
    ]


def drawn(machine: TPM, shape: tuple[int, ...]) -> tuple[FloatArray, FloatArray, FloatArray]:
    points = np.array(anywhere(machine, math.prod(shape))).reshape(*shape, 3)
    theta = machine.inverse(points)
    return points, theta, np.random.default_rng(1).normal(size=theta.shape)


def assert_equal(found: Any, expected: Any) -> None:
    for one, other in zip(
        found if isinstance(found, tuple) else [found],
        expected if isinstance(expected, tuple) else [expected],
        strict=True,
    ):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def parts(found: Any, index: Any) -> Any:
    return tuple(part[index] for part in found) if isinstance(found, tuple) else found[index]


@each_machine
def test_a_row_has_the_same_bits_alone_and_among_thousands(machine):
    rows = drawn(machine, (1111,))
    for operation in operations(machine):
        whole = operation(*rows, None)
        for index in (0, 1, 7, 500, 1109, 1110):
            assert_equal(operation(*(r[index] for r in rows), None), parts(whole, index))
        some = slice(3, 20)
        assert_equal(operation(*(r[some] for r in rows), None), parts(whole, some))
        shaped = operation(*(r[:24].reshape(2, 3, 4, 3)[..., ::-1, :] for r in rows), None)
        assert_equal(parts(shaped, (1, 2, 0)), parts(whole, 23))
        empty = operation(*(r[:0] for r in rows), None)
        assert_equal(empty, parts(whole, slice(0, 0)))


@each_machine
def test_rows_are_of_the_machine_that_was_built(machine):
    rng, links = np.random.default_rng(3), len(machine.mechanism.links) - 1
    count, steps = 3, 4
    lengths = [tuple(machine.lengths + rng.normal(0.0, 1e-4, 7)) for _ in range(count)]
    masses = [tuple(rng.uniform(0.8, 1.2, links).tolist()) for _ in range(count)]
    built = np.array([machine.built(*each) for each in zip(lengths, masses, strict=True)])
    rows = drawn(machine, (count, steps))
    for operation in operations(machine):
        whole = operation(*rows, built)
        for index in range(count):
            alone = operation(*(r[index] for r in rows), built[index : index + 1])
            assert_equal(parts(whole, index), alone)
        assert_equal(operation(*rows, machine.built()[None]), operation(*rows, None))
    for index, own in enumerate(lengths):
        other, one = machine.with_lengths(own), built[index : index + 1]
        points, theta, rate = (r[index] for r in rows)
        np.testing.assert_array_equal(machine.inverse(points, one), other.inverse(points))
        dynamics = replace(other.dynamics, link_masses=masses[index])
        torque = machine.torque(theta, rate, rate, None, one)
        np.testing.assert_allclose(torque, dynamics.torque(theta, rate, rate), rtol=1e-9)
    for wrong in (built[:2], built[:, :22], built[:0]):
        with pytest.raises(InputError, match="built"):
            machine.inverse(rows[0][:, :3].reshape(-1, 3), wrong)


def test_shapes_that_do_not_go_together_are_refused():
    for wrong in (np.zeros(2), np.zeros((3, 2)), 0.0):
        with pytest.raises(InputError, match="3"):
            PAPER_TPM.inverse(wrong)
    with pytest.raises(InputError, match="shape"):
        PAPER_TPM.motion(np.zeros((2, 3)), np.zeros((3, 3)))
    with pytest.raises(ConfigurationError, match="7 lengths"):
        PAPER_TPM.built((0.3, 0.07))


@pytest.mark.parametrize("machine", [PAPER_TPM, DELTA])
def test_anything_but_numbers_is_refused(machine):
    region, home = machine.region, machine.home
    for wrong in (
        "abc",
        ["1", "2", "3"],
        [10**400] * 3,
        [1j, 0, 0],
        np.array(["2020"] * 3, "M8[Y]"),
    ):
        for function in (
            *(machine.inverse, machine.evaluate, machine.forward, machine.same_side, machine.reach),
            *(machine.conditioning_at, machine.require_within_stops, machine.occupied),
            *(machine.joint_positions, region.contains, region.project),
            lambda values: machine.torque(home, home, values),
        ):
            with pytest.raises(InputError):
                function(wrong)


def test_all_kinds_of_arrays_share_one_compiled_loop():
    points, theta, rate = drawn(PAPER_TPM, (1,))
    expected = PAPER_TPM.motion(theta, rate)
    frozen = rate.copy()
    frozen.flags.writeable = False
    wide = np.zeros((1, 6))
    wide[:, ::2] = rate
    built = PAPER_TPM.built()[None]
    built.flags.writeable = False
    for other in (frozen, rate[0], rate.tolist(), wide[:, ::2], np.asfortranarray(rate)):
        assert_equal(PAPER_TPM.motion(theta, other, built), expected)
    PAPER_TPM.inverse(np.float32(points))
    loops = LOOPS.motion, LOOPS.inverse
    assert [len(loop.signatures) for loop in loops] == [1, 1]
