"""Near the singularities, and through them on purpose: detected, reported, never trained on."""

from collections.abc import Callable
from dataclasses import replace

import inside
import numpy as np
import pytest
from episodes import fingerprint, random_episode
from states import apart

from tpm_gym import TPMEnv
from tpm_gym.arrays import Vector
from tpm_gym.errors import ClosureError, EpisodeError, ModeChangeError, UnreachableError
from tpm_gym.kinematics.geometry import PAPER
from tpm_gym.kinematics.modes import AssemblyMode
from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.mechanism.tpm.dynamics import Dynamics
from tpm_gym.simulation import Scene, Servo, State
from tpm_gym.simulation.simulation import Simulation

HOME = PAPER_TPM.home
THETA = PAPER_TPM.inverse(HOME)
IDLE = np.zeros(3)


@pytest.fixture
def env():
    return TPMEnv("reach")


def true_y(state: State) -> float:
    """Of the simulated platform, machine's frame, m."""
    return -float(state.platform_position[1])


def push(env: TPMEnv, force: Vector) -> Callable[[], None]:
    """Let a force (N, machine's frame) act on the platform from now on; returns what ends it."""
    simulation, world = env.simulation, env.machine.mount.rotate(force)
    return inside.around_each_step(simulation, lambda: inside.push(simulation, world)).close


# -- y = 0: the parallel singularity ---------------------------------------------------------------


@pytest.mark.parametrize("step", [0.0005, 0.002, 0.005, 0.010])
@pytest.mark.parametrize("x", [-0.20, -0.04, 0.10])
def test_commands_through_the_plane_are_followed_until_the_step_that_reports_it(
    simulation, x, step
):
    # Far more than any action may ask for: 0.25 m/s along y.
    start = min(0.028, 20 * step)
    state = simulation.reset(PAPER_TPM.inverse((x, start, 0.80)))
    for y in np.arange(start, -0.03, -step):
        if state.passed_singularity:
            break
        assert true_y(state) > 0
        assert apart(state) < 0.5e-3  # 0.2 mm seen
        assert state.closure_error < 0.1e-3
        state = simulation.move((x, y, 0.80))
    # Reported at the very step, when forward kinematics are still off by the last step only.
    assert (state.assembly_mode_changed, state.working_mode_changed) == (True, False)
    assert true_y(state) <= 0
    assert state.fk_position[1] < 0  # what the encoders believe: still on the other side


def test_once_reported_the_change_stays_reported_and_a_reset_forgets_it(simulation):
    simulation.reset(THETA)
    for y in (0.018, 0.008, -0.002, -0.012):
        simulation.move((HOME[0], y, HOME[2]))
    for y in (-0.012, -0.002, 0.008, 0.018, 0.018):
        state = simulation.move((HOME[0], y, HOME[2]))
    assert true_y(state) > 0  # it is on its own side again
    snapshot = simulation.save()
    assert simulation.read().assembly_mode_changed
    state = simulation.reset(THETA)
    assert not state.passed_singularity
    assert apart(state) < 1e-6
    assert not simulation.move(HOME).passed_singularity
    assert simulation.restore(snapshot).assembly_mode_changed
    assert simulation.move(HOME).assembly_mode_changed


@pytest.mark.parametrize("force", [120.0, 800.0])
@pytest.mark.parametrize("task", ["reach", "pick_and_place"])
def test_a_disturbance_through_the_plane_ends_the_episode_and_the_next_reset_recovers(task, force):
    env, fresh = TPMEnv(task), TPMEnv(task)
    idle = np.zeros(env.task.action_size)
    env.reset(seed=3)
    release = push(env, (0.0, -force, 0.0))
    for _ in range(50):
        observation, reward, terminated, truncated, info = env.step(idle)
        assert env.observation_space.contains(observation)
        assert not terminated
        assert info["assembly_mode_changed"] is truncated is (true_y(env.state) <= 0)
        assert info["working_mode_changed"] is False
        if truncated:
            break
        assert apart(env.state) < 2e-3
        assert info["singularity_penalty"] < 1
    assert truncated
    assert info["singularity_penalty"] == 1
    assert info["reward_terms"]["singularity"] == -1
    assert reward == pytest.approx(sum(info["reward_terms"].values()))
    release()
    with pytest.raises(ModeChangeError, match="reset"):
        env.step(idle)
    with pytest.raises(ModeChangeError, match="reset"):  # nor can one go on after that
        env.step(idle)
    assert fingerprint(random_episode(env, 4)) == fingerprint(random_episode(fresh, 4))


# -- y = l7: the serial singularity ----------------------------------------------------------------


def test_commands_towards_the_edge_are_followed_and_beyond_it_refused(simulation):
    simulation.reset(THETA)
    ways = [0.030, 0.035, 0.040, 0.045, 0.048, 0.049, 0.0495, *[0.0499] * 5]
    states = [simulation.move((HOME[0], y, HOME[2])) for y in ways]
    assert not any(state.passed_singularity for state in states)
    # Seen: gaps to 0.011 mm, forward kinematics to 0.005 mm; conditioning from 0.30 at 46.5 mm
    # down to 0.071 at 49.9 mm.
    assert max(state.closure_error for state in states) < 0.03e-3
    assert max(apart(state) for state in states) < 0.02e-3
    assert true_y(states[-1]) == pytest.approx(0.0499, abs=1e-6)
    assert states[-1].conditioning == pytest.approx(0.071, abs=0.001)
    assert max(state.conditioning for state in states) == pytest.approx(0.30, abs=0.01)
    before = simulation.read()
    for beyond in (1e-3, 0.1):
        with pytest.raises(UnreachableError) as caught:
            simulation.move((HOME[0], PAPER.l7 + beyond, HOME[2]))
        assert caught.value.leg.startswith("beta")
        assert caught.value.margin < 0
    after = simulation.read()
    assert np.array_equal(before.theta, after.theta)
    assert np.array_equal(before.command, after.command)
    assert not simulation.move((HOME[0], 0.0499, HOME[2])).passed_singularity


@pytest.mark.parametrize("force", [500.0, 1000.0])
def test_a_platform_pushed_over_the_edge_is_a_change_of_the_working_mode(force):
    env = TPMEnv("reach", machine=replace(PAPER_TPM, home=(-0.04, 0.045, 0.80)))
    fresh = fingerprint(random_episode(env, 6))
    env.reset(seed=0)
    release = push(env, (0.0, force, 0.0))
    for _ in range(50):
        _, _, terminated, truncated, info = env.step(IDLE)
        assert not terminated
        assert apart(env.state) < 1e-3  # link 7 is past its turning point, P still known
        if truncated:
            break
    assert (info["working_mode_changed"], info["assembly_mode_changed"]) == (True, False)
    assert info["singularity_penalty"] == 1
    release()
    with pytest.raises(ModeChangeError, match="working") as caught:
        env.step(IDLE)
    assert caught.value.mode == "working"
    assert fingerprint(random_episode(env, 6)) == fresh


# -- through y = 0 by inertia ----------------------------------------------------------------------


def cross(engine: str, step: float, drive: Servo | None = None, pause: int = 0) -> State:
    """Command P from y = 28 mm to -28 mm in equal steps, wait there, and read the state."""
    simulation = Simulation(Scene(), engine=engine, drive=drive)
    simulation.reset(np.array([0]), THETA)
    way = np.arange(0.028, -0.028, -step)
    middle = int(np.abs(way).argmin())
    for y in (*way[:middle], *[0.0] * pause, *way[middle:], *[-0.028] * 15):
        simulation.move(np.array([[HOME[0], y, HOME[2]]]), np.zeros(1, dtype=np.bool_))
    state = simulation.state().take(0)
    simulation.close()
    return state


@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
@pytest.mark.parametrize("step", [0.0005, 0.002, 0.005, 0.010])
def test_point_p_coasts_through_the_plane_and_arrives_behind_it(engine, step):
    state = cross(engine, step)
    assert state.assembly_mode_changed
    assert true_y(state) == pytest.approx(-0.028, abs=1e-6)
    assert state.fk_position[1] == pytest.approx(-0.028, abs=1e-6)  # the mirror image


@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
def test_a_stop_in_the_plane_leaves_the_side_to_chance(engine):
    assert true_y(cross(engine, 0.005, pause=20)) == pytest.approx(0.028, abs=1e-6)


@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
@pytest.mark.parametrize(("step", "side"), [(0.002, -1), (0.010, 1)])
def test_servo_drives_pass_slowly_and_turn_back_at_250_mm_per_s(engine, step, side):
    state = cross(engine, step, Servo())
    assert true_y(state) == pytest.approx(side * 0.028, abs=1e-5)


@pytest.mark.parametrize("speed", [-0.125, -0.25, -0.5])
@pytest.mark.parametrize(("acceleration", "finite"), [(0.0, True), (1.0, False), (-1.0, False)])
def test_torques_stay_finite_in_the_plane_only_without_acceleration_along_y(
    speed, acceleration, finite
):
    found = []
    for time in (-4e-3, -1e-3, 1e-3, 4e-3):
        times = time + np.array([-1e-5, 0.0, 1e-5])
        y = speed * times + acceleration * times**2 / 2
        points = np.stack([np.full(3, HOME[0]), y, np.full(3, HOME[2])], axis=1)
        before, theta, after = PAPER_TPM.inverse(points)
        # The dynamics of the side where P is.
        branch = AssemblyMode(PAPER_TPM.assembly_mode.planar, 1 if y[1] > 0 else -1)
        dynamics = Dynamics(
            geometry=PAPER_TPM.geometry, branch=branch, free_fall=PAPER_TPM.mount.free_fall
        )
        rates, changes = (after - before) / 2e-5, (after - 2 * theta + before) / 1e-10
        found.append(np.abs(dynamics.torque(theta, rates, changes)).max())
    # 1 ms from the plane; with an acceleration in proportion to 1 / y
    assert max(found) < 8 if finite else max(found) > 40


# -- forces that no machine would stand ------------------------------------------------------------


def test_a_loop_torn_open_is_a_typed_error_and_the_next_reset_recovers(env):
    fresh = fingerprint(random_episode(env, 7))
    env.reset(seed=0)
    release = push(env, (0.0, 0.0, 3000.0))
    with pytest.raises(ClosureError, match="reset") as caught:
        env.step(IDLE)
    assert caught.value.gap > caught.value.limit == 0.005
    release()
    with pytest.raises(EpisodeError, match="reset"):
        env.step(IDLE)
    assert fingerprint(random_episode(env, 7)) == fresh


def test_no_push_goes_unnoticed(env):
    """Hard or soft, from any side: until something is reported, P is where the encoders say."""
    rng = np.random.default_rng(0)
    outcomes = set()
    for _ in range(60):
        direction = rng.normal(size=3)
        force = 10 ** rng.uniform(1.5, 4.5) * direction / np.linalg.norm(direction)
        env.reset(seed=0)
        release = push(env, tuple(force.tolist()))
        outcome = "held"
        for _ in range(5):
            try:
                _, _, _, truncated, info = env.step(rng.uniform(-1, 1, 3))
            except ClosureError:
                outcome = "torn"
                break
            if truncated:
                outcome = "assembly" if info["assembly_mode_changed"] else "working"
                break
            assert apart(env.state) < 10e-3
            assert 0 < true_y(env.state) < PAPER.l7 + 1e-4
        release()
        outcomes.add(outcome)
    assert {"held", "torn", "assembly"} <= outcomes
