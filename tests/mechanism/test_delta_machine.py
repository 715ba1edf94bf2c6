"""The Delta against root finders, differences, published numbers and its bodies.

Pinocchio computes its torques in test_pinocchio.py.
"""

import importlib
from dataclasses import replace
from functools import cache, partial
from itertools import product

import numpy as np
import pytest
from mutated import functions_of, install
from roots import circle_roots, unit, unmatched
from walk import gaps, place, walk

from tpm_gym.analysis.delta import aspects, chains, reachable_set
from tpm_gym.errors import (
    ConfigurationError,
    GeometryError,
    InputError,
    SingularityError,
    UnreachableError,
)
from tpm_gym.kinematics.geometry import PAPER
from tpm_gym.mechanism import DELTA
from tpm_gym.mechanism.closures import closure_jacobian, moving_joints
from tpm_gym.mechanism.delta import kinematics
from tpm_gym.mechanism.delta.geometry import ASSEMBLY_MODES, IRB_360, WORKING_MODES, DeltaGeometry
from tpm_gym.mechanism.machine import Machine

TURNS = 2 * np.pi / 3 * np.arange(3)
OUT = np.stack([np.cos(TURNS), np.sin(TURNS), np.zeros(3)], axis=-1)
UP = np.array([0.0, 0.0, 1.0])


@cache
def geometries():
    """Twenty geometries that differ much, the published one first."""
    low, high = (0.05, 0.0, 0.2, 0.5, 0.03), (0.5, 0.2, 0.7, 1.5, 0.1)
    drawn = np.random.default_rng(0).uniform(low, high, (19, 5)).tolist()
    return [IRB_360, *(DeltaGeometry(*lengths) for lengths in drawn)]


def pivots(g, theta):
    """Elbows B_i, moved by the platform's radius, (..., 3, 3) m: the centres of P's spheres."""
    theta = np.asarray(theta)[..., None]
    return (g.l1 - g.l2 + g.l3 * np.cos(theta)) * OUT + g.l3 * np.sin(theta) * UP


def sampled(g, count, seed):
    """Points (count, 3) m in reach and out of it."""
    far = g.l3 + g.l4
    return np.random.default_rng(seed).uniform(-far, far, (count, 3))


def postures(g, count, seed=0):
    """Points in reach and their joint angles in all working modes, (n, 3) and (n, 8, 3)."""
    points = sampled(g, 40 * count, seed)
    points = points[np.isfinite(kinematics.inverse_all(points, g)).all(axis=(1, 2))][:count]
    return points, kinematics.inverse_all(points, g)


def of_mode(g, theta, points):
    """The assembly mode, 0 or 1, of each posture."""
    off = np.abs(kinematics.forward_all(theta, g) - points[..., None, :]).max(axis=-1)
    return off.argmin(axis=-1)


# Positions


def forward_by_roots(g, theta):
    """P goes around the circle in which two spheres intersect; the third cuts it at the roots."""
    a, b, c = np.moveaxis(pivots(g, theta), -2, 0)
    middle, way = (a + b) / 2, b - a
    across = np.linalg.norm(way, axis=-1, keepdims=True)
    rows = np.flatnonzero(across[:, 0] < 2 * g.l4)
    one = np.cross(way, np.roll(way, 1, axis=-1))
    one /= np.linalg.norm(one, axis=-1, keepdims=True)
    other = np.cross(way / across, one)

    def at(row, turn):
        row, turn = rows[row], turn[..., None]
        radius = np.sqrt(g.l4**2 - across[row] ** 2 / 4)
        return middle[row] + radius * (np.cos(turn) * one[row] + np.sin(turn) * other[row])

    def miss(row, turn):
        return ((at(row, turn) - c[rows[row]]) ** 2).sum(axis=-1) - g.l4**2

    row, turn = circle_roots(miss, len(rows))
    points = at(row, turn)
    return [points[rows[row] == k] for k in range(len(theta))]


def inverse_by_roots(g, points):
    """The elbow goes around its circle; the distance to C is l4 at the roots."""

    def miss(leg):
        def apart(row, turn):
            pivot = pivots(g, np.broadcast_to(turn[..., None], (*turn.shape, 3)))[..., leg, :]
            return np.linalg.norm(points[row] - pivot, axis=-1) - g.l4

        return apart

    legs = [circle_roots(miss(leg), len(points)) for leg in range(3)]
    found = [product(*(turn[row == k] for row, turn in legs)) for k in range(len(points))]
    return [np.array(list(angles)).reshape(-1, 3) for angles in found]


@pytest.mark.parametrize("index", range(20))
def test_forward_misses_and_invents_no_solution(index):
    g = geometries()[index]
    theta = np.random.default_rng(index).uniform(-np.pi, np.pi, (500, 3))
    found = kinematics.forward_all(theta, g)
    gap = np.linalg.norm(found[..., None, :] - pivots(g, theta)[:, None], axis=-1) - g.l4
    assert np.nanmax(np.abs(gap)) < 1e-7 * g.l4
    ours = [both[np.isfinite(both).all(axis=-1)] for both in found]
    other, compared, worst = unmatched(forward_by_roots(g, theta), ours)
    assert (other, worst < 1e-6) == (0, True)
    assert compared > 100


@pytest.mark.parametrize("index", range(20))
def test_inverse_misses_and_invents_no_solution(index):
    g = geometries()[index]
    points = sampled(g, 500, index)
    found = kinematics.inverse_all(points, g)
    gap = np.linalg.norm(points[:, None, None] - pivots(g, found), axis=-1) - g.l4
    assert np.nanmax(np.abs(gap)) < 1e-9
    ours = [unit(angles[np.isfinite(angles).all(axis=-1)]) for angles in found]
    roots = [unit(angles) for angles in inverse_by_roots(g, points)]
    other, compared, worst = unmatched(roots, ours)
    assert (other, worst < 1e-6) == (0, True)
    assert compared > 160


def test_working_modes_are_the_signs_of_the_serial_factors():
    for g in geometries()[:5]:
        points, theta = postures(g, 20)
        sides = of_mode(g, theta, points[:, None])
        for slot, mode in enumerate(WORKING_MODES):
            for side in ASSEMBLY_MODES:
                rows = sides[:, slot] == ASSEMBLY_MODES.index(side)
                serial = kinematics.factors(theta[rows, slot], side, g).serial
                assert (np.sign(serial) == mode).all()
                parallel = kinematics.factors(theta[rows, slot], side, g).parallel
                assert (np.sign(parallel) == side).all()


@pytest.mark.parametrize(
    ("theta", "position"),
    [((-20.5, -20.5, -20.5), (0.0, 0.0, -0.9)), ((47.5, -11.6, 21.4), (0.3, 0.5, -1.1)),
     ((10.0, 20.0, 30.0), (0.108, -0.180, -1.244))],
)  # fmt: skip
def test_published_examples(theta, position):
    """Williams' three examples; his z points up, and his leg 1 along -y."""
    x, y, z = position
    ours = (-y, x, -z)
    found = np.rad2deg(kinematics.inverse_all(ours)[-1])
    np.testing.assert_allclose(found, theta, atol=0.2)  # position in mm
    np.testing.assert_allclose(kinematics.forward_all(np.deg2rad(theta))[1], ours, atol=2e-3)


# Velocities and singularities


def test_jacobian_is_the_derivative_of_the_position():
    step = 1e-6
    for g in geometries()[:6]:
        points, theta = postures(g, 20)
        for slot, side in ((0, -1.0), (7, 1.0), (5, 1.0)):
            angles = theta[of_mode(g, theta, points[:, None])[:, slot] == (side > 0), slot]
            found = kinematics.jacobian(angles, side, g)
            index = ASSEMBLY_MODES.index(side)
            for motor, by in enumerate(step * np.eye(3)):
                ends = (kinematics.forward_all(angles + s * by, g) for s in (1, -1))
                slope = np.subtract(*ends)[:, index] / (2 * step)
                size = 1 + np.abs(found).max(axis=(1, 2))[:, None] ** 3
                assert (np.abs(found[..., motor] - slope) / size).max() < 1e-6


def test_tensors_give_the_same_and_their_gradient_is_the_jacobian():
    torch = pytest.importorskip("torch")
    points, theta = postures(IRB_360, 20)
    angles = torch.tensor(theta[:, -1], requires_grad=True)
    position = kinematics.forward_all(angles)[..., 1, :]
    rows = [
        torch.autograd.grad(position[:, k].sum(), angles, retain_graph=True)[0] for k in range(3)
    ]
    expected = kinematics.jacobian(theta[:, -1])
    there = np.isfinite(expected).all(axis=(1, 2))
    assert there.sum() > 10
    found = torch.stack(rows, 1).numpy()
    np.testing.assert_allclose(found[there], expected[there], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(kinematics.inverse_all(torch.tensor(points)), theta, atol=1e-12)


def test_compiled_rows_are_the_equations():
    points, theta = postures(IRB_360, 300)
    np.testing.assert_allclose(DELTA.inverse(points), theta[:, -1], atol=1e-13)
    reading = DELTA.evaluate(theta[:, -1])
    expected = kinematics.forward_all(theta[:, -1])[:, 1]
    np.testing.assert_allclose(reading.position, expected, atol=1e-12)
    np.testing.assert_allclose(reading.jacobian, kinematics.jacobian(theta[:, -1]), rtol=1e-9)
    regular = np.abs(expected - points).max(axis=-1) < 1e-9
    assert 100 < regular.sum() < 300
    by_point = kinematics.conditioning_at(points)
    np.testing.assert_allclose(reading.conditioning[regular], by_point[regular], atol=1e-9)
    np.testing.assert_array_equal(DELTA.conditioning_at(points) > 0, regular)
    np.testing.assert_array_equal(DELTA.same_side(points), regular)
    np.testing.assert_array_equal(DELTA.mode_left(theta[:, -1], points) == 0, regular)
    assert (DELTA.mode_left(theta[:, 0], points)[regular] != 0).all()
    svd = np.linalg.svd(reading.jacobian, compute_uv=False)
    np.testing.assert_allclose(reading.conditioning, svd[:, 2] / svd[:, 0], atol=1e-8)


def passive(g, theta, side):
    """The closure Jacobian (18, 18) without the motors, from the bodies alone."""
    machine = replace(DELTA, name="any", geometry=g) if g != IRB_360 else DELTA
    mechanism = machine.mechanism
    joints = replace_side(machine, side).joint_positions(tuple(theta))
    columns = [name not in mechanism.actuated for name in moving_joints(mechanism)]
    return closure_jacobian(mechanism, joints)[:, columns]


def replace_side(machine, side):
    """A machine in the other assembly mode, unchecked: no region of it is needed."""
    other = object.__new__(type(machine))
    other.__dict__.update(machine.__dict__, assembly_mode=side)
    return other


def test_the_closures_are_singular_where_parallel_or_constraint_factors_are_zero():
    """Their determinant is the product of both, and of cos^2 of the universal joints' tilts."""
    points, theta = postures(IRB_360, 60)
    shares = []
    for point, angles in zip(points, theta[:, -1], strict=True):
        side = ASSEMBLY_MODES[int(of_mode(IRB_360, angles, point))]
        found = kinematics.factors(angles, side)
        volume = np.linalg.det(passive(IRB_360, angles, side))
        hinges = np.cross(UP, OUT)
        along = (hinges * (point - pivots(IRB_360, angles))).sum(axis=-1)  # of the rods, m
        tilt = np.prod(1 - (along / IRB_360.l4) ** 2)
        shares.append(volume / (found.parallel * found.constraint * tilt))
    shares = np.array(shares)
    assert np.ptp(np.log(np.abs(shares))) < 1e-6


def test_the_platform_can_turn_where_the_constraint_factor_is_zero():
    def factor(point):
        return float(kinematics.factors(kinematics.inverse_all(point)[-1]).constraint)

    points, theta = postures(IRB_360, 400, seed=4)
    sign = np.sign(kinematics.factors(theta[:, -1]).constraint)
    right = of_mode(IRB_360, theta[:, -1], points) == 1
    low, high = points[right & (sign > 0)][0], points[right & (sign < 0)][0]
    for _ in range(60):
        half = (low + high) / 2
        low, high = (half, high) if factor(half) > 0 else (low, half)
    values = np.linalg.svd(passive(IRB_360, kinematics.inverse_all(low)[-1], 1.0))[1]
    assert values[-1] < 1e-12 < 1e-3 < values[-2]


def test_singular_and_unreachable_are_explained():
    with pytest.raises(UnreachableError, match=r"leg 2 fails by 0\.0846"):
        DELTA.require_inverse((-1.2, 0.0, 1.2))
    with pytest.raises(UnreachableError, match="three spheres"):
        DELTA.dynamics.gravity((0.0, 0.0, np.pi))
    # The rods lie in the plane of the elbows
    flat = replace(IRB_360, l4=IRB_360.l1 - IRB_360.l2 + IRB_360.l3)
    with pytest.raises(SingularityError, match="det A"):
        replace(DELTA.dynamics, geometry=flat).gravity((0.0, 0.0, 0.0))
    assert np.isnan(kinematics.jacobian((0.0, 0.0, 0.0), 1.0, flat)).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [("l1", 0.0), ("l2", -0.1), ("l3", np.nan), ("l4", "long"), ("l4", 1e-3), ("l5", 0.0)],
)
def test_lengths_that_make_no_delta_are_refused(name, value):
    lengths = dict(vars(replace(IRB_360, l1=0.9))) | {name: value}
    with pytest.raises(GeometryError, match=name):
        DeltaGeometry(**lengths)


@pytest.mark.parametrize(
    ("name", "value"),
    [("geometry", None), ("working_mode", (1, 0, 1)), ("assembly_mode", 0), ("home", (0, 0, 3))]
    + [("assembly_mode", np.ones(2)), ("working_mode", "out")],
)
def test_machines_on_which_no_episode_could_run_are_refused(name, value):
    with pytest.raises((ConfigurationError, UnreachableError), match=name):
        replace(DELTA, **{name: value})


def test_anything_but_modes_and_lengths_of_a_delta_is_refused():
    home, theta = DELTA.home, DELTA.inverse(DELTA.home)
    at_points = kinematics.factors_at, kinematics.conditioning_at, kinematics.reachable
    for function in at_points:
        for bends in ((1, 1, 2), (1, 1), "out"):
            with pytest.raises(InputError, match="bends"):
                function(home, bends)
    for function in (kinematics.jacobian, kinematics.factors, chains):
        for side in (0.5, None, np.ones(2)):
            with pytest.raises(InputError, match="side"):
                function(theta, side)
    for function in (kinematics.conditioning_at, kinematics.inverse_all, kinematics.forward_all):
        with pytest.raises(InputError, match="geometry"):
            function(home, geometry=PAPER)
    for function in (aspects, reachable_set):
        with pytest.raises(InputError, match="geometry"):
            function(geometry=PAPER)
        with pytest.raises(InputError, match="bends"):
            function((1, 1, 2), shape=(8, 8, 8))
    for shape in (8, (8, 8), (8, 1, 8)):
        with pytest.raises(ConfigurationError, match="shape"):
            aspects(shape=shape)
    with pytest.raises(ConfigurationError, match="min_cells"):
        aspects(shape=(8, 8, 8), min_cells=0)


# Bodies


@pytest.mark.parametrize("index", range(8))
def test_passive_angles_close_all_loops_in_every_mode(index):
    g = geometries()[index]
    points, theta = postures(g, 5)
    machine = object.__new__(type(DELTA))
    machine.__dict__.update(name="any", geometry=g, assembly_mode=1.0)
    for angles in theta.reshape(-1, 3):
        for side, position in zip(ASSEMBLY_MODES, kinematics.forward_all(angles, g), strict=True):
            joints = replace_side(machine, side).joint_positions(tuple(angles.tolist()))
            assert np.abs(gaps(machine.mechanism, joints)).max() < 1e-9
            frames = walk(machine.mechanism, joints)
            np.testing.assert_allclose(place(frames, "platform", (0, 0, 0)), position, atol=1e-9)
            np.testing.assert_allclose(frames["platform"][1], np.eye(3), atol=1e-12)
            for leg in range(3):
                elbow = place(frames, f"arm_{leg + 1}", (g.l3, 0, 0))
                np.testing.assert_allclose(
                    elbow - g.l2 * OUT[leg], pivots(g, angles)[leg], atol=1e-9
                )
    assert len(points) == 5


def test_no_row_of_the_closures_is_redundant_and_no_closure_is_within_a_leg():
    mechanism = DELTA.mechanism
    joints = DELTA.joint_positions(tuple(DELTA.inverse(DELTA.home).tolist()))
    jacobian = closure_jacobian(mechanism, joints)
    assert jacobian.shape == (18, 21)
    assert np.linalg.matrix_rank(jacobian) == 18
    leg_of = {link.name: i for i, leg in enumerate(mechanism.legs()) for link in leg.links[1:]}
    assert all(leg_of[c.link_a] != leg_of[c.link_b] for c in mechanism.closures)


# Dynamics


def motions(count, seed=0):
    """Joint angles of points of the region, with velocities and accelerations."""
    rng, region = np.random.default_rng(seed), DELTA.region
    theta = DELTA.inverse(rng.uniform(region.low, region.high, (count, 3)))
    return theta, rng.normal(0, 2, (count, 3)), rng.normal(0, 20, (count, 3))


def test_torques_are_those_of_virtual_work_on_the_bodies():
    theta, rates, changes = motions(4)
    rng = np.random.default_rng(1)
    factors = rng.uniform(0.5, 2.0, (4, len(DELTA.mechanism.links) - 1))
    force = rng.normal(0, 10, (4, 3))
    built = np.array([DELTA.built(link_masses=tuple(row)) for row in factors.tolist()])
    found = DELTA.torque(theta, rates, changes, force, built)
    motors = Machine.torque(DELTA, theta, rates, changes, None, factors)
    motors -= (DELTA.evaluate(theta).jacobian * force[..., None]).sum(axis=-2)
    np.testing.assert_allclose(found, motors, atol=1e-5 * np.abs(motors).max())


def test_power_is_the_change_of_energy():
    theta, rates, changes = motions(50)
    dynamics, step = replace(DELTA.dynamics, payload=0.3), 1e-6
    ends = [
        np.add(*dynamics.energy(theta + t * rates + t * t / 2 * changes, rates + t * changes))
        for t in (step, -step)
    ]
    power = (dynamics.torque(theta, rates, changes) * rates).sum(axis=-1)
    np.testing.assert_allclose(np.subtract(*ends) / (2 * step), power, rtol=1e-6, atol=1e-5)
    mass, rest = dynamics.mass_matrix(theta), dynamics.torque(theta, rates, np.zeros(3))
    whole = dynamics.torque(theta, rates, changes)
    np.testing.assert_allclose((mass @ changes[..., None])[..., 0] + rest, whole, rtol=1e-9)
    np.testing.assert_allclose(dynamics.forward(theta, rates, whole), changes, rtol=1e-9)
    quadratic = (dynamics.coriolis(theta, rates) @ rates[..., None])[..., 0]
    np.testing.assert_allclose(quadratic + dynamics.gravity(theta), rest, rtol=1e-9, atol=1e-9)


def test_compiled_dynamics_are_the_equations():
    theta, rates, changes = motions(100)
    np.testing.assert_allclose(
        DELTA.torque(theta, rates, changes), DELTA.dynamics.torque(theta, rates, changes), rtol=1e-9
    )
    motion = DELTA.motion(theta, rates)
    np.testing.assert_allclose(motion.mass, DELTA.dynamics.mass_matrix(theta), rtol=1e-9)
    bias = DELTA.dynamics.torque(theta, rates, np.zeros(3))
    np.testing.assert_allclose(motion.bias, bias, rtol=1e-9)
    assert motion.working.all()


# Mutations

EQUATIONS, DYNAMICS, BODIES = (
    f"tpm_gym.mechanism.delta.{k}" for k in ("equations", "dynamics", "bodies")
)
FORWARD = partial(test_forward_misses_and_invents_no_solution, 1)
INVERSE = partial(test_inverse_misses_and_invents_no_solution, 1)
JACOBIAN = test_jacobian_is_the_derivative_of_the_position
SINGULAR = test_the_closures_are_singular_where_parallel_or_constraint_factors_are_zero
PASSIVE = partial(test_passive_angles_close_all_loops_in_every_mode, 1)
POWER, WORK = (
    test_power_is_the_change_of_energy,
    test_torques_are_those_of_virtual_work_on_the_bodies,
)
MUTATIONS = [
    (FORWARD, EQUATIONS, "leg[0] * v[1] + leg[1] * v[0]", "leg[0] * v[1] - leg[1] * v[0]"),
    (FORWARD, EQUATIONS, "dot(a, a) / (2.0 * square)", "dot(a, b) / (2.0 * square)"),
    (FORWARD, EQUATIONS, "g.l4 * g.l4 - dot(foot, foot)", "g.l4 * g.l4 + dot(foot, foot)"),
    (INVERSE, EQUATIONS, "leg[0] * v[1] - leg[1] * v[0]", "leg[0] * v[1] + leg[1] * v[0]"),
    (INVERSE, EQUATIONS, "arm(x2 + inner, z, y2, _1, g, ns)", "arm(x2 + inner, z, y1, _1, g, ns)"),
    (INVERSE, EQUATIONS, "arm(x3 + inner, z, y3, _1, g, ns)", "arm(x3, z, y3, _1, g, ns)"),
    (JACOBIAN, EQUATIONS, "z - sin", "z + sin"),
    (JACOBIAN, EQUATIONS, "x + (g.l2 - g.l1) - cos", "x + (g.l2 - g.l1) + cos"),
    (JACOBIAN, EQUATIONS, "r2[2] * cos[1] - r2[0] * sin[1]", "r2[2] * cos[1] + r2[0] * sin[1]"),
    (JACOBIAN, EQUATIONS, "r3[2] * cos[2]", "r3[1] * cos[2]"),
    (JACOBIAN, EQUATIONS, "(p * a[1], q * b[1], r * c[1])", "(p * a[1], q * b[2], r * c[1])"),
    (JACOBIAN, EQUATIONS, "r / pose.parallel", "r * pose.parallel"),
    (SINGULAR, EQUATIONS, "r1[0] * r2[2] * r3[2]", "r1[0] * r2[2] * r3[0]"),
    (SINGULAR, EQUATIONS, "r1[2] * r2[0] * r3[2]", "r1[2] * r2[0] * r3[1]"),
    (SINGULAR, EQUATIONS, "dot(bars[0], cross(bars[1], bars[2]))", "dot(bars[0], bars[2])"),
    (PASSIVE, BODIES, "math.atan2(z, x) - angle", "math.atan2(z, x) + angle"),
    (PASSIVE, BODIES, "y / l4", "x / l4"),
    (WORK, BODIES, "couple + far", "far"),
    (WORK, BODIES, "g.l3**2", "g.l3"),
    (POWER, EQUATIONS, "h[1] / pose.parallel", "h[0] / pose.parallel"),
    (POWER, EQUATIONS, "p * a[2] + q * b[2] + r * c[2]", "p * a[2] + q * b[2] - r * c[2]"),
    (POWER, DYNAMICS, "m.platform * (a[2] - gravity[2])", "m.platform * a[2]"),
    (POWER, DYNAMICS, "_drift(two, v2, rates[1])", "_drift(two, v1, rates[1])"),
    (POWER, DYNAMICS, "dot(force, cross(three, one))", "dot(force, cross(one, three))"),
    (POWER, DYNAMICS, "p * dot(force, cross(two, three))", "dot(force, cross(two, three))"),
    (POWER, DYNAMICS, "one.motor + p * dot(a, a) + 2.0 * k1a", "one.motor + p * dot(a, a) + k1a"),
    (POWER, DYNAMICS, "p * dot(b, c) + k2c", "p * dot(b, c) + k2b"),
    (POWER, DYNAMICS, "two.weight + two.couple", "two.weight"),
    (POWER, DYNAMICS, "m.platform + one.couple", "m.platform"),
    (POWER, DYNAMICS, "x * leg.cos + z * leg.sin", "x * leg.cos - z * leg.sin"),
    (POWER, DYNAMICS, "u * u + v[1] * v[1] + w * w", "u * u + w * w"),
    (POWER, DYNAMICS, "_1 - weight * gz - up", "_1 - weight * gz + up"),
    (POWER, DYNAMICS, "-sin * change - cos * rate * rate", "-sin * change + cos * rate * rate"),
    (POWER, DYNAMICS, "leg.cos * v[2] - leg.sin * v[0]", "leg.cos * v[2] + leg.sin * v[0]"),
    (POWER, DYNAMICS, "leg.couple * (_1 - _2)", "leg.weight * (_1 - _2)"),
    (POWER, DYNAMICS, "x * x + z * z", "x * x"),
    (POWER, DYNAMICS, "x * (v[2] - _1) - z * _2", "x * (v[2] - _1) + z * _2"),
    (POWER, DYNAMICS, "leg.swing.spin * out * out", "leg.swing.spin * out"),
    (POWER, DYNAMICS, "leg.swing.fixed + _1", "_1"),
]  # fmt: skip


@pytest.mark.parametrize(("test", "module", "right", "wrong"), MUTATIONS, ids=lambda v: str(v)[:40])
def test_a_named_test_sees_two_mutations_of_each_formula(test, module, right, wrong):
    """The functions of a module get other code while the test runs, and then their own again."""
    functions = [
        function
        for value in vars(importlib.import_module(module)).values()
        for function in functions_of(value).values()
    ]
    codes = [function.__code__ for function in functions]
    try:
        install(module, right, wrong)
        with pytest.raises((AssertionError, ValueError)):
            test()
    finally:
        for function, code in zip(functions, codes, strict=True):
            function.__code__ = code
