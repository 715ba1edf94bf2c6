"""Each quantity of a randomised machine has its physical effect, unknown to the controller."""

import inspect
import itertools
import math
import re
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import yaml
from alone import Alone
from episodes import OF_SERVOS, fingerprint, random_episode

from tpm_gym import TPMEnv, kinematics
from tpm_gym.arrays import FloatArray
from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.mechanism.motor import TORQUE_MOTOR
from tpm_gym.mechanism.mount import GRAVITY
from tpm_gym.simulation import Block, Plant, Randomisation, State
from tpm_gym.simulation.randomisation import _RANGES, _SIZES, NOMINAL
from tpm_gym.simulation.settings import settings_of

HOME = PAPER_TPM.home
THETA = PAPER_TPM.inverse(HOME)
MOUNT = PAPER_TPM.mount
J = np.array(PAPER_TPM.evaluate(THETA).jacobian)
ON_TABLE = {"object": (0.05, -0.03, 0.015)}
LINKS = len(PAPER_TPM.mechanism.links) - 1


def of(value: Any) -> Randomisation:
    """As environments take it."""
    return settings_of(Randomisation, "randomisation", value)


@pytest.fixture
def simulation(with_block):
    return with_block


def rest(simulation: Alone, plant: Plant, steps: int = 15) -> State:
    """Hold still at home until everything has settled."""
    simulation.reset(THETA, ON_TABLE, plant=plant)
    for _ in range(steps):
        state = simulation.move(HOME)
    return state


# -- options ---------------------------------------------------------------------------------------


def out_of_range() -> Iterator[tuple[str, Any, str]]:
    """Option, value, and what the error must say."""
    for name, (low, high) in _RANGES.items():
        limits, pair = f"within {low} to {high}", "(low, high)"
        below, above = low - 1e-9, 1.01 * high
        for value in (below, above, (below, high), (low, above), (low, np.nan), True, 10**400):
            yield name, value, limits
        for value in ((high, low), (1.0,), {"low": 1.0}, ("1", "2")):
            yield name, value, pair
    for name, largest in _SIZES.items():
        for value in (-1e-9, 1.01 * largest, np.nan, True, None, "small", (0.0, largest)):
            yield name, value, f"from 0 to {largest}"
    for value in (6, -1, 0.5, True, None, "one", [1], np.nan):
        yield "latency", value, "from 0 to 5"


def test_what_is_out_of_range_is_refused_by_name_value_and_limit():
    for name, value, limit in out_of_range():
        with pytest.raises(ConfigurationError) as caught:
            of({name: value})
        assert caught.value.name == name
        assert repr(caught.value.value) == repr(value)
        assert limit in caught.value.valid
        assert limit in str(caught.value)


def test_length_errors_that_could_make_a_length_negative_are_refused():
    short = replace(PAPER_TPM, name="short", geometry=replace(PAPER, l6=0.0005))
    with closing(TPMEnv(machine=short, randomisation={"length_error": 0.0005}, engine="analytic")):
        pass
    with pytest.raises(ConfigurationError, match=r"shortest length of 'short', 0\.0005 m"):
        TPMEnv(machine=short, randomisation={"length_error": 0.0006}, engine="analytic")


def test_the_documentation_states_the_ranges():
    text = inspect.getdoc(Randomisation) or ""
    found = re.findall(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", text, flags=re.MULTILINE)
    entries = {name: " ".join(entry.split()) for name, entry in found}
    for name, (low, high) in _RANGES.items():
        assert f"within {low:g} to {high:g}." in entries[name]
    for name, largest in _SIZES.items():
        assert re.search(rf"(at most|most) {largest:g}\.( |$)", entries[name])
    block = Block()
    assert f"({1e3 * block.mass:g} g)" in entries["block_mass"]
    assert f"({block.friction:g} on the table)" in entries["friction"]
    assert f"({TORQUE_MOTOR.peak_torque:g} N m)" in entries["motor_strength"]


@pytest.mark.parametrize("value", [0.1, "all", [("latency", 1)], {"encoder_jitter": 1}, {1: 2}])
def test_what_is_no_randomisation_is_refused_and_the_keys_are_named(value):
    with pytest.raises(ConfigurationError, match="length_error") as caught:
        TPMEnv(randomisation=value)
    assert caught.value.name == "randomisation"


def test_a_file_may_say_it_and_a_number_is_a_fixed_factor():
    text = "{link_mass: [0.8, 1.2], block_mass: 2, encoder_noise: 1.0e-4, latency: 1}"
    expected = Randomisation(link_mass=(0.8, 1.2), block_mass=2, encoder_noise=1e-4, latency=1)
    assert of(yaml.safe_load(text)) == expected
    assert expected.block_mass == (2.0, 2.0)
    assert of(expected) is expected
    assert of(None) == of({}) == Randomisation()
    assert Randomisation(link_mass=[0.8, 1.2]) == Randomisation(link_mass=(0.8, 1.2))
    assert Randomisation(friction=np.float32(0.5)).friction == (0.5, 0.5)


# -- drawing ---------------------------------------------------------------------------------------


def test_nothing_is_drawn_for_what_is_not_random():
    rng = np.random.default_rng(0)
    before = rng.bit_generator.state
    assert Randomisation().draw(rng, PAPER_TPM) == NOMINAL
    fixed = Randomisation(link_mass=2.0, block_mass=3.0, motor_strength=0.5, latency=1)
    plant = fixed.draw(rng, PAPER_TPM)
    assert rng.bit_generator.state == before
    assert plant.link_masses == (2.0,) * LINKS
    assert (plant.block_mass, plant.friction, plant.motor_strength) == (3.0, 1.0, (0.5,) * 3)


def numbers(plant: Plant) -> FloatArray:
    return np.concatenate([np.ravel(value) for value in vars(plant).values()])


def test_draws_fill_the_stated_ranges_and_are_independent():
    sizes = {name: _SIZES[name] for name in ("encoder_bias", "length_error")}
    wide = Randomisation(**_RANGES, **sizes)
    rng = np.random.default_rng(1)
    draws = np.array([numbers(wide.draw(rng, PAPER_TPM)) for _ in range(3000)])
    counts = {"link_mass": LINKS, "block_mass": 1, "friction": 1, "motor_strength": 3}
    counts |= {"servo_stiffness": 3, "joint_friction": 3}
    ranges = [_RANGES[name] for name, count in counts.items() for _ in range(count)]
    for size, count in zip(sizes.values(), (3, 7), strict=True):
        ranges += [(-size, size)] * count
    low, high = np.array(ranges).T
    unit = (draws - low) / (high - low)
    assert (unit >= 0).all()
    assert (unit <= 1).all()
    # Uniform: mean 1/2, variance 1/12; five standard errors of 3000 draws.
    assert np.abs(unit.mean(axis=0) - 0.5).max() < 5 * np.sqrt(1 / 12 / 3000)
    assert np.abs(unit.var(axis=0) * 12 - 1).max() < 0.1
    correlations = np.corrcoef(unit.T) - np.eye(unit.shape[1])
    assert np.abs(correlations).max() < 0.1


def test_equal_seeds_draw_equal_values_with_and_without_the_attributes_of_servos():
    some = Randomisation(**{name: _RANGES[name] for name in _RANGES.keys() - OF_SERVOS.keys()})
    plants = [
        drawn.draw(np.random.default_rng(2), PAPER_TPM)
        for drawn in (some, replace(some, **OF_SERVOS))
    ]
    assert plants[0] == replace(plants[1], servo_stiffness=(1.0,) * 3, joint_friction=(0.0,) * 3)


def test_a_machine_without_deviations_is_the_nominal_one_to_the_last_bit():
    prints = set()
    for option in (None, {"link_mass": (1.0, 1.0), "encoder_noise": 0}, Randomisation()):
        env = TPMEnv("pick_and_place", randomisation=option)
        prints.add(fingerprint(random_episode(env, 0, 25)) + fingerprint(random_episode(env, 1, 5)))
    assert len(prints) == 1


@pytest.mark.parametrize(
    "wrong",
    [
        {"link_masses": (1.0, -1.0)},
        {"block_mass": math.nan},
        {"friction": "rough"},
        {"motor_strength": (1.0, 1.0)},
        {"joint_friction": 0.5},
        {"encoder_bias": (0.0, math.inf, 0.0)},
    ],
)
def test_a_plant_that_no_robot_can_have_is_refused(wrong):
    (name,) = wrong
    with pytest.raises(ConfigurationError, match=name):
        Plant(**wrong)


# -- masses ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [0.1, 1.0, 10.0])
def test_the_block_weighs_what_it_should_and_a_force_accelerates_it_accordingly(simulation, factor):
    mass = factor * Block().mass
    rest(simulation, Plant(block_mass=factor))
    client, (block,) = simulation.engine.client, simulation.engine.bodies
    weight = sum(contact[9] for contact in client.getContactPoints(block))
    assert weight == pytest.approx(mass * GRAVITY, rel=1e-2)
    simulation.reset(THETA, {"object": (0.05, -0.03, 0.3)}, plant=Plant(block_mass=factor))
    force, steps = (0.3, 0.0, 2.0), 5
    for _ in range(steps):
        centre = client.getBasePositionAndOrientation(block)[0]
        client.applyExternalForce(block, -1, force, centre, client.WORLD_FRAME)
        client.stepSimulation()
    velocity = client.getBaseVelocity(block)[0]
    gained = (
        steps * simulation.engine.physics.time_step * (np.array(force) / mass - (0, 0, GRAVITY))
    )
    np.testing.assert_allclose(velocity, gained, rtol=1e-6)


# -- encoders --------------------------------------------------------------------------------------


def test_noise_is_in_what_the_encoders_say_and_not_in_the_truth():
    size, seen, said = 2e-4, [], []
    env, quiet = TPMEnv("reach", randomisation={"encoder_noise": size}), TPMEnv("reach")
    env.reset(seed=0)
    quiet.reset(seed=0)
    action, before = np.array([0.1, 0.05, -0.1]), env.state.theta - quiet.state.theta
    assert before.all()
    assert not env.state.theta_dot.any()  # the encoders were read once
    for step in range(400):
        turned = action * np.sign(np.sin(step / 7))
        observation = env.step(turned)[0]
        quiet.step(turned)
        state, true = env.state, quiet.state
        assert np.array_equal(state.platform_position, true.platform_position)
        error = state.theta - true.theta
        seen.append(error)
        said.append(state.fk_position - true.fk_position)
        # All that is observed follows from the same disturbed angles.
        position = MOUNT.to_world(kinematics.forward(state.theta))
        np.testing.assert_allclose(state.fk_position, position, atol=1e-12)
        np.testing.assert_allclose(observation["achieved_goal"], position, atol=1e-7)
        rates = true.theta_dot + (error - before) / 0.04
        np.testing.assert_allclose(state.theta_dot, rates, atol=1e-9)
        before = error
    gains = np.linalg.norm(PAPER_TPM.evaluate(tuple(true.theta)).jacobian, axis=1)
    errors = np.array(seen)
    # Five standard errors of 1200 and 400 draws.
    assert errors.std() == pytest.approx(size, rel=5 / np.sqrt(2 * errors.size))
    assert np.abs(errors.mean(axis=0)).max() < 5 * size / np.sqrt(len(errors))
    lagged = (errors[1:] * errors[:-1]).mean(axis=0) / size**2
    assert np.abs(lagged).max() < 5 / np.sqrt(len(errors))
    assert np.abs(np.corrcoef(errors.T) - np.eye(3)).max() < 5 / np.sqrt(len(errors))
    np.testing.assert_allclose(np.std(said, axis=0), size * gains, rtol=0.3)


def test_a_bias_moves_the_platform_by_minus_j_bias_and_the_encoders_do_not_know(simulation):
    bias = tuple((2e-4 * np.sign(J[1])).tolist())  # the worst for y
    true = rest(simulation, NOMINAL)
    started = simulation.reset(THETA, ON_TABLE, plant=Plant(encoder_bias=bias))
    biased = rest(simulation, Plant(encoder_bias=bias))
    assert started.closure_error < 1e-6
    for state in (started, biased):
        np.testing.assert_allclose(state.theta, THETA, atol=1e-6)
        np.testing.assert_allclose(state.fk_position, true.fk_position, atol=2e-5)
        moved = MOUNT.rotate(state.platform_position - true.platform_position)
        expected = -J @ bias
        np.testing.assert_allclose(moved, expected, rtol=0.05, atol=2e-5)
        assert np.linalg.norm(moved) > 3e-4


def test_angles_that_cannot_be_assembled_leave_the_last_reading_in_place(simulation):
    good = simulation.reset(THETA)
    impossible = (3.0, 3.0, 3.0)
    assert np.isnan(PAPER_TPM.forward(np.add(THETA, impossible))).all()
    state = simulation.move(HOME, noise=impossible)
    np.testing.assert_allclose(state.theta, good.theta + impossible, atol=1e-6)
    assert np.array_equal(state.fk_position, good.fk_position)
    assert state.conditioning == good.conditioning
    assert not state.passed_singularity
    state = simulation.move(HOME)
    np.testing.assert_allclose(state.fk_position, state.platform_position, atol=1e-5)
    simulation.reset(PAPER_TPM.inverse(np.add(HOME, (0.1, 0.0, 0.0))))
    state = simulation.reset(THETA, noise=impossible)  # before the first reading: where it was put
    assert np.array_equal(state.fk_position, good.fk_position)
    assert state.conditioning == good.conditioning


# -- latency ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [1, 3])
def test_an_action_comes_late_by_so_many_steps_the_vacuum_too(steps):
    prompt = TPMEnv("pick_and_place")
    late = TPMEnv("pick_and_place", randomisation=Randomisation(latency=steps))
    actions = np.random.default_rng(6).uniform(-1, 1, (12, 4))
    for _ in range(2):  # a reset forgets what was on its way
        first, _ = prompt.reset(seed=7)
        late.reset(seed=7)
        nothing = [np.zeros(4)] * steps
        expected = [prompt.step(action)[0] for action in [*nothing, *actions]]
        found = [late.step(action)[0] for action in [*actions, *nothing]]
        for name in first:
            for one, other in zip(expected, found, strict=True):
                assert np.array_equal(one[name], other[name])
    late.reset(seed=7)
    with patch.object(late.simulation, "move", wraps=late.simulation.move) as move:
        for vacuum in (1.0, -1.0, 1.0, 1.0):
            late.step(np.array([0.0, 0.0, 0.0, vacuum]))
    sucked = [bool(call.args[1][0]) for call in move.call_args_list]
    assert sucked == [*[False] * steps, True, False, True, True][:4]


# -- lengths ---------------------------------------------------------------------------------------

ERRORS = (3e-4, -2e-4, 4e-4, -5e-4, 2e-4, 1e-4, -3e-4)


def lengths(errors: FloatArray) -> Geometry:
    return Geometry(*(np.array(list(vars(PAPER).values())) + errors))


def test_with_other_lengths_the_truth_is_elsewhere_by_what_first_order_predicts(simulation):
    plant = Plant(length_errors=ERRORS)
    started = simulation.reset(THETA, ON_TABLE, plant=plant)
    settled = rest(simulation, plant)

    def moved(errors):
        return kinematics.forward(THETA, geometry=lengths(errors))

    per_length = [(moved(step) - moved(-step)) / 2e-6 for step in 1e-6 * np.eye(7)]
    predicted = np.array(ERRORS) @ per_length
    assert started.closure_error < 1e-6
    assert settled.closure_error < 0.05e-3
    assert settled.platform_tilt < 1e-5
    for state in (started, settled):
        # Forward kinematics believe in the nominal lengths ...
        np.testing.assert_allclose(MOUNT.to_paper(state.fk_position), HOME, atol=2e-5)
        # ... and the platform is where the true ones put it.
        truth = kinematics.forward(state.theta, geometry=lengths(np.array(ERRORS)))
        found = MOUNT.to_paper(state.platform_position)
        np.testing.assert_allclose(found, truth, atol=2e-5)
        np.testing.assert_allclose(found - HOME, predicted, rtol=0.1, atol=5e-5)
    assert np.linalg.norm(predicted) > 5e-4


def test_with_other_lengths_the_loops_stay_closed_at_full_speed_and_every_reset_redraws():
    env = TPMEnv("reach", randomisation={"length_error": 5e-4})
    seen = set()
    for seed in range(4):
        for index, (_, _, info) in enumerate(random_episode(env, seed, steps=25)):
            state = env.state
            assert info["closure_error"] < 0.1e-3
            if index == 0:
                errors = info["randomisation"]["length_errors"]
                true = lengths(np.array(errors))
            where = MOUNT.to_world(kinematics.forward(state.theta, geometry=true))
            off = np.linalg.norm(where - state.platform_position)
            assert off < (1e-6 if index == 0 else 0.15e-3)
        seen.add(errors)
    assert len(seen) == 4


def test_a_robot_built_anew_stands_in_the_same_world(simulation):
    settings = simulation.engine.client.getPhysicsEngineParameters()
    bodies = simulation.engine.client.getNumBodies()
    falls = []
    for plant in (NOMINAL, Plant(length_errors=ERRORS), NOMINAL):
        simulation.reset(THETA, {"object": (0.2, -0.02, 0.5)}, plant=plant)
        client = simulation.engine.client  # perhaps another one now
        assert client.getPhysicsEngineParameters() == settings
        assert (client.getNumConstraints(), client.getNumBodies()) == (4, bodies)
        falls.append([simulation.move(HOME).object_position[0, 2] for _ in range(15)])
    assert falls[0] == falls[1] == falls[2]
    assert falls[0][0] < 0.5 - 0.007


@pytest.mark.parametrize("bias", [0.0, _SIZES["encoder_bias"]])
def test_the_arm_at_home_stands_on_its_own_side_at_every_corner_of_the_ranges(bias):
    error = _SIZES["length_error"]
    for signs in itertools.product((-1, 1), repeat=10):
        theta = np.array(THETA) - bias * np.array(signs[:3])
        position = kinematics.forward(theta, geometry=lengths(error * np.array(signs[3:])))
        assert position[1] > 0.005


# -- all together ----------------------------------------------------------------------------------

EXTREMES: list[dict[str, Any]] = [
    *({name: end} for name, ends in _RANGES.items() for end in ends),
    *({name: largest} for name, largest in _SIZES.items()),
    {"link_mass": _RANGES["link_mass"][1], "motor_strength": _RANGES["motor_strength"][0]},
    {**_RANGES, **_SIZES, "latency": 5},
    {name: end for name, end in (_RANGES | _SIZES).items() if name not in OF_SERVOS},
]


@pytest.mark.parametrize("option", EXTREMES)
@pytest.mark.parametrize(
    "seeds", [range(1), pytest.param(range(100, 140), marks=pytest.mark.slow)], ids=len
)
def test_at_the_ends_of_the_ranges_nothing_is_lost_or_it_is_reported(option, seeds):
    drive = "servo" if option.keys() & OF_SERVOS.keys() else "ideal"
    env = TPMEnv("pick_and_place", drive=drive, randomisation=option)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        env.reset(seed=seed)
        for _ in range(50):
            action = rng.choice([-1.0, 0.0, 1.0], 4)
            observation, reward, _, truncated, info = env.step(action)
            assert env.observation_space.contains(observation)
            assert np.isfinite(reward)
            assert info["closure_error"] < 2e-3
            if truncated:
                assert info["assembly_mode_changed"] != info["working_mode_changed"]
                break
