"""The simulated mechanism against theory: statics, inertia, energy, rates, and its limits.

Theory is the mechanism's data (masses, inertias, frames) moved along the closed form of the
kinematics, differentiated by central differences. What was measured is in the comments.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from alone import Alone, motors
from inside_bullet import around_each_step, push
from machines import anywhere, each_machine, excursions
from numpy.typing import ArrayLike
from walk import place, walk

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


def links(machine: Machine) -> Any:
    """Those that move."""
    return machine.mechanism.links[1:]


def centres(machine: Machine, theta: FloatArray) -> FloatArray:
    """Centres of mass (links, 3), world, m."""
    frames = walk(machine.mechanism, machine.joint_positions(tuple(theta)))
    return machine.mount.to_world([place(frames, k.name, k.centre_of_mass) for k in links(machine)])


def rotations(machine: Machine, theta: FloatArray) -> FloatArray:
    """Orientations (links, 3, 3) in the machine's frame."""
    frames = walk(machine.mechanism, machine.joint_positions(tuple(theta)))
    return np.array([frames[link.name][1] for link in links(machine)])


def slopes(function: Callable[..., FloatArray], machine: Machine, theta: Vector) -> FloatArray:
    """Derivatives by the three motors, stacked in front."""
    steps = 1e-5 * np.eye(3)
    pairs = [(function(machine, theta + by), function(machine, theta - by)) for by in steps]
    return np.array([(up - down) / 2e-5 for up, down in pairs])


def weights(machine: Machine, theta: Vector, factors: ArrayLike = 1.0) -> FloatArray:
    """Torques (3,) N m that carry the links: the gradient of their potential."""
    masses = np.array([link.mass for link in links(machine)]) * factors
    return np.asarray(G * slopes(centres, machine, theta)[..., 2] @ masses)


def mass_matrix(machine: Machine, theta: Vector) -> FloatArray:
    """Inertia (3, 3) kg m^2 that the motors feel: kinetic energy is theta_dot M theta_dot / 2."""
    velocity, rotation = slopes(centres, machine, theta), rotations(machine, np.array(theta))
    turned = np.swapaxes(rotation, -1, -2)
    spin = slopes(rotations, machine, theta) @ turned  # cross product matrices
    omega = np.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], axis=-1)
    moments = rotation @ np.array([k.inertia for k in links(machine)]) @ turned
    linear = np.einsum("ank,n,bnk->ab", velocity, [k.mass for k in links(machine)], velocity)
    return np.asarray(linear + np.einsum("ani,nij,bnj->ab", omega, moments, omega))


def jacobian(machine: Machine, theta: Vector) -> FloatArray:
    return np.array(machine.evaluate(theta).jacobian)


# The engine


def torques(simulation: Alone) -> FloatArray:
    return np.array(motors(simulation).torque)


def switch_motors_off(simulation: Alone) -> None:
    client, robot = simulation.engine.client, simulation.engine.robot
    for name in simulation.machine.mechanism.actuated:
        client.setJointMotorControl2(*robot.joints[name], client.VELOCITY_CONTROL, force=0)


def settle(simulation: Alone, point: ArrayLike, periods: int = 3) -> None:
    for _ in range(periods):
        simulation.move(point)


def total_energy(simulation: Alone) -> tuple[float, float]:
    """Kinetic and potential energy (J) from what the engine says of each link."""
    client, at = simulation.engine.client, simulation.engine.robot.links
    kinetic = potential = 0.0
    for link in links(simulation.machine):
        centre, _, _, _, _, turn, velocity, spin = client.getLinkState(
            *at[link.name], computeLinkVelocity=True, computeForwardKinematics=True
        )
        rotation = np.reshape(client.getMatrixFromQuaternion(turn), (3, 3))
        local = rotation.T @ spin
        kinetic += (link.mass * np.dot(velocity, velocity) + local @ link.inertia @ local) / 2
        potential += link.mass * G * centre[2]
    return kinetic, potential


# Forces at rest


@each_machine
@pytest.mark.parametrize(("low", "high"), [(1.0, 1.0), (0.5, 2.0)])
def test_torques_at_rest_carry_the_links(machine: Machine, low: float, high: float) -> None:
    # Measured: 7e-9 of the largest of the three.
    simulation, rng = Alone(Scene(), machine=machine), np.random.default_rng(1)
    for point in anywhere(machine, 10):
        theta, factors = machine.inverse(point), rng.uniform(low, high, len(links(machine)))
        plant = Plant(link_masses=tuple(factors.tolist())) if high > low else Plant()
        assert not simulation.reset(theta, plant=plant).torque.any()
        settle(simulation, point)
        expected = weights(machine, theta, factors)
        error = np.abs(simulation.read().torque - expected).max()
        assert error < 1e-6 * np.abs(expected).max()


@each_machine
def test_a_force_on_the_platform_loads_the_motors_by_the_jacobian(machine: Machine) -> None:
    # Measured: 4e-7 of the largest of the three.
    simulation, force = Alone(Scene(), machine=machine), np.zeros(3)
    around_each_step(simulation, before=lambda: push(simulation, force))
    for point in anywhere(machine, 6, seed=2):
        theta = machine.inverse(point)
        simulation.reset(theta)
        settle(simulation, point)
        alone = torques(simulation)
        for value in FORCES:
            force[:] = value
            settle(simulation, point, 2)
            expected = -jacobian(machine, theta).T @ force
            change = torques(simulation) - alone
            assert np.abs(change - expected).max() < 1e-5 * np.abs(expected).max()
        force[:] = 0


# Motion


@each_machine
def test_released_it_accelerates_by_its_mass_matrix(machine: Machine) -> None:
    # Measured: 1e-5, and 3e-5 at y = 13 mm where M has rows 100 times as large as others.
    simulation = Alone(Scene(), machine=machine)
    switch_motors_off(simulation)
    for point in anywhere(machine, 6):
        theta = machine.inverse(point)
        mass, load = mass_matrix(machine, theta), weights(machine, theta)
        j = jacobian(machine, theta)
        for force in ([0, 0, 0], *FORCES):
            simulation.reset(theta)
            push(simulation, force)
            simulation.engine.client.stepSimulation()
            rates = np.array(motors(simulation).theta_dot)
            time_step = simulation.engine.physics.time_step
            expected = np.linalg.solve(mass, j.T @ force - load) * time_step
            assert np.abs(rates - expected).max() < 1e-3 * np.abs(expected).max()


def lost_in_free_fall(point: Vector, time_step: float) -> float:
    """Energy lost in 0.2 s without motors, as a share of the kinetic energy gained."""
    simulation = Alone(Scene(), physics={"time_step": time_step})
    client, tool = simulation.engine.client, simulation.engine.robot.tool
    simulation.reset(PAPER_TPM.inverse(point))
    switch_motors_off(simulation)
    start = sum(total_energy(simulation))
    for _ in range(round(0.2 / time_step)):
        client.stepSimulation()
        # The spring of the cup does no work, and nothing is touched.
        assert abs(client.getJointState(*tool)[0]) < 1e-9
    kinetic, potential = total_energy(simulation)
    assert simulation.read().platform_position[2] > CUP.length + 0.01
    return (start - kinetic - potential) / kinetic


@pytest.mark.parametrize("point", [(-0.04, 0.028, 0.67), (0.03, 0.04, 0.68), (-0.12, 0.02, 0.67)])
def test_energy_is_conserved_up_to_the_integrator(point: Vector) -> None:
    # Measured: 2.6 to 2.9 % at 250 Hz and half of that at each half of the time step: first order,
    # so it is the integrator's (semi-implicit Euler), and vanishes with the time step.
    lost = [lost_in_free_fall(point, 1 / rate) for rate in (250, 500, 1000)]
    assert 0 < lost[0] < 0.032
    np.testing.assert_allclose(np.divide(lost[:-1], lost[1:]), 2, rtol=0.05)


def errors_of_velocity(time_step: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """At full speed: platform's speed, what J misses of its velocity, what differences miss."""
    simulation = Alone(Scene(), physics={"time_step": time_step})
    engine: Any = simulation.engine
    rows = []

    def note() -> None:
        theta, rates, _ = motors(simulation)
        state = engine.client.getLinkState(
            *engine.robot.links["platform"], computeLinkVelocity=True
        )
        assert np.abs(state[7]).max() < 1e-4  # rad/s: it does not turn
        by_rates = PAPER_TPM.mount.rotate(jacobian(PAPER_TPM, theta) @ rates)
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


def test_the_platform_moves_as_joint_rates_and_jacobian_say() -> None:
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
def test_torques_of_a_motion_are_those_of_the_closed_form(machine: Machine) -> None:
    # Measured at 250 Hz: smooth 0.016 and 0.12 %, full speed back and forth 1.9 and 0.5 % of the
    # torques, and half of that at each half of the time step.
    smooth, fast = all_over(machine, 75), list(excursions(machine, 60, seed=1))
    for commands, bound in ((smooth, 0.002), (fast, 0.025)):
        errors = [errors_of_torque(machine, rate, commands) for rate in (250, 500)]
        assert errors[0] < bound
        assert errors[0] / errors[1] == pytest.approx(2, rel=0.1)


# Limits


@pytest.mark.parametrize("strength", [(1.0, 1.0, 1.0), (0.5, 0.75, 1.5)])
@pytest.mark.parametrize("motor", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_motor_holds_its_effort_and_no_more(
    simulation: Alone, motor: int, sign: int, strength: Vector
) -> None:
    effort = TORQUE_MOTOR.peak_torque * np.array(strength)
    j, load, force = jacobian(PAPER_TPM, THETA), weights(PAPER_TPM, THETA), np.zeros(3)
    around_each_step(simulation, before=lambda: push(simulation, force))
    moved = []
    for share in (0.99, 1.01):
        force[:] = 0
        simulation.reset(THETA, plant=Plant(motor_strength=strength))
        settle(simulation, HOME)
        wanted = np.zeros(3)
        wanted[motor] = sign * share * effort[motor]
        force[:] = np.linalg.solve(j.T, load - wanted)  # all on one motor, nothing on the others
        settle(simulation, HOME, 1)
        found = torques(simulation)
        moved.append(abs(motors(simulation).theta[motor] - THETA[motor]))
        if share < 1:
            np.testing.assert_allclose(found, wanted, atol=1e-3)
        assert (np.abs(found) <= effort * (1 + 1e-9)).all()
    assert moved[0] < 1e-8
    assert moved[1] > 1e-5  # it gives way


@pytest.mark.parametrize("drive", [None, Servo()], ids=["ideal", "servo"])
@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
def test_motors_without_torque_let_the_arm_fall(engine: str, drive: Servo | None) -> None:
    simulation = Alone(Scene(), engine=engine, drive=drive)
    before = simulation.reset(THETA, plant=Plant(motor_strength=(0.0, 0.0, 0.0)))
    settle(simulation, HOME, 2)
    state = simulation.read()
    np.testing.assert_allclose(torques(simulation), 0, atol=1e-6)
    assert before.platform_position[2] - state.platform_position[2] > 0.01


def test_no_command_draws_more_than_the_motors_have(simulation: Alone) -> None:
    drawn: list[FloatArray] = []
    around_each_step(simulation, after=lambda: drawn.append(np.abs(torques(simulation))))
    simulation.reset(THETA)
    for jump in (-0.1, 0.1, -0.1, 0.1):  # m in a control period, three times what actions reach
        simulation.move(np.add(HOME, (0, 0, jump)))
    np.testing.assert_allclose(np.max(drawn, axis=0), TORQUE_MOTOR.peak_torque, rtol=1e-9)
