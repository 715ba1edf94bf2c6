"""Drives in closed form: the law of servos, motors that tire, and PyBullet as the judge."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from episodes import EVERYTHING, OF_SERVOS, expert_episode
from inside_bullet import around_each_step
from machines import anywhere, each_machine
from tpm_gym.simulation.analytic.columns import Batch
from tpm_gym.simulation.analytic.drives import (
    Drive,
    IdealDrives,
    ServoDrives,
    limited,
    resisted,
)
from tpm_gym.simulation.analytic.motion import Course, march
from tpm_gym.simulation.analytic.simulation import AnalyticSimulation
from tpm_gym.simulation.analytic.single import SingleSimulation

from tpm_gym.arrays import FloatArray
from tpm_gym.mechanism import PAPER_TPM, TPM
from tpm_gym.mechanism.dynamics import Dynamics
from tpm_gym.simulation import Block, Plant, Scene, Servo
from tpm_gym.simulation.drives import Reference, Servos, drive_of, references
from tpm_gym.simulation.drives import limited as limited_alone
from tpm_gym.simulation.randomisation import Randomisation
from tpm_gym.simulation.simulation import make_simulation

STEP = 1 / 250
HOME = np.array(PAPER_TPM.home)
LINKS = len(PAPER_TPM.mechanism.links) - 1
WEAK = Plant(link_masses=(2.0,) * LINKS, motor_strength=(0.5, 0.5, 0.5))
ASTRAY: dict[str, Any] = {**EVERYTHING, **OF_SERVOS, "latency": 0, "encoder_noise": 0.0}
TRIANGLE = np.triu_indices(3)


def rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def columns(points: Any) -> FloatArray:
    return np.ascontiguousarray(np.array(points).T)


def plants_of(machine: TPM, count: int, seed: int = 1) -> list[Plant]:
    rng = np.random.default_rng(seed)
    return [Randomisation(**ASTRAY).draw(rng, machine) for _ in range(count)]


def untouched(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    return np.zeros_like(points[0]), np.zeros(points.shape[2])


def at_rest(theta: FloatArray, position: FloatArray) -> Course:
    zero, count = np.zeros_like(theta), theta.shape[1]
    left = np.zeros((2, count), dtype=bool)
    return Course(theta, zero, zero, position, position, zero, np.zeros(count), left)


# -- one text, two shapes --------------------------------------------------------------------------


@each_machine
def test_columns_move_as_the_dynamics_of_each_machine_say(machine: TPM) -> None:
    plants, rng = plants_of(machine, 4), np.random.default_rng(0)
    rows = np.arange(4)
    built = [plant.of(machine) for plant in plants]
    batch = Batch(machine, 4)
    batch.build(rows, [one.lengths for one in built], [plant.link_masses for plant in plants])
    theta = columns([machine.inverse(point) for point in anywhere(machine, 4)])
    rates = rng.normal(size=(3, 4))
    found = batch.motion(theta, rates)
    for row, (one, plant) in enumerate(zip(built, plants, strict=True)):
        dynamics = Dynamics(
            geometry=one.geometry,
            branch=one.assembly_mode,
            link_masses=plant.link_masses,
            free_fall=one.mount.free_fall,
        )
        reading = one.evaluate(tuple(theta[:, row].tolist()))
        bias = dynamics.torque(theta[:, row], rates[:, row], np.zeros(3))
        mass = [dynamics.torque(theta[:, row], np.zeros(3), unit) for unit in np.eye(3)]
        mass -= dynamics.gravity(theta[:, row])
        np.testing.assert_allclose(found.mass[:, row], np.array(mass)[TRIANGLE], rtol=1e-9)
        np.testing.assert_allclose(found.bias[:, row], bias, rtol=1e-9)
        np.testing.assert_allclose(found.jacobian[:, :, row], reading.jacobian, rtol=1e-9)
        np.testing.assert_allclose(found.position[:, row], reading.position, rtol=1e-12)
    assert found.working.all()


@each_machine
@pytest.mark.parametrize("feedforward", ["none", "gravity", "computed"])
def test_the_law_is_that_of_one_machines_servos(machine: TPM, feedforward: str) -> None:
    law, plants, rng = (
        Servo(feedforward=feedforward),
        plants_of(machine, 4),
        np.random.default_rng(2),
    )
    corner, *way = np.linspace(anywhere(machine, 1)[0], machine.home, 11)
    path = [machine.inverse(tuple(point)) for point in way]
    start = machine.inverse(tuple(corner))
    many = ServoDrives(law, machine, np.zeros((2, 3, 4)), STEP)
    machines = [plant.of(machine) for plant in plants]
    many.alter(np.arange(4), [one.lengths for one in machines], plants)
    theta = columns([start] * 4)
    many.rest(np.arange(4), theta)
    repeated = np.repeat(np.array(path)[:, :, None], 4, axis=2)
    steps = references(Batch(machine, 4), law, theta, repeated, STEP)
    many.begin(steps[0].theta)
    alone = []
    for one, plant in zip(machines, plants, strict=True):
        alone.append(Servos(law, one, STEP))
        alone[-1].alter(plant)
        alone[-1].rest(start)
        alone[-1].begin(path[0])
    mass = np.eye(3)[TRIANGLE][:, None] * np.ones(4)
    for step, single in zip(steps, references(machine, law, start, path, STEP), strict=True):
        theta = np.array(step.theta) + rng.normal(0, 1e-3, (3, 4))
        rates = rng.normal(0, 8, (3, 4))
        _, torque = many.step(step, theta, rates, mass, np.zeros((3, 4)))
        expected = [
            servos.torque(single, tuple(theta[:, row].tolist()), tuple(rates[:, row].tolist()))
            for row, servos in enumerate(alone)
        ]
        np.testing.assert_allclose(torque.T, expected, rtol=1e-12, atol=1e-11)


def test_the_limits_are_those_of_one_motor() -> None:
    rng = np.random.default_rng(0)
    torque, rate = rng.normal(0, 100, (3, 500)), rng.normal(0, 15, (3, 500))
    effort = rng.uniform(50, 150, (3, 500))
    motors = PAPER_TPM.mechanism.motors
    speed, corner = ([[getattr(motor, name)] for motor in motors] for name in ("speed", "corner"))
    found = limited(torque, rate, effort, np.array(speed), np.array(corner))
    for motor, *rows in zip(motors, found, torque, rate, effort, strict=True):
        for one, *given in zip(*(row.tolist() for row in rows), strict=True):
            assert one == limited_alone(*given, motor)


def test_resistance_is_coulombs_in_every_one_of_the_27_cases() -> None:
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(3, 3, 4000))
    full = np.einsum("ijn,kjn->ikn", factor, factor) + 0.1 * np.eye(3)[:, :, None]
    drive, limit = rng.normal(0, 2, (3, 4000)), rng.uniform(0, 2, (3, 4000))
    rates = resisted(full[TRIANGLE], drive, limit)
    resistance = drive - np.einsum("ijn,jn->in", full, rates)
    moving = rates != 0
    np.testing.assert_allclose(resistance[moving], (limit * np.sign(rates))[moving], atol=1e-9)
    assert (np.abs(resistance) <= limit + 1e-9).all()
    assert len(np.unique(np.sign(rates), axis=1).T) == 27


# -- motion ----------------------------------------------------------------------------------------


class Slack:
    """Motors without any torque: the machine swings freely."""

    def __init__(self, time_step: float) -> None:
        self.step_ = time_step

    def step(self, reference: Any, theta: Any, rates: Any, mass: Any, load: Any) -> Any:
        return rates - self.step_ * resisted(mass, load, np.zeros_like(load)), np.zeros_like(load)


def energy_gained(time_step: float, payload: float) -> FloatArray:
    """By machines that swing freely for 80 ms, (r,) J."""
    theta = columns([PAPER_TPM.inverse(point) for point in [(-0.1, 0.03, 0.75), (0.0, 0.035, 0.7)]])
    fall = PAPER_TPM.mount.free_fall
    batch, dynamics = Batch(PAPER_TPM, 2), Dynamics(payload=payload, free_fall=fall)
    weight, carried = payload * np.repeat(np.array([fall]).T, 2, axis=1), np.full(2, payload)

    def touch(points: FloatArray) -> tuple[FloatArray, FloatArray]:
        before, at, now = points
        return weight - payload * (now - 2 * at + before) / time_step**2, carried

    start = at_rest(theta, batch.forward(theta))._replace(force=weight, carried=carried)
    drive: Drive = Slack(time_step)
    steps = [Reference(None)] * round(0.08 / time_step)
    end, _ = march(batch, drive, steps, start, time_step, touch)
    kinetic, _ = after = dynamics.energy(end.theta.T, end.rates.T)
    assert (kinetic > 0.05).all()
    return sum(after) - sum(dynamics.energy(theta.T, start.rates.T))


@pytest.mark.parametrize("payload", [0.0, 0.5])
def test_what_swings_freely_keeps_its_energy_to_the_integrators_order(payload: float) -> None:
    gained = np.array([energy_gained(step, payload) for step in (1e-3, 5e-4, 2.5e-4)])
    assert np.abs(gained[-1]).max() < 5e-3
    np.testing.assert_allclose(gained[:-1] / gained[1:], 2.0, atol=0.15)


def test_springs_and_dampers_give_nothing_that_was_not_put_in() -> None:
    law, dynamics = Servo(feedforward="none"), PAPER_TPM.dynamics
    theta, goal = columns([PAPER_TPM.inverse(p) for p in (HOME, HOME + (0.02, 0.0, 0.02))]).T
    drive = ServoDrives(law, PAPER_TPM, np.zeros((2, 3, 1)), STEP)
    drive.begin(goal[:, None])
    batch, totals = Batch(PAPER_TPM, 1), []
    now = at_rest(theta[:, None], HOME[:, None])
    for _ in range(60):
        now, _ = march(batch, drive, [Reference(goal[:, None])], now, STEP, untouched)
        sprung = law.stiffness * np.sum((now.theta[:, 0] - goal) ** 2) / 2
        totals.append(sum(dynamics.energy(now.theta.T, now.rates.T))[0] + sprung)
    assert totals[0] - totals[-1] > 0.1  # J
    assert np.diff(totals).max() < 1e-3 * (totals[0] - totals[-1])


def test_motors_with_torque_to_spare_are_where_they_shall_be() -> None:
    # So forward dynamics give what inverse dynamics give.
    way = np.linspace(HOME, HOME + (0.03, 0.01, -0.03), 14)[:, :, None]
    batch = Batch(PAPER_TPM, 1)
    theta = batch.inverse(way.transpose(1, 0, 2))
    start = at_rest(theta[:, 1], way[1])._replace(rates=(theta[:, 1] - theta[:, 0]) / STEP)
    drive = IdealDrives(np.full((3, 1), 1e6), STEP)
    steps = [Reference(one) for one in theta.transpose(1, 0, 2)[2:]]
    end, torques = march(batch, drive, steps, start, STEP, untouched)
    rates = np.diff(theta, axis=1) / STEP
    expected = batch.torque(theta[:, 1:-1], rates[:, :-1], np.diff(rates, axis=1) / STEP)
    np.testing.assert_allclose(np.array(torques).transpose(1, 0, 2), expected, atol=1e-8)
    np.testing.assert_allclose(end.theta, theta[:, -1], atol=1e-12)
    assert not drive.behind.any()


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
        make_simulation(Scene(), engine=engine, drive=drive_of(drive), physics=physics)
        for engine in ("pybullet", "analytic")
    ]
    for simulation in both:
        simulation.reset(PAPER_TPM.inverse(PAPER_TPM.home), plant=plant)
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
        (False, plants_of(PAPER_TPM, 1)[0], 0.015, 80e-6),
    ],
    ids=["smooth", "random", "astray"],
)
def test_servos_move_as_in_pybullet(
    scripted: bool, plant: Plant, torque: float, point: float
) -> None:
    theirs, ours, theta, position = followed(commands(scripted), plant, "servo")
    assert rms(theirs - ours) < torque * rms(theirs)
    assert rms(position) < point
    assert rms(theta) < 2e-5


def test_servos_differ_from_pybullets_as_their_time_steps_do() -> None:
    apart = []
    for step in (1 / 250, 1 / 1000):
        theirs, ours, _, position = followed(commands(False, 12), Plant(), "servo", time_step=step)
        apart.append((rms(theirs - ours) / rms(theirs), rms(position)))
    (coarse, far), (fine, near) = apart
    assert fine < 0.5 * coarse
    assert near < 0.5 * far


def test_a_servo_presses_carries_and_lets_go_as_in_pybullet() -> None:
    runs = []
    for engine in ("pybullet", "analytic"):
        env = gym.make("TPMPickAndPlace-v0", engine=engine, drive="servo")
        inside: Any = env.unwrapped
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


def test_motors_that_tire_do_as_in_pybullet() -> None:
    theirs, ours = (
        make_simulation(Scene(), engine=engine, physics={"time_step": 1e-3, **more})
        for engine, more in (("pybullet", {}), ("analytic", {"torques": "every"}))
    )
    assert isinstance(ours, SingleSimulation)
    for simulation in (theirs, ours):
        simulation.reset(PAPER_TPM.inverse(PAPER_TPM.home), plant=WEAK)
    seen: list[Any] = []
    around_each_step(theirs, after=lambda: seen.append(theirs.engine.motors().torque))
    tired, expected, found = 0, [], []
    for k, side in enumerate((0, 1, -1, 1, 0)):  # full reversals, well away from y = 0
        command = HOME + (0.045 * side, 0.010, -0.05 * (k % 2))
        seen.clear()
        one, other = theirs.move(command), ours.move(command)
        assert ours.batch.torques is not None
        expected.append(seen.copy())
        found.append(ours.batch.torques[:, :, 0])
        tired += int((np.abs(found[-1]) > 50 - 1e-9).any())
        np.testing.assert_allclose(other.theta, one.theta, atol=1e-3)
        np.testing.assert_array_equal(other.torque, found[-1][-1])
    assert tired >= 2
    assert np.abs(found).max() <= 50 + 1e-9
    assert rms(np.subtract(found, expected)) < 0.02 * rms(expected)


# -- in batches ------------------------------------------------------------------------------------


def batch_of(plants: list[Plant], **options: Any) -> AnalyticSimulation:
    simulation = AnalyticSimulation(Scene(), count=len(plants), **options)
    start = PAPER_TPM.inverse(PAPER_TPM.home)
    simulation.reset(np.arange(len(plants)), start, {}, plants)
    return simulation


def test_motors_that_tired_catch_up_and_are_ideal_again() -> None:
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


def test_torques_are_of_the_last_time_step_or_of_every_one_or_none() -> None:
    runs = {
        kind: batch_of([Plant()], physics={"torques": kind}) for kind in ("none", "last", "every")
    }
    for command in commands(False, 10):
        for simulation in runs.values():
            simulation.move(command[None], np.zeros(1, dtype=bool))
        none, last, every = (simulation.state().torque for simulation in runs.values())
        assert np.isnan(none).all()
        np.testing.assert_array_equal(last, every)
        torques = runs["every"].torques
        assert torques is not None
        assert torques.shape == (10, 3, 1)
        np.testing.assert_array_equal(torques[-1, :, 0], every[0])
    assert runs["last"].torques is None


@pytest.mark.parametrize(("drive", "seed"), [(None, 3), (Servo(), 7)], ids=["ideal", "servo"])
def test_what_is_thrown_through_the_singularity_says_so_and_waits_for_a_reset(
    drive: Any, seed: int
) -> None:
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
    simulation.reset(np.array([0]), PAPER_TPM.inverse(PAPER_TPM.home), {}, [Plant()])
    simulation.move(np.array([HOME] * 2), vacuum)
    fresh = simulation.state()
    assert not np.any(fresh.assembly_mode_changed)
    home = PAPER_TPM.mount.to_world(HOME)
    np.testing.assert_allclose(fresh.platform_position[0], home, atol=1e-5)


@pytest.mark.parametrize(
    ("drive", "randomisation"),
    [("servo", {**EVERYTHING, **OF_SERVOS}), ("ideal", {"link_mass": 2.0, "motor_strength": 0.5})],
    ids=["servo", "weak"],
)
def test_one_alone_has_the_bits_of_one_among_many(drive: str, randomisation: Any) -> None:
    def envs(count: int) -> Any:
        return gym.make_vec(
            "TPMPickAndPlaceDense-v0",
            num_envs=count,
            engine="analytic",
            drive=drive,
            randomisation=randomisation,
        )

    many, alone, rng = envs(9), envs(1), np.random.default_rng(0)
    many.reset(seed=0)
    alone.reset(seed=4)
    for _ in range(20):
        actions = rng.choice([-1.0, 0.0, 1.0], (9, 4)).astype(np.float32)
        observed, reward, *_ = many.step(actions)
        mine, mine_reward, *_ = alone.step(actions[4:5])
        for name, values in mine.items():
            np.testing.assert_array_equal(values[0], observed[name][4])
            assert np.isfinite(observed[name]).all()
        assert mine_reward[0] == reward[4]
        np.testing.assert_array_equal(alone.state.torque[0], many.state.torque[4])


def test_a_servo_goes_on_from_what_was_saved() -> None:
    simulation = SingleSimulation(Scene(objects=(Block(),)), drive=Servo())
    plant, way = plants_of(PAPER_TPM, 1)[0], list(commands(False, 12))
    simulation.reset(PAPER_TPM.inverse(PAPER_TPM.home), plant=plant)
    for command in way[:6]:
        simulation.move(command)
    saved = simulation.save()
    first = [simulation.move(command) for command in way[6:]]
    simulation.reset(PAPER_TPM.inverse(PAPER_TPM.home))
    simulation.restore(saved)
    again = [simulation.move(command) for command in way[6:]]
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.torque, other.torque)
        np.testing.assert_array_equal(one.platform_position, other.platform_position)
