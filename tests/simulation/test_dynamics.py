"""The simulated mechanism against theory: statics, inertia, energy, rates, and its limits.

Theory is the closed-form dynamics, which tests/mechanism compares with Pinocchio. What was measured
is in the comments.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from alone import Alone, jumping, motors
from inside import around_each_step, push, slide
from machines import anywhere, each_machine, excursions
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.mechanism import PAPER_TPM, Machine
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.motor import TORQUE_MOTOR
from tpm_gym.simulation import Plant, Scene, Servo

G = 9.81
HOME = PAPER_TPM.home
THETA = PAPER_TPM.inverse(HOME)
FORCES = [*(20 * np.eye(3)).tolist(), [10, -20, 15]]  # N, machine's frame


# Theory


def weights(machine, theta: Vector, factors: Vector = ()) -> FloatArray:
    """Torques (3,) N m that carry the links, whose masses are multiplied by the factors."""
    return replace(machine.dynamics, link_masses=factors).gravity(theta)


# The engine

each_engine = pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
NO_TORQUE = Plant(motor_strength=(0.0, 0.0, 0.0))


def settle(simulation: Alone, point: ArrayLike, periods: int = 3) -> None:
    for _ in range(periods):
        simulation.move(point)


def total_energy(simulation: Alone) -> tuple[float, float]:
    """Kinetic and potential energy (J) from what the engine says of each link."""
    client, at = simulation.engine.client, simulation.engine.robot.links
    kinetic = potential = 0.0
    for link in simulation.machine.mechanism.links[1:]:
        centre, _, _, _, _, turn, velocity, spin = client.getLinkState(
            *at[link.name], computeLinkVelocity=True, computeForwardKinematics=True
        )
        rotation = np.reshape(client.getMatrixFromQuaternion(turn), (3, 3))
        local = rotation.T @ spin
        kinetic += (link.mass * np.dot(velocity, velocity) + local @ link.inertia @ local) / 2
        potential += link.mass * G * centre[2]
    return kinetic, potential


# Forces at rest


@pytest.mark.parametrize(
    ("engine", "bound"),  # measured: 7e-9 of the largest of the three in PyBullet
    [("pybullet", 1e-6), ("mujoco", 1e-4), ("analytic", 1e-6)],
)
@each_machine
def test_torques_at_rest_carry_the_links(machine, engine, bound):
    simulation, rng = Alone(Scene(), engine=engine, machine=machine), np.random.default_rng(1)
    for index, point in enumerate(anywhere(machine, 10)):
        theta, factors = machine.inverse(point), ()
        if index % 3 != 2:  # a reset takes it back
            factors = tuple(rng.uniform(0.5, 2.0, len(machine.mechanism.links) - 1).tolist())
        assert not simulation.reset(theta, plant=Plant(link_masses=factors)).torque.any()
        settle(simulation, point)
        expected = weights(machine, theta, factors)
        error = np.abs(simulation.read().torque - expected).max()
        assert error < bound * np.abs(expected).max()


@pytest.mark.parametrize(
    ("engine", "bound"),  # measured: 4e-7 of the largest of the three in PyBullet
    [("pybullet", 1e-5), ("mujoco", 3e-3)],
)
@each_machine
def test_a_force_on_the_platform_loads_the_motors_by_the_jacobian(machine, engine, bound):
    simulation, force = Alone(Scene(), engine=engine, machine=machine), np.zeros(3)
    with around_each_step(simulation, before=lambda: push(simulation, machine.mount.rotate(force))):
        for point in anywhere(machine, 6, seed=2):
            theta = machine.inverse(point)
            simulation.reset(theta)
            settle(simulation, point)
            alone = motors(simulation).torque
            for value in FORCES:
                force[:] = value
                settle(simulation, point, 2)
                expected = -machine.evaluate(theta).jacobian.T @ force
                change = motors(simulation).torque - alone
                assert np.abs(change - expected).max() < bound * np.abs(expected).max()
            force[:] = 0


# Motion


@each_engine
def test_ideal_motors_are_where_they_shall_be_at_the_end_of_every_time_step(engine):
    simulation, before = Alone(Scene(), engine=engine), THETA
    simulation.reset(THETA)
    for share in (1 - np.cos(np.linspace(0, np.pi, 100))) / 2:
        theta = PAPER_TPM.inverse(np.add(HOME, share * np.array((-0.10, 0.010, 0.05))))
        simulation.engine.advance(jumping(theta), [False])
        found = motors(simulation)
        np.testing.assert_allclose(found.theta, theta, atol=2e-6)
        rates = np.subtract(theta, before) / simulation.engine.time_step
        np.testing.assert_allclose(found.theta_dot, rates, atol=1e-3)
        before = theta


@each_engine
@each_machine
def test_released_it_accelerates_by_its_mass_matrix(machine, engine):
    # Measured in PyBullet: 1e-5, and 3e-5 at y = 13 mm where M has rows 100 times as large as
    # others; in MuJoCo, whose loops yield, 1.4e-2.
    bound = 1e-3 if engine == "pybullet" else 2e-2
    simulation, force = Alone(Scene(), engine=engine, machine=machine), np.zeros(3)
    with around_each_step(simulation, before=lambda: push(simulation, machine.mount.rotate(force))):
        for point in anywhere(machine, 6):
            theta = machine.inverse(point)
            mass, load = machine.dynamics.mass_matrix(theta), weights(machine, theta)
            j = machine.evaluate(theta).jacobian
            for force[:] in ([0, 0, 0], *FORCES):
                simulation.reset(theta, plant=NO_TORQUE)
                simulation.engine.advance(jumping(theta), [False])
                rates = np.array(motors(simulation).theta_dot)
                expected = np.linalg.solve(mass, j.T @ force - load) * simulation.engine.time_step
                assert np.abs(rates - expected).max() < bound * np.abs(expected).max()


def lost_in_free_fall(point: Vector, time_step: float) -> float:
    """Energy lost in 0.2 s without motors, as a share of the kinetic energy gained."""
    simulation = Alone(Scene(), physics={"time_step": time_step})
    theta = PAPER_TPM.inverse(point)
    simulation.reset(theta, plant=NO_TORQUE)
    start = sum(total_energy(simulation))
    for _ in range(round(0.2 / time_step)):
        simulation.engine.advance(jumping(theta), [False])
        # The spring of the cup does no work, and nothing is touched.
        assert abs(slide(simulation)) < 1e-9
    kinetic, potential = total_energy(simulation)
    assert simulation.read().platform_position[2] > CUP.length + 0.01
    return (start - kinetic - potential) / kinetic


@pytest.mark.parametrize("point", [(-0.04, 0.028, 0.67), (0.03, 0.04, 0.68), (-0.12, 0.02, 0.67)])
def test_energy_is_conserved_up_to_the_integrator(point):
    # Measured: 2.6 to 2.9 % at 250 Hz and half of that at each half of the time step: first order,
    # so it is the integrator's (semi-implicit Euler), and vanishes with the time step.
    lost = [lost_in_free_fall(point, 1 / rate) for rate in (250, 500, 1000)]
    assert 0 < lost[0] < 0.032
    np.testing.assert_allclose(np.divide(lost[:-1], lost[1:]), 2, rtol=0.05)


def errors_of_velocity(time_step: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """At full speed: platform's speed, what J misses of its velocity, what differences miss."""
    simulation = Alone(Scene(), physics={"time_step": time_step})
    engine = simulation.engine
    rows = []

    def note():
        theta, rates, _ = motors(simulation)
        state = engine.client.getLinkState(
            *engine.robot.links["platform"], computeLinkVelocity=True
        )
        assert np.abs(state[7]).max() < 1e-4  # rad/s: it does not turn
        by_rates = PAPER_TPM.mount.rotate(PAPER_TPM.evaluate(theta).jacobian @ rates)
        rows.append((by_rates, state[6], engine.robot.truth()[1]))

    around_each_step(simulation, after=note)
    simulation.reset(THETA)
    for command in excursions(PAPER_TPM, 60, seed=1):
        simulation.move(command)
    by_rates, velocity, position = np.swapaxes(rows, 0, 1)
    differences = np.diff(position, axis=0) / time_step
    return (
        np.linalg.norm(velocity, axis=1),
        np.linalg.norm(by_rates - velocity, axis=1),
        np.linalg.norm(differences - velocity[1:], axis=1),
    )


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.square(values).mean()))


def test_the_platform_moves_as_joint_rates_and_jacobian_say():
    # Measured at 250 Hz over 1000 steps: 0.5 % rms, 21 mm/s at worst (what the loops close again);
    # by differences of the position 0.25 % rms, 6 mm/s at worst. Both are first order.
    speed, by_rates, by_differences = errors_of_velocity(1 / 250)
    assert speed.max() > 0.75  # m/s, full speed along one axis
    assert rms(by_rates) < 0.01 * rms(speed)
    assert by_rates.max() < 0.03
    assert rms(by_differences) < 0.005 * rms(speed)
    assert by_differences.max() < 0.01
    _, *finer = errors_of_velocity(1 / 500)
    for coarse, fine in zip((by_rates, by_differences), finer, strict=True):
        assert rms(coarse) / rms(fine) == pytest.approx(2, rel=0.15)


def errors_of_torque(machine: Machine, rate: int, commands: list[FloatArray]) -> float:
    """What the closed form misses of the torques along commands, as a share of them, by rms."""
    simulation = Alone(Scene(), machine=machine, physics={"time_step": 1 / rate})
    simulation.reset(machine.inverse(tuple(commands[0])))
    settle(simulation, commands[0])
    rows: list[Any] = []
    around_each_step(simulation, after=lambda: rows.append(motors(simulation)))
    for command in commands:
        simulation.move(command)
    theta, rates, torque = np.swapaxes(rows, 0, 1)
    before = theta[:-1], rates[:-1], np.diff(rates, axis=0) * rate
    expected = np.array([machine.torque(*map(tuple, row)) for row in zip(*before, strict=True)])
    return rms(expected - torque[1:]) / rms(torque)


def all_over(machine: Machine, count: int) -> list[FloatArray]:
    """Smooth commands, through the goals' region and back."""
    low, high = np.array(machine.goal_region.low), np.array(machine.goal_region.high)
    turns = np.linspace(0, 2 * np.pi, count)[:, None] * (1, 2, 1) + (0, 1, 2)
    return list((low + high) / 2 + 0.4 * (high - low) * np.sin(turns))


@each_machine
def test_torques_of_a_motion_are_those_of_the_closed_form(machine):
    # Measured at 250 Hz: smooth 0.016 and 0.12 %, full speed back and forth 1.9 and 0.5 % of the
    # torques, and half of that at each half of the time step.
    smooth, fast = all_over(machine, 75), list(excursions(machine, 60, seed=1))
    for commands, bound in ((smooth, 0.002), (fast, 0.025)):
        errors = [errors_of_torque(machine, rate, commands) for rate in (250, 500)]
        assert errors[0] < bound
        assert errors[0] / errors[1] == pytest.approx(2, rel=0.1)


# Limits


@each_engine
@pytest.mark.parametrize("motor", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_motor_holds_its_effort_and_no_more(engine, motor, sign):
    simulation, strength = Alone(Scene(), engine=engine), (0.5, 0.75, 1.5)
    effort = TORQUE_MOTOR.peak_torque * np.array(strength)
    j, load, force = PAPER_TPM.evaluate(THETA).jacobian, weights(PAPER_TPM, THETA), np.zeros(3)
    rotate, moved = PAPER_TPM.mount.rotate, []
    with around_each_step(simulation, before=lambda: push(simulation, rotate(force))):
        for share in (0.99, 1.01):
            force[:] = 0
            simulation.reset(THETA, plant=Plant(motor_strength=strength))
            settle(simulation, HOME)
            wanted = np.zeros(3)
            wanted[motor] = sign * share * effort[motor]
            force[:] = np.linalg.solve(j.T, load - wanted)  # all on one motor, none on the others
            settle(simulation, HOME, 1)
            found = motors(simulation).torque
            moved.append(abs(motors(simulation).theta[motor] - THETA[motor]))
            if share < 1:
                np.testing.assert_allclose(found, wanted, atol=0.05)
            assert (np.abs(found) <= effort * (1 + 1e-9)).all()
    assert moved[0] < 1e-5
    assert moved[1] > 1e-5  # it gives way


each_drive = pytest.mark.parametrize("drive", [None, Servo()], ids=["ideal", "servo"])


@each_drive
@each_engine
def test_no_command_draws_more_than_the_motors_have(engine, drive):
    simulation, drawn = Alone(Scene(), engine=engine, drive=drive), list[FloatArray]()
    simulation.reset(THETA, plant=Plant(motor_strength=(0.5, 0.5, 0.5)))
    with around_each_step(simulation, after=lambda: drawn.append(motors(simulation).torque)):
        for jump in (-0.1, 0.1, -0.1, 0.1):  # m in a control period, three times an action's reach
            simulation.move(np.add(HOME, (0, 0, jump)))
    assert np.abs(drawn).max() == pytest.approx(0.5 * TORQUE_MOTOR.peak_torque, rel=1e-9)
