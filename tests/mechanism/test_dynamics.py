"""The closed-form dynamics are those of the bodies, and of mechanics.

Independent of the formulas: virtual work by differences, and Pinocchio on the URDF
(test_pinocchio.py).
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import oracle
import pytest
import torch
from examples import examples
from machines import anywhere, each_machine

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import ConfigurationError, InputError, SingularityError, UnreachableError
from tpm_gym.kinematics import ASSEMBLY_MODES, AssemblyMode, forward_all, inverse_all, jacobian
from tpm_gym.kinematics.geometry import PAPER, WIDE, Geometry
from tpm_gym.mechanism import PAPER_TPM, TPM, Machine, virtual_work
from tpm_gym.mechanism.bodies import Mechanism, Solid
from tpm_gym.mechanism.delta.dynamics import DeltaDynamics
from tpm_gym.mechanism.delta.geometry import IRB_360
from tpm_gym.mechanism.inertia import Bodies
from tpm_gym.mechanism.tpm.bodies import build, joint_angles
from tpm_gym.mechanism.tpm.dynamics import Dynamics
from tpm_gym.mechanism.tpm.inertia import inertia_of

LINKS = len(build().links) - 1
HOME = np.array(PAPER_TPM.inverse(PAPER_TPM.home))
LOADED = Dynamics(
    link_masses=tuple(np.linspace(0.5, 2.0, LINKS)), payload=0.3, free_fall=(1.0, -2.0, 9.0)
)


def drawn(machine: TPM, count: int, seed: int = 0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Angles all over the region, rates and accelerations, (count, 3)."""
    rng = np.random.default_rng(seed)
    theta = machine.inverse(anywhere(machine, count, seed))
    return theta, rng.normal(size=theta.shape), 10 * rng.normal(size=theta.shape)


def regular(g: Geometry, seed: int) -> Iterator[tuple[FloatArray, Dynamics]]:
    """Postures of any working mode, in every assembly mode, away from singularities.

    The nearer, the larger what the differences miss, with the square of their step.
    """
    rng = np.random.default_rng(seed)
    solutions = inverse_all(oracle.reachable_points(rng, 1, g), g)
    for theta in solutions.theta[solutions.valid][:4]:
        for branch in ASSEMBLY_MODES:
            if forward_all(theta, g).valid[branch.index]:
                f = jacobian.factors(theta, branch, g)
                shares = *(f.parallel / (1, g.l4, g.l4**2)), f.elevation / g.l4
                if np.abs(shares).min() > 0.2:
                    masses = tuple(rng.uniform(0.5, 2.0, LINKS).tolist())
                    yield theta, replace(LOADED, geometry=g, branch=branch, link_masses=masses)


def close(found: Any, expected: Any, share: float) -> bool:
    """Whether two arrays agree to a share of the largest entry."""
    return bool(np.abs(np.subtract(found, expected)).max() <= share * np.abs(expected).max())


# The bodies


@pytest.mark.parametrize("g", [PAPER, WIDE], ids=["paper", "wide"])
def test_torques_are_those_of_the_bodies_in_every_assembly_mode(g):
    branches = set().union(*(branches_with_those_of_the_bodies(g, seed) for seed in range(8)))
    assert branches == set(ASSEMBLY_MODES)


@examples(15, oracle.geometries(), oracle.seeds())
def test_torques_are_those_of_the_bodies_for_any_lengths(g, seed):
    branches_with_those_of_the_bodies(g, seed)


def branches_with_those_of_the_bodies(g: Geometry, seed: int) -> set[AssemblyMode]:
    """Compare with virtual work by differences; end link 10, which rolls as it likes, does not."""
    found, rng = set(), np.random.default_rng(seed)
    for theta, dynamics in regular(g, seed):
        rate, change = rng.normal(size=(2, 3)) * [[0.1], [10.0]]  # differences like it slow
        expected = virtual_work.torque(
            build(g),
            lambda at, branch=dynamics.branch: joint_angles(at, branch, g) | {"R33": 0.0},
            dynamics.free_fall,
            np.array(dynamics.link_masses),
            *(theta, rate, change),
        )
        assert close(replace(dynamics, payload=0.0).torque(theta, rate, change), expected, 1e-4)
        found.add(dynamics.branch)
    return found


@each_machine
def test_a_payload_is_a_mass_at_p(machine):
    theta, *_ = drawn(machine, 20)
    loaded, empty = replace(machine.dynamics, payload=0.3), machine.dynamics
    j = jacobian.velocity(theta, machine.assembly_mode, machine.geometry)
    mass = loaded.mass_matrix(theta) - empty.mass_matrix(theta)
    assert close(mass, 0.3 * np.swapaxes(j, -1, -2) @ j, 1e-9)
    weight = loaded.gravity(theta) - empty.gravity(theta)
    assert close(weight, -0.3 * np.array(empty.free_fall) @ j, 1e-9)


@each_machine
def test_torques_are_those_of_virtual_work_by_differences(machine):
    # What is left is the differences' (2e-4 next to y = 0 in PAPER_TPM) and end link 10's roll.
    for *motion, force in zip(*drawn(machine, 10), drawn(machine, 10, 9)[1], strict=True):
        expected = Machine.torque(machine, *motion, force)
        assert close(machine.torque(*motion, force), expected, 1e-3)
    one = drawn(machine, 1, seed=4)
    assert close(machine.torque(*one), Machine.torque(machine, *one), 1e-5)


def with_solid(name: str, solid: Solid) -> Mechanism:
    """The paper's mechanism with a solid more on the link of that name."""
    mechanism = build()
    links = [
        replace(link, solids=(*link.solids, solid)) if link.name == name else link
        for link in mechanism.links
    ]
    return replace(mechanism, links=tuple(links))


@pytest.mark.parametrize(
    ("name", "wanted", "size", "centre"),
    [
        ("arm_5", "on its axis", (0.1, 0.1, 0.1), (0.1, 0.0, 0.02)),
        ("rod_4a", "equal moments", (0.02, 0.1, 0.01), (0.0, 0.4, 0.0)),
        ("rod_11b", "on its axis", (0.1, 0.01, 0.01), (0.4, 0.01, 0.0)),
        ("rod_6", "on its axis", (0.1, 0.01, 0.01), (0.4, 0.0, 0.01)),
        ("link_7", "on its axis", (0.01, 0.01, 0.01), (0.0, 0.02, 0.0)),
        ("end_link_9", "on its axis", (0.01, 0.01, 0.01), (0.02, 0.0, 0.0)),
    ],
)
def test_bodies_for_which_the_formulas_do_not_hold_are_refused(name, wanted, size, centre):
    with pytest.raises(ConfigurationError, match=f"{name}.*{wanted}"):
        inertia_of(Bodies(with_solid(name, Solid("box", size, centre, 2700.0)), ()), PAPER)


def test_links_and_factors_that_are_not_the_mechanisms_are_refused():
    mechanism = build()
    other = replace(mechanism.link("cup"), name="gripper")
    with pytest.raises(ConfigurationError, match="gripper"):
        inertia_of(Bodies(replace(mechanism, links=(*mechanism.links, other)), ()), PAPER)
    with pytest.raises(ConfigurationError, match=f"{LINKS} moving links"):
        Dynamics(link_masses=(1.0, 2.0)).gravity(HOME)
    odd: dict[str, tuple[Any, ...]] = {
        "payload": (-0.1, "1", np.nan),
        "link_masses": ((0.0,) * LINKS, 2.0, "heavy"),
        "free_fall": (9.81, (0.0, 9.81), (0.0, 0.0, np.nan)),
    }
    for name, values in odd.items():
        for value in values:
            with pytest.raises(ConfigurationError, match=name):
                Dynamics(**{name: value})
    same = Dynamics(link_masses=np.ones(LINKS)), Dynamics()
    np.testing.assert_array_equal(*(one.gravity(HOME) for one in same))
    for kind, other, modes in (
        (Dynamics, IRB_360, {"branch": 1}),
        (DeltaDynamics, PAPER, {"side": 0.5}),
    ):
        for wrong in ({"geometry": other}, {"geometry": None}, modes):
            with pytest.raises(InputError, match=next(iter(wrong))):
                kind(**wrong)


def test_states_that_do_not_go_together_are_named():
    five, four = np.tile(HOME, (5, 1)), np.zeros((4, 3))
    for batch in (five, torch.tensor(five)):
        with pytest.raises(InputError, match=r"theta, theta_dot must .*\(5, 3\), \(4, 3\)"):
            Dynamics().energy(batch, four)
    with pytest.raises(InputError, match="torque must be finite"):
        Dynamics().forward(HOME, np.zeros(3), np.full(3, np.nan))


# Mechanics


@each_machine
def test_the_rate_of_the_mass_matrix_less_twice_c_is_skew(machine):
    theta, rate, _ = drawn(machine, 50)
    dynamics, step = machine.dynamics, 1e-6
    ahead, behind = (dynamics.mass_matrix(theta + by * rate) for by in (step, -step))
    coriolis = dynamics.coriolis(theta, rate)
    skew = (ahead - behind) / (2 * step) - 2 * coriolis
    scale = np.abs(coriolis).max(axis=(-1, -2), keepdims=True)
    assert (np.abs(skew + np.swapaxes(skew, -1, -2)) < 1e-5 * scale).all()


@each_machine
def test_the_parts_of_the_torque_add_up_and_forward_undoes_it(machine):
    theta, rate, change = drawn(machine, 50)
    dynamics = replace(machine.dynamics, payload=0.5)
    torque = dynamics.torque(theta, rate, change)
    parts = (
        (dynamics.mass_matrix(theta) @ change[..., None])[..., 0]
        + (dynamics.coriolis(theta, rate) @ rate[..., None])[..., 0]
        + dynamics.gravity(theta)
    )
    assert close(torque, parts, 1e-11)
    assert close(dynamics.forward(theta, rate, torque), change, 1e-9)


@each_machine
def test_the_power_of_the_torque_is_the_rate_of_the_energy(machine):
    theta, rate, change = drawn(machine, 50)
    dynamics = replace(machine.dynamics, payload=0.3, free_fall=LOADED.free_fall)
    step = 1e-6

    def energy(t):
        at = theta + t * rate + t**2 / 2 * change
        return np.sum(dynamics.energy(at, rate + t * change), axis=0)

    power = (dynamics.torque(theta, rate, change) * rate).sum(axis=-1)
    np.testing.assert_allclose(
        (energy(step) - energy(-step)) / (2 * step), power, rtol=1e-5, atol=1e-5
    )


# Points, batches and tensors


def calls(d: Dynamics) -> list[tuple[Callable[..., Any], int]]:
    """Functions of one to three arrays."""
    return [
        (d.torque, 3),
        (d.forward, 3),
        (d.coriolis, 2),
        (lambda *state: np.stack(d.energy(*state), axis=-1), 2),
        (d.gravity, 1),
        (d.mass_matrix, 1),
    ]


@each_machine
def test_batches_are_their_rows(machine):
    states = [each.reshape(2, 3, 3) for each in drawn(machine, 6)]
    for function, count in calls(machine.dynamics):
        batch = function(*states[:count])
        for index in np.ndindex(2, 3):
            one = function(*(state[index] for state in states[:count]))
            assert close(batch[index], one, 1e-11)
    assert close(machine.torque(*states), machine.dynamics.torque(*states), 1e-11)
    motion = machine.motion(*states[:2])
    assert close(motion.mass, machine.dynamics.mass_matrix(states[0]), 1e-11)
    bias = machine.dynamics.torque(*states[:2], np.zeros(3))
    assert close(motion.bias, bias, 1e-11)


def test_states_broadcast_and_may_be_none():
    theta, rate, _ = drawn(PAPER_TPM, 4)
    dynamics = PAPER_TPM.dynamics
    at_rest = dynamics.torque(theta, np.zeros(3), np.zeros(3))
    assert close(at_rest, dynamics.gravity(theta), 1e-13)
    assert dynamics.coriolis(HOME, rate).shape == (4, 3, 3)
    empty = np.empty((0, 3))
    assert dynamics.torque(empty, empty, empty).shape == (0, 3)


@each_machine
def test_tensors_have_the_derivatives_of_the_values(machine):
    states = [torch.tensor(each, requires_grad=True) for each in drawn(machine, 2)]
    dynamics = replace(machine.dynamics, payload=0.2)
    for function, count in (
        (dynamics.torque, 3),
        (dynamics.forward, 3),
        (dynamics.coriolis, 2),
        (lambda *state: torch.stack([*dynamics.energy(*state)]), 2),
        (dynamics.mass_matrix, 1),
    ):
        assert torch.autograd.gradcheck(function, states[:count], rtol=1e-3)
    arrays = [each.detach().numpy() for each in states]
    found = dynamics.torque(*states).detach().numpy()
    assert close(found, dynamics.torque(*arrays), 1e-12)
    mixed = dynamics.torque(states[0], *arrays[1:])
    assert close(mixed.detach().numpy(), found, 1e-15)


# What there is no torque for


def test_states_without_a_torque_are_refused():
    dynamics, rest = PAPER_TPM.dynamics, np.zeros(3)
    apart = np.array([0.0, np.pi, -2.0])
    x, _, z = PAPER_TPM.home
    flat = np.array(PAPER_TPM.inverse((x, 0.0, z)))
    for wrong, error in ((apart, UnreachableError), (flat, SingularityError)):
        with pytest.raises(error):
            dynamics.torque(wrong, rest, rest)
        with pytest.raises(error):
            dynamics.torque([HOME, wrong], rest, rest)
        assert np.isnan(PAPER_TPM.torque(wrong, rest, rest)).all()
    with pytest.raises(InputError):
        dynamics.torque(HOME, [np.nan, 0.0, 0.0], rest)
    with pytest.raises(InputError):
        dynamics.forward(HOME, rest, [1.0, 2.0])
