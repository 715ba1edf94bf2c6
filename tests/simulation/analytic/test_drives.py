"""Drives of the analytic engine: forward dynamics, motors that tire, and PyBullet as the judge."""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from alone import Alone, motors
from episodes import EVERYTHING, OF_SERVOS, expert_episode
from inside import around_each_step

from tpm_gym.arrays import FloatArray
from tpm_gym.mechanism import PAPER_TPM, WIDE_TPM
from tpm_gym.mechanism.tpm.dynamics import Dynamics
from tpm_gym.simulation import Plant, Scene, Servo, Simulation
from tpm_gym.simulation.analytic.forward_dynamics import Course, IdealSteps, march
from tpm_gym.simulation.analytic.steps import resisted
from tpm_gym.simulation.drives import drive_of
from tpm_gym.simulation.randomisation import Randomisation

STEP = 1 / 250
HOME = np.array(PAPER_TPM.home)
THETA = PAPER_TPM.inverse(HOME)
LINKS = len(PAPER_TPM.mechanism.links) - 1
WEAK = Plant(link_masses=(2.0,) * LINKS, motor_strength=(0.5, 0.5, 0.5))
DRAWN: dict[str, Any] = {**EVERYTHING, **OF_SERVOS, "latency": 0, "encoder_noise": 0.0}
ASTRAY = Randomisation(**DRAWN).draw(np.random.default_rng(1), PAPER_TPM)


def rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def untouched(
    before: FloatArray, now: FloatArray, then: FloatArray
) -> tuple[FloatArray, FloatArray]:
    return np.zeros_like(now), np.zeros(len(now))


def at_rest(theta: FloatArray, carried: float = 0.0) -> Course:
    rates, torque, force = np.zeros((3, len(theta), 3))
    position, nothing = PAPER_TPM.forward(theta), np.zeros(len(theta), dtype=np.int8)
    return Course(theta, rates, torque, position, position, force, nothing + carried, nothing)


def test_resistance_is_coulombs_in_every_one_of_the_27_cases():
    rng = np.random.default_rng(0)
    signs = set()
    for _ in range(4000):
        factor, drive, limit = rng.normal(size=(3, 3)), rng.normal(0, 2, 3), rng.uniform(0, 2, 3)
        mass = factor @ factor.T + 0.1 * np.eye(3)
        triangle = tuple(mass[np.triu_indices(3)].tolist())
        rates = np.array(resisted(triangle, tuple(drive.tolist()), tuple(limit.tolist())))
        resistance, moving = drive - mass @ rates, rates != 0
        np.testing.assert_allclose(resistance[moving], (limit * np.sign(rates))[moving], atol=1e-9)
        assert (np.abs(resistance) <= limit + 1e-9).all()
        signs.add(tuple(np.sign(rates)))
    assert len(signs) == 27


# -- motion ----------------------------------------------------------------------------------------


def energy_gained(time_step: float, payload: float) -> FloatArray:
    """By machines that swing freely for 80 ms, (r,) J."""
    theta = PAPER_TPM.inverse([(-0.1, 0.03, 0.75), (0.0, 0.035, 0.7)])
    fall = np.array(PAPER_TPM.mount.free_fall)
    weight, carried = np.tile(payload * fall, (2, 1)), np.full(2, payload)

    def touch(before, now, then):
        points = np.stack([before, now, then], axis=1)
        before, at, now = points.swapaxes(0, 1)
        return weight - payload * (now - 2 * at + before) / time_step**2, carried

    def energy(course):
        dynamics = Dynamics(payload=payload, free_fall=PAPER_TPM.mount.free_fall)
        return dynamics.energy(course.theta, course.rates)

    start, count = at_rest(theta), round(0.08 / time_step)
    course = at_rest(theta, payload)._replace(force=weight)
    slack = IdealSteps(np.zeros((count, 2, 3)), np.zeros((2, 3)), time_step)
    course, _ = march(PAPER_TPM, None, slack, count, course, touch)
    kinetic, _ = after = energy(course)
    assert (kinetic > 0.05).all()
    return sum(after) - sum(energy(start))


@pytest.mark.parametrize("payload", [0.0, 0.5])
def test_what_swings_freely_keeps_its_energy_to_the_integrators_order(payload):
    gained = np.array([energy_gained(step, payload) for step in (1e-3, 5e-4, 2.5e-4)])
    assert np.abs(gained[-1]).max() < 5e-3
    np.testing.assert_allclose(gained[:-1] / gained[1:], 2.0, atol=0.15)


def test_motors_with_torque_to_spare_are_where_they_shall_be():
    # So forward dynamics give what inverse dynamics give.
    theta = PAPER_TPM.inverse(np.linspace(HOME, HOME + (0.03, 0.01, -0.03), 14))[:, None]
    course = at_rest(theta[1])._replace(rates=(theta[1] - theta[0]) / STEP)
    steps = IdealSteps(theta[2:], np.full((1, 3), 1e6), STEP)
    course, torques = march(PAPER_TPM, None, steps, 12, course, untouched)
    rates = np.diff(theta, axis=0) / STEP
    expected = PAPER_TPM.torque(theta[1:-1], rates[:-1], np.diff(rates, axis=0) / STEP)
    np.testing.assert_allclose(torques, expected, atol=1e-8)
    np.testing.assert_allclose(course.theta, theta[-1], atol=1e-12)
    assert not steps.behind.any()


def test_no_motor_exceeds_its_largest_torque_next_to_a_singularity():
    robot = Alone(machine=WIDE_TPM, engine="analytic", physics={"torques": "every"})
    home, end = np.array(WIDE_TPM.home), np.array((0.816, 0.551, 0.502))
    assert WIDE_TPM.conditioning_at(end) < 1e-4
    robot.reset(WIDE_TPM.inverse(home + 0.85 * (end - home)))
    for _ in range(2):
        state = robot.move(end)
        assert not state.passed_singularity
        assert np.abs(robot.engine.torques).max() == 100  # rounding errors made it 7e6
    lag = WIDE_TPM.inverse(end) - state.theta
    np.testing.assert_array_equal(state.torque, 100 * np.sign(lag))


# -- against PyBullet ------------------------------------------------------------------------------


def commands(scripted: bool, steps: int = 50, seed: int = 0) -> Iterator[FloatArray]:
    """A smooth way, or full steps at random, m."""
    rng, at = np.random.default_rng(seed), HOME
    for k in range(steps):
        if scripted:
            turns = np.sin(k / 8), np.sin(k / 5), np.cos(k / 8) - 1
            at = HOME + np.multiply((0.08, 0.008, 0.05), turns)
        else:
            at = at + rng.choice([-1.0, 0.0, 1.0], 3) * PAPER_TPM.step_limit
        at = PAPER_TPM.region.project(at)
        yield at


def followed(way: Iterator[FloatArray], plant: Plant, drive: Any, **physics: Any) -> Any:
    """Torques (N m) of PyBullet and ours, angles apart (rad), and P apart (m)."""
    both = [
        Alone(engine=engine, drive=drive_of(drive), physics=physics)
        for engine in ("pybullet", "analytic")
    ]
    for simulation in both:
        simulation.reset(THETA, plant=plant)
    found = []
    for command in way:
        theirs, ours = (simulation.move(command) for simulation in both)
        apart = theirs.theta - ours.theta, theirs.platform_position - ours.platform_position
        found.append((theirs.torque, ours.torque, *apart))
        assert not theirs.passed_singularity | ours.passed_singularity
    return np.array(found).transpose(1, 0, 2)


@pytest.mark.parametrize(
    ("scripted", "plant", "torque", "point"),
    [  # seen: 0.02%, 0.6% and 2 um, 24 um rms
        (True, Plant(), 0.001, 3e-6),
        (False, Plant(), 0.015, 60e-6),
        (False, ASTRAY, 0.015, 80e-6),
    ],
    ids=["smooth", "random", "astray"],
)
def test_servos_move_as_in_pybullet(scripted, plant, torque, point):
    theirs, ours, theta, position = followed(commands(scripted), plant, "servo")
    assert rms(theirs - ours) < torque * rms(theirs)
    assert rms(position) < point
    assert rms(theta) < 2e-5


def test_a_servo_presses_carries_and_lets_go_as_in_pybullet():
    runs = []
    for engine in ("pybullet", "analytic"):
        env = gym.make("TPMPickAndPlace-v0", engine=engine, drive="servo")
        inside = env.unwrapped
        rows = []
        for *_, info in expert_episode(env, 0):
            state = inside.state
            rows.append([*state.torque, *state.platform_position, state.held, info["is_success"]])
        env.close()
        runs.append(np.array(rows))
    theirs, ours = runs
    np.testing.assert_array_equal(theirs[:, 6:], ours[:, 6:])
    held = theirs[:, 6] == 0
    assert held.sum() > 10
    assert theirs[-1, 7] == 1
    assert rms((theirs - ours)[held, :3]) < 0.2  # N m, of 5
    assert np.abs(theirs - ours)[:, 3:6].max() < 2e-4


def test_motors_that_tire_do_as_in_pybullet():
    theirs, ours = (
        Alone(engine=engine, physics={"time_step": 1e-3, **more})
        for engine, more in (("pybullet", {}), ("analytic", {"torques": "every"}))
    )
    for simulation in (theirs, ours):
        simulation.reset(THETA, plant=WEAK)
    seen: list[Any] = []
    around_each_step(theirs, after=lambda: seen.append(motors(theirs).torque))
    tired, expected, found = 0, [], []
    for k, side in enumerate((0, 1, -1, 1, 0)):  # full reversals, well away from y = 0
        command = HOME + (0.045 * side, 0.010, -0.05 * (k % 2))
        seen.clear()
        one, other = theirs.move(command), ours.move(command)
        expected.append(seen.copy())
        found.append(ours.engine.torques[:, 0])
        tired += int((np.abs(found[-1]) > 50 - 1e-9).any())
        np.testing.assert_allclose(other.theta, one.theta, atol=1e-3)
        np.testing.assert_array_equal(other.torque, found[-1][-1])
    assert tired >= 2
    assert np.abs(found).max() <= 50 + 1e-9
    assert rms(np.subtract(found, expected)) < 0.02 * rms(expected)


# -- in batches ------------------------------------------------------------------------------------


def batch_of(plants: list[Plant], **options: Any) -> Any:
    simulation = Simulation(Scene(), engine="analytic", count=len(plants), **options)
    simulation.reset(np.arange(len(plants)), THETA, plants=plants)
    return simulation


def test_motors_that_tired_catch_up_and_are_ideal_again():
    pair, apart = batch_of([WEAK, Plant()]), []
    for shift in (0.0, 0.03, *[-0.03] * 5):
        command = HOME + (shift, 0.010, -max(0.0, shift))
        pair.move(np.array([command] * 2), np.zeros(2, dtype=bool))
        apart.append(float(np.abs(np.subtract(*pair.state().theta)).max()))
    assert np.greater(apart, 1e-3).sum() == 4
    state = pair.state()
    assert not state.passed_singularity.any()
    np.testing.assert_allclose(*state.theta, atol=1e-12)
    np.testing.assert_allclose(*state.platform_position, atol=1e-12)
    np.testing.assert_allclose(*state.theta_dot, atol=1e-9)


def test_torques_are_of_the_last_time_step_or_of_every_one_or_none():
    runs = {
        kind: batch_of([Plant()], physics={"torques": kind}) for kind in ("none", "last", "every")
    }
    for command in commands(False, 10):
        for simulation in runs.values():
            simulation.move(command[None], np.zeros(1, dtype=bool))
        none, last, every = (simulation.state().torque for simulation in runs.values())
        assert np.isnan(none).all()
        np.testing.assert_array_equal(last, every)
        torques = runs["every"].engine.torques
        assert torques.shape == (10, 1, 3)
        np.testing.assert_array_equal(torques[-1], every)
    assert runs["last"].engine.torques is None


@pytest.mark.parametrize(("drive", "seed"), [(None, 3), (Servo(), 7)], ids=["ideal", "servo"])
def test_what_is_thrown_through_the_singularity_says_so_and_waits_for_a_reset(drive, seed):
    simulation, vacuum = batch_of([WEAK, Plant()], drive=drive), np.zeros(2, dtype=bool)
    for command in commands(False, 10, seed):
        simulation.move(np.array([command] * 2), vacuum)
    state = simulation.state()
    assert np.array(state.assembly_mode_changed).tolist() == [True, False]
    assert not np.any(state.working_mode_changed)
    assert -state.platform_position[0, 1] > 0  # where it was last on its side
    for values in vars(state).values():
        assert np.isfinite(values).all()
    simulation.move(np.array([HOME] * 2), vacuum)
    later = simulation.state()
    for name in ("theta", "torque", "platform_position", "assembly_mode_changed"):
        np.testing.assert_array_equal(getattr(later, name)[0], getattr(state, name)[0])
    simulation.reset(np.array([0]), THETA)
    simulation.move(np.array([HOME] * 2), vacuum)
    fresh = simulation.state()
    assert not np.any(fresh.assembly_mode_changed)
    home = PAPER_TPM.mount.to_world(HOME)
    np.testing.assert_allclose(fresh.platform_position[0], home, atol=1e-5)
