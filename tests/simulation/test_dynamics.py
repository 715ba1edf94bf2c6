"""The simulated mechanism against theory: statics, inertia, energy, rates, and its limits.

Theory is the mechanism's data (masses, inertias, frames) moved along the closed form of the
kinematics, differentiated by central differences. What was measured is in the comments.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from walk import place, walk

from tpm_gym.kinematics import inverse, jacobian
from tpm_gym.kinematics.workspace import TASK_REGION
from tpm_gym.mechanism.links import CUP_LENGTH, MOTOR_EFFORT
from tpm_gym.mechanism.tree import ACTUATED_JOINTS, DEFAULT_MOUNT, build, joint_angles
from tpm_gym.simulation.physics import PULL_OFF_FORCE, Physics
from tpm_gym.simulation.randomisation import Plant
from tpm_gym.simulation.simulation import Simulation
from tpm_gym.simulation.state import Puck, Scene

FloatArray = NDArray[np.float64]
G = 9.81
MECHANISM = build()
LINKS = MECHANISM.links[1:]
MASSES = np.array([link.mass for link in LINKS])
HOME = np.array([-0.04, 0.028, 0.80])
FORCES = [*(20 * np.eye(3)).tolist(), [10, -20, 15]]  # N, paper frame


def points(count: int, seed: int = 0) -> FloatArray:
    """Points P all over the task region."""
    return np.random.default_rng(seed).uniform(TASK_REGION.low, TASK_REGION.high, (count, 3))


# Theory


def centres(theta: FloatArray) -> FloatArray:
    """Centres of mass (links, 3), world, m."""
    frames = walk(MECHANISM, joint_angles(theta))
    return DEFAULT_MOUNT.to_world([place(frames, k.name, k.centre_of_mass) for k in LINKS])


def rotations(theta: FloatArray) -> FloatArray:
    """Orientations (links, 3, 3) in the paper frame."""
    frames = walk(MECHANISM, joint_angles(theta))
    return np.array([frames[link.name][1] for link in LINKS])


def slopes(function: Callable[[FloatArray], FloatArray], theta: FloatArray) -> FloatArray:
    """Derivatives by the three motors, stacked in front."""
    step = 1e-5
    pairs = [(function(theta + step * e), function(theta - step * e)) for e in np.eye(3)]
    return np.array([(up - down) / (2 * step) for up, down in pairs])


def weights(theta: FloatArray, masses: FloatArray = MASSES) -> FloatArray:
    """Torques (3,) N m that carry the links: the gradient of their potential."""
    return slopes(lambda angles: G * masses @ centres(angles)[:, 2], theta)


def mass_matrix(theta: FloatArray) -> FloatArray:
    """Inertia (3, 3) kg m^2 that the motors feel: kinetic energy is theta_dot M theta_dot / 2."""
    velocity, rotation = slopes(centres, theta), rotations(theta)
    spin = slopes(rotations, theta) @ np.swapaxes(rotation, -1, -2)  # cross product matrices
    omega = np.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], axis=-1)
    moments = rotation @ np.array([k.inertia for k in LINKS]) @ np.swapaxes(rotation, -1, -2)
    linear = np.einsum("ank,n,bnk->ab", velocity, MASSES, velocity)
    return np.asarray(linear + np.einsum("ani,nij,bnj->ab", omega, moments, omega))


# The engine


@pytest.fixture
def simulation() -> Iterator[Simulation]:
    simulation = Simulation(Scene())
    yield simulation
    simulation.close()


def addresses(simulation: Simulation) -> dict[str, tuple[int, int]]:
    """Where the engine keeps every joint and every link."""
    client, found = simulation._client, {}
    for body in simulation._robot.bodies:
        for index in range(client.getNumJoints(body)):
            info = client.getJointInfo(body, index)
            found[info[1].decode()] = found[info[12].decode()] = (body, index)
    return found


def torques(simulation: Simulation) -> FloatArray:
    at = addresses(simulation)
    return np.array([simulation._client.getJointState(*at[name])[3] for name in ACTUATED_JOINTS])


def switch_motors_off(simulation: Simulation) -> None:
    client, at = simulation._client, addresses(simulation)
    for name in ACTUATED_JOINTS:
        client.setJointMotorControl2(*at[name], client.VELOCITY_CONTROL, force=0)


def push(simulation: Simulation, force: ArrayLike) -> None:
    """Apply a force (N, paper frame) at point P of the platform in the next time step."""
    client, at = simulation._client, addresses(simulation)["platform"]
    world = simulation.mount.rotate(force).tolist()
    client.applyExternalForce(*at, world, simulation._robot.truth()[1], client.WORLD_FRAME)


def around_each_step(
    simulation: Simulation,
    before: Callable[[], None] = lambda: None,
    after: Callable[[], None] = lambda: None,
) -> None:
    """Let something happen around every time step of the engine."""
    step = simulation._client.stepSimulation

    def wrapped() -> None:
        before()
        step()
        after()

    simulation._client.stepSimulation = wrapped


def settle(simulation: Simulation, point: FloatArray, periods: int = 3) -> None:
    for _ in range(periods):
        simulation.move(point)


def total_energy(simulation: Simulation) -> tuple[float, float]:
    """Kinetic and potential energy (J) from what the engine says of each link."""
    client, at = simulation._client, addresses(simulation)
    kinetic = potential = 0.0
    for link in LINKS:
        centre, _, _, _, _, turn, velocity, spin = client.getLinkState(
            *at[link.name], computeLinkVelocity=True, computeForwardKinematics=True
        )
        rotation = np.reshape(client.getMatrixFromQuaternion(turn), (3, 3))
        local = rotation.T @ spin
        kinetic += (link.mass * np.dot(velocity, velocity) + local @ link.inertia @ local) / 2
        potential += link.mass * G * centre[2]
    return kinetic, potential


# Forces at rest


def test_torques_at_rest_carry_the_links(simulation: Simulation) -> None:
    # Measured: 7e-9 of the largest of the three.
    for point in points(20):
        theta = inverse(point)
        simulation.reset(theta)
        assert not simulation.read().torque.any()
        settle(simulation, point)
        expected = weights(theta)
        assert np.abs(simulation.read().torque - expected).max() < 1e-6 * np.abs(expected).max()


def test_torques_at_rest_carry_links_of_other_masses(simulation: Simulation) -> None:
    rng = np.random.default_rng(1)
    for point in points(5, seed=1):
        factors, theta = rng.uniform(0.5, 2.0, len(LINKS)), inverse(point)
        simulation.reset(theta, plant=Plant(link_masses=tuple(factors.tolist())))
        settle(simulation, point)
        expected = weights(theta, factors * MASSES)
        assert np.abs(torques(simulation) - expected).max() < 1e-6 * np.abs(expected).max()


def test_a_force_on_the_platform_loads_the_motors_by_the_jacobian(simulation: Simulation) -> None:
    # Measured: 4e-7 of the largest of the three.
    force = np.zeros(3)
    around_each_step(simulation, before=lambda: push(simulation, force))
    for point in points(6, seed=2):
        theta = inverse(point)
        simulation.reset(theta)
        settle(simulation, point)
        alone = torques(simulation)
        for value in FORCES:
            force[:] = value
            settle(simulation, point, 2)
            expected = -jacobian.velocity(theta).T @ force
            change = torques(simulation) - alone
            assert np.abs(change - expected).max() < 1e-5 * np.abs(expected).max()
        force[:] = 0


# Motion


def test_released_it_accelerates_by_its_mass_matrix(simulation: Simulation) -> None:
    # Measured: 1e-5, and 3e-5 at y = 13 mm where M has rows 100 times as large as others.
    switch_motors_off(simulation)
    for point in points(6):
        theta = inverse(point)
        mass, load, j = mass_matrix(theta), weights(theta), jacobian.velocity(theta)
        for force in ([0, 0, 0], *FORCES):
            simulation.reset(theta)
            push(simulation, force)
            simulation._client.stepSimulation()
            rates = np.array(simulation._robot.encoders()[1])
            expected = np.linalg.solve(mass, j.T @ force - load) * simulation.physics.time_step
            assert np.abs(rates - expected).max() < 1e-3 * np.abs(expected).max()


def lost_in_free_fall(point: ArrayLike, time_step: float) -> float:
    """Energy lost in 0.2 s without motors, as a share of the kinetic energy gained."""
    simulation = Simulation(Scene(), physics=Physics(time_step=time_step))
    slide = addresses(simulation)["cup_slide"]
    simulation.reset(inverse(point))
    switch_motors_off(simulation)
    start = sum(total_energy(simulation))
    for _ in range(round(0.2 / time_step)):
        simulation._client.stepSimulation()
        # The spring of the cup does no work, and nothing is touched.
        assert abs(simulation._client.getJointState(*slide)[0]) < 1e-9
    kinetic, potential = total_energy(simulation)
    assert simulation.read().platform_position[2] > CUP_LENGTH + 0.01
    simulation.close()
    return (start - kinetic - potential) / kinetic


@pytest.mark.parametrize("point", [(-0.04, 0.028, 0.67), (0.03, 0.04, 0.68), (-0.12, 0.02, 0.67)])
def test_energy_is_conserved_up_to_the_integrator(point: tuple[float, ...]) -> None:
    # Measured: 2.6 to 2.9 % at 250 Hz and half of that at each half of the time step: first order,
    # so it is the integrator's (semi-implicit Euler), and vanishes with the time step.
    lost = [lost_in_free_fall(point, 1 / rate) for rate in (250, 500, 1000)]
    assert 0 < lost[0] < 0.032
    np.testing.assert_allclose(np.divide(lost[:-1], lost[1:]), 2, rtol=0.05)


def errors_of_velocity(time_step: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """At full speed: platform's speed, what J misses of its velocity, what differences miss."""
    simulation = Simulation(Scene(), physics=Physics(time_step=time_step))
    client, at = simulation._client, addresses(simulation)["platform"]
    rows = []

    def note() -> None:
        theta, rates = simulation._robot.encoders()
        state = client.getLinkState(*at, computeLinkVelocity=True)
        assert np.abs(state[7]).max() < 1e-4  # rad/s: it does not turn
        by_rates = simulation.mount.rotate(jacobian.velocity(theta) @ rates)
        rows.append((by_rates, state[6], simulation._robot.truth()[1]))

    around_each_step(simulation, after=note)
    simulation.reset(inverse(HOME))
    rng, command = np.random.default_rng(1), HOME
    for _ in range(60):
        command = TASK_REGION.project(command + rng.choice([-1, 0, 1], 3) * (0.03, 0.005, 0.03))
        simulation.move(command)
    simulation.close()
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
    _, finer_by_rates, finer_by_differences = errors_of_velocity(1 / 500)
    assert rms(by_rates) / rms(finer_by_rates) == pytest.approx(2, rel=0.15)
    assert rms(by_differences) / rms(finer_by_differences) == pytest.approx(2, rel=0.15)


# Limits


@pytest.mark.parametrize("mass", [0.05, 0.3, 1.0])
def test_a_held_puck_comes_off_at_the_pull_off_force(mass: float) -> None:
    # Weight and pull together, measured: it is let go at 12.06, 12.10 and 12.16 N. The lip has to
    # lift by 2 mm, which takes a heavier puck longer, and the pull grows meanwhile.
    puck = Puck(mass=mass)
    simulation = Simulation(Scene(puck=puck))
    down = np.array([HOME[0], HOME[1], 0.97 - CUP_LENGTH - puck.height])
    simulation.reset(inverse(down), (HOME[0], -HOME[1], puck.height / 2))
    for height in np.arange(0.0, 0.05, 0.001):
        state = simulation.move(down - (0, 0, height), vacuum=True)
    assert state.holding
    client, body, load = simulation._client, simulation._scenery.puck, [11.5]

    def pull() -> None:
        load[0] += 0.002  # N a time step
        position, _ = client.getBasePositionAndOrientation(body)
        force = (0, 0, mass * G - load[0])
        client.applyExternalForce(body, -1, force, position, client.WORLD_FRAME)

    around_each_step(simulation, before=pull)
    while state.holding and load[0] < 20:
        state = simulation.move(down - (0, 0, 0.05), vacuum=True)
    assert PULL_OFF_FORCE < load[0] < 1.02 * PULL_OFF_FORCE
    simulation.close()


@pytest.mark.parametrize("strength", [1.0, 0.6])
@pytest.mark.parametrize("motor", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_motor_holds_its_effort_and_no_more(
    simulation: Simulation, motor: int, sign: int, strength: float
) -> None:
    theta = inverse(HOME)
    j, load, force = jacobian.velocity(theta), weights(theta), np.zeros(3)
    around_each_step(simulation, before=lambda: push(simulation, force))
    moved = []
    for share in (0.99, 1.01):
        plant = Plant(motor_strength=(strength,) * 3)
        force[:] = 0
        simulation.reset(theta, plant=plant)
        settle(simulation, HOME)
        wanted = np.zeros(3)
        wanted[motor] = sign * share * strength * MOTOR_EFFORT
        force[:] = np.linalg.solve(j.T, load - wanted)  # all on one motor, nothing on the others
        settle(simulation, HOME, 1)
        found = torques(simulation)
        moved.append(abs(simulation._robot.encoders()[0][motor] - theta[motor]))
        if share < 1:
            np.testing.assert_allclose(found, wanted, atol=1e-3)
        assert np.abs(found).max() <= strength * MOTOR_EFFORT * (1 + 1e-9)
    assert moved[0] < 1e-8
    assert moved[1] > 1e-5  # it gives way


def test_no_command_draws_more_than_the_motors_have(simulation: Simulation) -> None:
    drawn: list[FloatArray] = []
    around_each_step(simulation, after=lambda: drawn.append(np.abs(torques(simulation))))
    simulation.reset(inverse(HOME))
    for jump in (-0.1, 0.1, -0.1, 0.1):  # m in a control period, three times what actions reach
        simulation.move(HOME + (0, 0, jump))
    np.testing.assert_allclose(np.max(drawn, axis=0), MOTOR_EFFORT, rtol=1e-9)
