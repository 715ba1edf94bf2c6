"""The industry's cycle: what the machine, the control, the gate and the timing of the way are."""

from contextlib import closing
from dataclasses import fields, replace

import gantry  # noqa: F401  registers a machine
import numpy as np
import pytest
from numpy.testing import assert_allclose

from tpm_gym import PAPER_TPM, WIDE_TPM, TPMEnv, TPMVectorEnv
from tpm_gym.errors import ConfigurationError, UnreachableError
from tpm_gym.mechanism.machine import find_machine
from tpm_gym.tasks import Expert
from tpm_gym.tasks.control import USABLE, Follower
from tpm_gym.tasks.cycle import CONTINUOUS, RISE, STROKE, Cycle
from tpm_gym.tasks.timing import timed

EFFORT = np.full(3, 100.0)
LOADS = (0.1, 1.0, 3.0)


def loaded(payload, machine=PAPER_TPM):
    return Cycle(replace(machine, payload=payload))


@pytest.mark.parametrize("payload", LOADS)
def test_the_payload_is_a_mass_at_p(payload):
    machine = replace(PAPER_TPM, payload=payload)
    motion = np.array([PAPER_TPM.inverse(PAPER_TPM.home), (1.0, 2.0, -1.0), (30.0, -20.0, 10.0)])
    expected = replace(PAPER_TPM.dynamics, payload=payload).torque(*motion)
    for torque in (machine.torque, machine.dynamics.torque):
        assert_allclose(torque(*motion), expected, rtol=1e-12)
    added = machine.mechanism.link("platform").mass - PAPER_TPM.mechanism.link("platform").mass
    assert added == pytest.approx(payload)


@pytest.mark.parametrize("payload", [-0.1, np.nan, "1"])
def test_what_is_no_payload_is_refused(payload):
    with pytest.raises(ConfigurationError, match="payload"):
        replace(PAPER_TPM, payload=payload)


def test_a_machine_without_room_for_the_way_is_refused():
    region = replace(PAPER_TPM.region, low=(-0.17, 0.012, 0.66))
    goals = replace(PAPER_TPM.goal_region, low=(-0.16, 0.016, 0.70))
    with pytest.raises(ConfigurationError, match=r"0\.305 m along x"):
        Cycle(replace(PAPER_TPM, region=region, goal_region=goals))


@pytest.mark.parametrize("machine", [PAPER_TPM, WIDE_TPM])
def test_episodes_lead_from_one_end_to_the_other(machine):
    with closing(TPMVectorEnv(Cycle, num_envs=40, engine="analytic", machine=machine)) as envs:
        envs.reset(seed=0)
        (part,) = envs._parts
        goals, starts = part.core.goals, part.core.simulation.state().platform_position
        assert_allclose(np.abs(goals - starts), np.tile((STROKE, 0.0, 0.0), (40, 1)), atol=1e-9)
        assert 10 < (goals[:, 0] > starts[:, 0]).sum() < 30
        points = machine.mount.to_paper(np.concatenate([starts, goals]))
        assert (machine.conditioning_at(points) >= machine.safe_conditioning).all()


def test_other_goals_than_the_ends_are_refused():
    with closing(TPMEnv(Cycle, engine="analytic")) as env:
        (low, high), _ = env.task.goals_of(None)
        goal = (low + high) / 2
        env.reset(options={"goal": goal})
        assert_allclose(env.goal, goal)
        for beside in ((0.01, 0.0, 0.0), (0.0, 0.0, 0.01), (0.0, 0.05, 0.0)):
            with pytest.raises(UnreachableError):
                env.reset(options={"goal": goal + beside})


def test_the_way_is_on_the_gate():
    task = loaded(0.1)
    for backwards in (False, True):
        path = task.gate(0.03, backwards)
        assert_allclose(np.abs(path[-1] - path[0]), (STROKE, 0.0, 0.0), atol=1e-12)
        assert np.ptp(path[:, 2]) == pytest.approx(RISE, abs=1e-5)
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        assert np.ptp(steps) < 1e-2 * steps.mean()


def test_a_film_shows_the_payload_and_the_gate():
    with closing(TPMEnv(Cycle, engine="analytic")) as env:
        env.reset(seed=0)
        ends, task = (env.goal, env.state.platform_position), env.task
        first, *rest = task.markers(env.goal)
        assert_allclose(np.sort([first, rest[-1]], axis=0), np.sort(ends, axis=0), atol=1e-9)
        assert max(point[2] for point in rest) == pytest.approx(first[2] + RISE, abs=1e-4)
        other, *_ = {solid.colour for solid in task.machine.mechanism.link("platform").solids} - {
            solid.colour for solid in PAPER_TPM.mechanism.link("platform").solids
        }
        assert other == "red"


@pytest.mark.parametrize("payload", LOADS)
def test_the_timing_uses_what_the_motors_have_and_no_more(payload):
    task = loaded(payload)
    assert task.machine.payload == payload
    path, most = task.gate(0.03), USABLE * EFFORT
    times, torques = timed(task.machine, path, CONTINUOUS * EFFORT, most)
    spans = np.diff(times)
    mean, peak = np.sqrt(spans @ torques**2 / times[-1]), np.abs(torques).max(axis=0)
    used = max((mean / (CONTINUOUS * EFFORT)).max(), (peak / most).max())
    assert used == pytest.approx(1.0, abs=1e-6)
    expected, inner = torques_at(task.machine, path, times), slice(5, -5)
    found = (torques[1:] + torques[:-1]) / 2
    assert np.abs(found - expected)[inner].max() < 3.0


def torques_at(machine, path, times, weight=True):
    """Torques at the inner points of a path that P passes at these times, by differences."""
    theta, spans = machine.inverse(path), np.diff(times)[:, None]
    rates = np.diff(theta, axis=0) / spans
    changes = np.diff(rates, axis=0) / ((spans[1:] + spans[:-1]) / 2)
    middle = (rates[1:] + rates[:-1]) / 2
    torques = machine.torque(theta[1:-1], middle, changes)
    return torques if weight else torques - machine.torque(theta[1:-1], 0 * middle, 0 * middle)


def test_no_timing_nearby_is_faster():
    """Time at equal heat, without weight, of the found timing and of others."""
    task = loaded(0.1)
    path = task.gate(0.03)
    times, _ = timed(task.machine, path, CONTINUOUS * EFFORT, 10 * EFFORT)

    def cost(times):
        torques, spans = torques_at(task.machine, path, times, weight=False), np.diff(times)
        heat = (torques**2).sum(axis=1) @ ((spans[1:] + spans[:-1]) / 2)
        return times[-1] * (heat / times[-1]) ** 0.25

    best, rng, s = cost(times), np.random.default_rng(0), np.linspace(0.0, 1.0, len(times))[1:]
    for _ in range(50):
        bumps = sum(a * np.sin(k * np.pi * s) for k, a in enumerate(rng.normal(0, 0.1, 4), start=1))
        other = np.concatenate([[0.0], np.cumsum(np.diff(times) * np.exp(bumps))])
        assert cost(other) > 0.999 * best


@pytest.mark.parametrize("control", ["cartesian", "joints"])
@pytest.mark.parametrize("engine", ["pybullet", "mujoco", "analytic"])
@pytest.mark.parametrize("machine", [PAPER_TPM, WIDE_TPM])
def test_the_expert_arrives_under_control(engine, control, machine):
    for drive in ("ideal", "servo"):
        with closing(TPMEnv(Cycle, control, engine=engine, drive=drive, machine=machine)) as env:
            expert, torques = Expert(env), []
            observation, info = env.reset(seed=3)
            for _ in range(env.task.max_episode_steps):
                observation, _, _, _, info = env.step(expert.act(observation))
                assert info["reward_terms"]["gate"] > -0.5
                torques.append(env.state.torque)
            assert info["is_success"]
            assert np.abs(env.state.platform_position - env.goal).max() < 1e-3
            assert np.sqrt(np.mean(np.square(torques), axis=0)).max() < 40.0


def test_below_the_gate_costs():
    task = loaded(0.1)
    path = task.gate(0.03)
    with closing(TPMEnv(task, engine="analytic")) as env:
        env.reset(seed=0)
        state = env._core.simulation.state()
    for depth, cost in ((-0.01, 0.0), (0.0, 0.0), (0.002, 0.0), (0.007, 1.0), (0.022, 4.0)):
        point = path[60] + (0.0, 0.0, depth)
        state.fk_position = task.machine.mount.to_world(point)[None]
        assert task.shaping(state)["gate"][0] == pytest.approx(-cost, abs=1e-3)


def test_a_dense_reward_is_steeper_near_the_goal():
    for reward, expected in (("sparse", (0.0, -1.0)), ("dense", (-0.01 - 0.1, -1.0 - 1.0))):
        assert_allclose(Cycle(PAPER_TPM, reward).goal_term(np.array([0.001, 0.1])), expected)


@pytest.mark.parametrize("seed", range(3))
def test_commands_ask_no_more_than_the_motors_have(seed):
    """Accelerations at random: within the limits and the region, and torques that are there."""
    task = loaded(0.1)
    machine, period = task.machine, task.control_period
    follower = Follower(machine, *task.accelerations, period)
    rng = np.random.default_rng(seed)
    low, high = np.array(machine.region.low), np.array(machine.region.high)
    before = current = np.tile(machine.home, (50, 1))
    change = np.array(task.accelerations[0]) * period**2
    kept, there = [], []
    for step in range(200):
        if step % 5 == 0:
            wish = rng.choice([-0.02, 0.0, 0.02], (50, 3)) * (1.0, 0.025, 1.0)
        wanted = np.clip(current + wish, low, high)
        enough = np.abs(follower._torques(before, current, wanted[None])[0]) <= EFFORT
        assert (follower.feasible(before, current, wanted) == enough.all(axis=1)).all()
        then = follower.limit(wanted, current, before)
        assert ((then >= low) & (then <= high)).all()
        kept.append(np.abs(then - 2 * current + before) <= change * (1 + 1e-6))
        there.append(np.abs(follower._torques(before, current, then[None])) <= EFFORT)
        before, current = current, then
    assert np.mean(kept) > 0.99
    assert np.mean(there) > 0.99


def test_commands_brake_as_stated_and_stop_at_the_ends_of_the_region():
    task = loaded(0.1)
    region, home = task.machine.region, np.array(task.machine.home)
    follower = Follower(task.machine, *task.accelerations, task.control_period)
    ends = np.concatenate([np.where(np.eye(3), end, home) for end in (region.low, region.high)])
    rows = [np.tile(home, (6, 1))] * 2
    for _ in range(300):
        rows.append(follower.limit(ends, rows[-1], rows[-2]))
    assert_allclose(rows[-1], ends, atol=1e-12)
    changes = np.diff(rows, 2, axis=0) * np.sign(ends - home) / task.control_period**2
    assert (changes > -1.2 * np.array(task.accelerations[1])).all()


def test_a_mechanism_without_the_payload_is_refused():
    class Empty(type(PAPER_TPM)):
        mechanism = PAPER_TPM.mechanism

    values = {field.name: getattr(PAPER_TPM, field.name) for field in fields(PAPER_TPM)}
    with pytest.raises(ConfigurationError, match="contains its payload"):
        Cycle(Empty(**values))


def test_every_machine_carries_the_payload():
    for name in ("paper", "wide", "delta", "gantry"):
        machine = find_machine(name)
        at = machine.inverse(machine.home), np.zeros(3)
        one, none = (replace(machine, payload=mass).motion(*at) for mass in (1.0, 0.0))
        pull = np.linalg.inv(none.jacobian)
        assert_allclose(pull.T @ (one.mass - none.mass) @ pull, np.eye(3), atol=2e-3)
