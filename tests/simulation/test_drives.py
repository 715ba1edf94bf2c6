"""Servo drives: stated stiffness, honest time steps, limits that bite, and what they carry."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, replace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from alone import Alone, motors
from episodes import expert_episode, random_episode
from inside import around_each_step, push
from machines import anywhere, each_machine

from tpm_gym import TPMEnv
from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism import PAPER_TPM, Machine, parts
from tpm_gym.mechanism.motor import TORQUE_MOTOR
from tpm_gym.simulation import Plant, Scene, Servo
from tpm_gym.simulation.compiled import limited
from tpm_gym.simulation.drives import References, ServoDrives, drive_of
from tpm_gym.simulation.settings import count_steps
from tpm_gym.simulation.state import CONTROL_PERIOD

HOME = PAPER_TPM.home
THETA = PAPER_TPM.inverse(HOME)
REST = (0.0, 0.0, 0.0)
GRAVITY = PAPER_TPM.dynamics.gravity(THETA)
HELD = Servo(feedforward="gravity")


def simulation_of(servo: Servo | None, machine: Machine = PAPER_TPM, **physics: Any) -> Alone:
    return Alone(Scene(), machine=machine, drive=servo, physics=physics)


def watched(simulation: Alone) -> list[tuple[Any, Vector]]:
    """Of every time step from now on: motors at its end, and their rates at its beginning."""
    seen: list[tuple[Any, Vector]] = []
    before: list[Vector] = []
    around_each_step(
        simulation,
        before=lambda: before.append(motors(simulation).theta_dot),
        after=lambda: seen.append((motors(simulation), before[-1])),
    )
    return seen


def hold(simulation: Alone, theta: FloatArray, torque: Vector = REST, periods: int = 1) -> None:
    """Let the servos' references jump to theta and stay there for some control periods."""
    engine: Any = simulation.engine
    steps = count_steps(CONTROL_PERIOD, engine.time_step)
    constant = References(*(np.tile(v, (steps, 1, 1)) for v in (theta, np.zeros(3), torque)))
    with patch.object(engine._drives, "references", lambda path: constant):
        for _ in range(periods):
            engine.advance(None, [False])


# -- options ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "name"),
    [
        ("stiff", "drive"),
        (7500.0, "drive"),
        ({"gain": 1.0}, "drive"),
        ({"stiffness": 0.0}, "stiffness"),
        ({"stiffness": "high"}, "stiffness"),
        ({"stiffness": 10**400}, "stiffness"),
        ({"stiffness": 1e300}, "stiffness"),  # its law overflows
        ({"damping": 1e13}, "damping"),
        ({"damping": -1.0}, "damping"),
        ({"damping": float("nan")}, "damping"),
        ({"feedforward": "full"}, "feedforward"),
        ({"feedforward": ["none"]}, "feedforward"),
    ],
)
def test_what_is_no_drive_is_refused_by_name(value, name):
    with pytest.raises(ConfigurationError) as caught:
        TPMEnv(drive=value)
    assert caught.value.name == name


def test_a_drive_has_many_names():
    for value, drive in (
        (None, None),
        ("ideal", None),
        ("servo", Servo()),
        (HELD, HELD),
        ({"feedforward": "gravity"}, HELD),
    ):
        assert drive_of(value) == drive
    with closing(TPMEnv(drive=asdict(HELD))) as env:
        assert env.drive == env.simulation.drive == HELD


@pytest.mark.parametrize(("name", "value"), [("servo_stiffness", 0.5), ("joint_friction", (0, 1))])
def test_ideal_drives_refuse_what_only_servos_have_and_say_so(name, value):
    with pytest.raises(ConfigurationError, match="drive='servo'") as caught:
        TPMEnv(randomisation={name: value})
    assert caught.value.name == name
    with closing(simulation_of(None)) as simulation:
        plant = Plant(**{name: (0.5, 0.5, 0.5)})
        with pytest.raises(ConfigurationError, match="drive='servo'") as caught:
            simulation.reset(THETA, plant=plant)
        assert caught.value.name == name
        assert simulation.reset(THETA).theta == pytest.approx(THETA)  # and is as it was


# -- the law ---------------------------------------------------------------------------------------


@each_machine
@pytest.mark.parametrize("force", [(20.0, 0.0, 0.0), (0.0, 3.0, 0.0), (-5.0, 2.0, 15.0)])
def test_any_load_turns_a_motor_by_torque_over_stiffness(machine, force):
    # Also a load that is in no model, and after time steps in which the law cannot know it.
    simulation, home = simulation_of(HELD, machine), machine.inverse(machine.home)
    simulation.reset(home)
    world = machine.mount.rotate(force)
    with around_each_step(simulation, before=lambda: push(simulation, world)):
        for _ in range(25):
            state = simulation.move(machine.home)
    rows = machine.evaluate(state.theta).jacobian
    turned = HELD.stiffness * (state.theta - home)
    np.testing.assert_allclose(turned, rows.T @ force, rtol=0.02, atol=0.01)


@pytest.mark.parametrize("feedforward", ["none", "gravity", "computed"])
def test_what_is_fed_forward_need_not_turn_the_motors(feedforward):
    servo = Servo(feedforward=feedforward)
    simulation = simulation_of(servo)
    simulation.reset(THETA)
    for _ in range(25):
        state = simulation.move(HOME)
    sagged = GRAVITY if feedforward == "none" else np.zeros(3)
    np.testing.assert_allclose(servo.stiffness * (THETA - state.theta), sagged, atol=0.03)
    np.testing.assert_allclose(state.torque, GRAVITY, atol=0.03)


def step_response(servo: Servo, substeps: int) -> tuple[FloatArray, FloatArray]:
    """Angles (control periods * substeps, 3) after the references jump by a little; what theory
    says: Euler's backward method on M x'' + D x' + K x = 0."""
    step, jump = CONTROL_PERIOD / substeps, np.array((2e-4, -1e-4, 1e-4))
    simulation = simulation_of(servo, time_step=step)
    simulation.reset(THETA)
    for _ in range(10):
        start = np.array(simulation.move(HOME).theta)
    seen = watched(simulation)
    hold(simulation, start + jump, GRAVITY, periods=3)
    found = np.array([motors.theta for motors, _ in seen]) - start
    mass, x, v, expected = PAPER_TPM.dynamics.mass_matrix(THETA), -jump, np.zeros(3), []
    stiff, damping = servo.stiffness * np.eye(3), servo.damping * np.eye(3)
    for _ in seen:
        v = np.linalg.solve(mass + step * damping + step**2 * stiff, mass @ v - step * stiff @ x)
        x = x + step * v
        expected.append(x + jump)
    return found, np.array(expected)


@pytest.mark.parametrize("substeps", [10, 40])
@pytest.mark.parametrize("servo", [HELD, Servo(30_000.0, 60.0, "gravity")])
def test_motion_is_that_of_springs_and_dampers_integrated_by_eulers_backward_method(
    servo, substeps
):
    found, expected = step_response(servo, substeps)
    assert np.abs(expected).max() > 1.5e-4
    np.testing.assert_allclose(found, expected, atol=2e-6)  # 0.02 of the smallest jump


@pytest.mark.parametrize("masses", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("stiffness", [1e3, 1e5, 1e7])
def test_it_is_stable_at_any_stiffness_and_mass(stiffness, masses):
    simulation = simulation_of(Servo(stiffness, 60.0))
    links = len(PAPER_TPM.mechanism.links) - 1
    simulation.reset(THETA, plant=Plant(link_masses=(*[masses] * (links - 1), max(masses, 1.0))))
    for share in (0.2, 0.4, 0.6, 0.8, *[1.0] * 25):
        command = (HOME[0] + 0.05 * share, HOME[1] + 0.01 * share, HOME[2] + 0.05 * share)
        state = simulation.move(command)
    np.testing.assert_allclose(state.theta_dot, 0, atol=2e-3)
    # What is fed forward is the nominal machine's, and off by its weight at most.
    np.testing.assert_allclose(state.theta, PAPER_TPM.inverse(command), atol=10 / stiffness)


def test_the_law_uses_each_robots_own_lengths_and_home_where_no_assembly_exists():
    drives, plant = ServoDrives(Servo(), PAPER_TPM, 3, 0.004), Plant(length_errors=(1e-3,) * 7)
    theta = np.array([THETA, np.add(THETA, 3.0), THETA])
    drives.alter(np.array([2]), [plant])
    drives.begin(theta)
    drives.rest(np.array([2]), theta[2:])
    (home, nowhere, longer), dynamics = drives.law[2], plant.of(PAPER_TPM).dynamics
    np.testing.assert_allclose(home, PAPER_TPM.dynamics.mass_matrix(THETA))
    np.testing.assert_array_equal(nowhere, home)
    np.testing.assert_allclose(longer, dynamics.mass_matrix(THETA))
    np.testing.assert_allclose(drives.memory[0, 2], dynamics.gravity(THETA))


def test_springs_and_dampers_give_nothing_that_was_not_put_in():
    servo, dynamics = Servo(feedforward="none"), PAPER_TPM.dynamics
    simulation = simulation_of(servo)
    simulation.reset(THETA)
    seen = watched(simulation)
    goal = PAPER_TPM.inverse(np.add(HOME, (0.02, 0.0, 0.02)))
    hold(simulation, goal, periods=6)
    motions = [(np.array(motors.theta), np.array(motors.theta_dot)) for motors, _ in seen]
    energies = [sum(dynamics.energy(*motion)) for motion in motions]
    sprung = [servo.stiffness * np.sum((theta - goal) ** 2) / 2 for theta, _ in motions]
    total = np.array(energies) + sprung
    assert total[0] - total[-1] > 0.1  # J
    assert np.diff(total).max() < 1e-3 * (total[0] - total[-1])


def test_the_defaults_are_a_good_direct_drives_on_the_lightest_motion():
    # Lightest motions of 2000 postures all over the region: 0.097 to 0.125 kg m^2.
    for point in anywhere(PAPER_TPM, 50):
        lightest = np.linalg.eigvalsh(PAPER_TPM.dynamics.mass_matrix(PAPER_TPM.inverse(point)))[0]
        speed = np.sqrt(Servo().stiffness / lightest)  # rad/s
        assert 30 < speed / (2 * np.pi) < 60  # Hz
        assert 0.9 < Servo().damping / (2 * speed * lightest) < 1.2


def test_the_datasheet_tells_the_defaults():
    text = " ".join((TPMEnv.__doc__ or "").split())
    assert f"{Servo().stiffness:g} N m/rad, {Servo().damping:g} N m s/rad" in text
    assert f"{TORQUE_MOTOR.peak_torque:g} N m up to {TORQUE_MOTOR.corner_speed:g} rad/s" in text
    assert f"zero at {TORQUE_MOTOR.no_load_speed:g} rad/s" in text


# -- limits ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize(
    ("speed", "share"),
    [(0.0, 1.0), (15.0, 1.0), (20.0, 0.5), (24.0, 0.1), (25.0, 0.0), (40.0, 0.0),
     (-5.0, 1.0), (-20.0, 1.0), (-40.0, 1.0)],
)  # fmt: skip
def test_torque_falls_from_the_corner_to_the_no_load_speed_and_brakes_in_full(speed, share, sign):
    for effort in (100.0, 50.0):  # a weak motor's line starts lower
        line = effort, 15.0, 25.0  # N m, rad/s
        given = limited(sign * 1e3, sign * speed, *line)
        assert given == pytest.approx(sign * share * effort)
        assert limited(sign * 0.01, sign * speed, *line) == min(0.01, share * effort) * sign


def over_the_line(seen: list[tuple[Any, Vector]], motor: Any) -> list[float]:
    """By how much torque each motor was beyond its line in each time step, N m."""
    line = motor.peak_torque, motor.corner_speed, motor.no_load_speed
    return [
        abs(torque - limited(torque, rate, *line))
        for motors, rates in seen
        for torque, rate in zip(motors.torque, rates, strict=True)
    ]


@pytest.mark.parametrize(("drive", "beyond"), [(None, True), (Servo(), False)])
def test_a_slow_motor_keeps_to_its_line(drive, beyond, monkeypatch):
    # At 1 rad/s the corner, at 2 no torque is left; actions go up to 3 rad/s.
    slow = replace(TORQUE_MOTOR, no_load_speed=2.0, motor_constant=10.0)
    monkeypatch.setattr(parts, "TORQUE_MOTOR", slow)
    machine = replace(PAPER_TPM, name="slow")
    simulation = simulation_of(drive, machine)
    simulation.reset(THETA)
    seen = watched(simulation)
    for shift in (0.03, 0.06, 0.09, 0.12, 0.12, 0.12):  # m, upwards, well away from y = 0
        simulation.move((HOME[0], HOME[1] + 0.01, HOME[2] - shift))
    over = over_the_line(seen, slow)
    assert (max(over) > 1.0) == beyond
    assert beyond or max(over) < 1e-9


def test_motors_whose_torque_falls_from_below_zero_speed_are_refused(monkeypatch):
    monkeypatch.setattr(parts, "TORQUE_MOTOR", replace(TORQUE_MOTOR, motor_constant=1.0))
    with pytest.raises(ConfigurationError, match="corner speed is below their speed"):
        simulation_of(Servo(), replace(PAPER_TPM, name="weak"))


# -- friction, stiffness ---------------------------------------------------------------------------


def test_friction_holds_up_to_its_torque_and_slows_by_it():
    friction, way = 2.0, [(HOME[0] + 0.004 * k, HOME[1], HOME[2]) for k in range(12)]
    torques = []
    for plant in (Plant(), Plant(joint_friction=(friction,) * 3)):
        simulation = simulation_of(Servo())
        simulation.reset(THETA, plant=plant)
        states = [simulation.move(command) for command in way]
        torques.append(states[-1].torque)
    np.testing.assert_allclose(
        torques[1] - torques[0], friction * np.sign(states[-1].theta_dot), rtol=0.03
    )
    simulation.reset(THETA, plant=plant)
    held = [simulation.move((HOME[0], HOME[1], HOME[2] + 5e-5)) for _ in range(12)][-1]
    wanted = np.array(PAPER_TPM.inverse((HOME[0], HOME[1], HOME[2] + 5e-5)))
    assert np.abs(Servo().stiffness * (wanted - THETA)).max() < friction
    np.testing.assert_allclose(held.theta, THETA, atol=1e-6)  # it sticks


def test_stiffness_is_each_drives_own():
    factors = np.array((0.5, 1.0, 4.0))
    simulation = simulation_of(Servo(feedforward="none"))
    simulation.reset(THETA, plant=Plant(servo_stiffness=tuple(factors.tolist())))
    for _ in range(25):
        state = simulation.move(HOME)
    np.testing.assert_allclose(
        7500.0 * factors * (THETA - state.theta), GRAVITY, rtol=0.02, atol=0.01
    )


# -- in the environment ----------------------------------------------------------------------------


def played(drive: Any, scripted: bool) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Tracking errors (rad) and torques (N m) of all time steps of a few episodes."""
    with closing(TPMEnv("reach", drive=drive)) as env:
        env.reset(seed=0)
        engine = env.simulation.engine
        advance, wanted = engine.advance, []

        def noted(path, vacuum):
            wanted.extend(path.joints()[0])
            advance(path, vacuum)

        engine.advance = noted
        seen = watched(env.simulation)
        for seed in range(5):
            play = expert_episode if scripted else random_episode
            *_, (_, _, info) = play(env, seed)
            assert info["is_success"] or not scripted
            assert not info["assembly_mode_changed"]
        yield (
            np.abs(np.subtract([motors.theta for motors, _ in seen], wanted)),
            np.abs([motors.torque for motors, _ in seen]),
        )


@pytest.mark.parametrize("scripted", [True, False], ids=["expert", "random"])
def test_tracking_and_effort(scripted):
    # Of 40 episodes: 0.15 mrad and 10 N m (expert), 0.7 mrad and 43 N m (random).
    ((exact, ideal),) = played("ideal", scripted)
    ((errors, effort),) = played("servo", scripted)
    assert exact.max() < 1e-8
    assert 1e-5 < errors.max() < (3e-4 if scripted else 1.5e-3)
    largest = 0.12 if scripted else 0.5  # of the peak: half is what the weakest motors have
    assert max(ideal.max(), effort.max()) < largest * TORQUE_MOTOR.peak_torque
