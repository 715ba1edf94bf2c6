import numpy as np
import pytest
from states import random_state

from tpm_gym.errors import ConfigurationError, ResetOptionError, UnreachableError
from tpm_gym.kinematics import workspace
from tpm_gym.kinematics.workspace import TASK_REGION
from tpm_gym.mechanism.tree import CUP_LENGTH, DEFAULT_MOUNT
from tpm_gym.simulation.state import State
from tpm_gym.tasks import task as tasks
from tpm_gym.tasks.rewards import SAFE_CONDITIONING
from tpm_gym.tasks.task import MIN_SEPARATION, PickAndPlace, Reach

PUCK = PickAndPlace.puck


def pick(state, index):
    values = {
        name: np.asarray(value)[index] for name, value in vars(state).items() if value is not None
    }
    return State(mode_change=None, **values)


@pytest.fixture(params=["reach", "pick_and_place"])
def task(request):
    return tasks.make(request.param, "dense")


def test_every_function_of_a_state_accepts_a_batch(task):
    rng = np.random.default_rng(0)
    batch = random_state(rng, (4, 2))
    desired = rng.normal(size=(4, 2, 3))
    observed, achieved = task.observe(batch), task.achieved(batch)
    reward, success = task.goal_term(achieved, desired), task.success(achieved, desired)
    terms = task.state_terms(batch)
    assert observed.shape == (4, 2, task.observation_size)
    for index in np.ndindex(4, 2):
        one = pick(batch, index)
        assert np.array_equal(task.observe(one), observed[index])
        assert np.array_equal(task.achieved(one), achieved[index])
        assert task.goal_term(task.achieved(one), desired[index]) == reward[index]
        assert task.success(task.achieved(one), desired[index]) == success[index]
        for name, value in task.state_terms(one).items():
            assert value == terms[name][index]


def test_decode_is_the_inverse_of_observe(task):
    state = random_state(np.random.default_rng(1), (5,))
    decoded = task.decode(task.observe(state))
    assert np.allclose(decoded["position"], state.fk_position)
    assert np.allclose(decoded["velocity"], state.fk_velocity)
    assert np.allclose(decoded["command"], state.command - state.fk_position)
    if isinstance(task, PickAndPlace):
        assert np.allclose(decoded["object_position"], state.object_position)
        assert np.allclose(decoded["object_velocity"], state.object_velocity)
        assert np.allclose(decoded["holding"][:, 0], state.holding)


def test_the_observation_never_reads_the_platform_of_the_simulator(task):
    rng = np.random.default_rng(2)
    state = random_state(rng)
    values = dict(vars(state), platform_position=rng.normal(size=3), platform_tilt=9.0)
    assert np.array_equal(task.observe(State(**values)), task.observe(state))
    assert np.array_equal(task.achieved(State(**values)), task.achieved(state))


def test_the_offset_to_the_puck_vanishes_when_the_cup_touches_it():
    task = PickAndPlace()
    values = vars(random_state(np.random.default_rng(3)))
    values["object_axis"] = np.array([0.0, 0.0, 1.0])
    values["object_position"] = values["fk_position"] - (0, 0, CUP_LENGTH + PUCK.height / 2)
    decoded = task.decode(task.observe(State(**values)))
    assert np.allclose(decoded["object_offset"], 0.0, atol=1e-12)
    assert np.allclose(decoded["object_tilt"], 0.0)


def test_a_toppled_puck_shows_in_the_tilt():
    values = vars(random_state(np.random.default_rng(4)))
    values["object_axis"] = np.array([1.0, 0.0, 0.0])
    decoded = PickAndPlace().decode(PickAndPlace().observe(State(**values)))
    assert np.allclose(decoded["object_tilt"], [1.0, 0.0])


def safe(points):
    """Whether P at points (world) is in the region and well conditioned."""
    place = DEFAULT_MOUNT.to_paper(points)
    conditioned = workspace.conditioning_at(place) >= SAFE_CONDITIONING
    return TASK_REGION.contains(place) & conditioned


def test_reach_goals_are_safe_apart_from_home_and_spread():
    task, rng = Reach(), np.random.default_rng(5)
    goals = np.array([task.sample_goal(rng, None) for _ in range(400)])
    assert safe(goals).all()
    home = DEFAULT_MOUNT.to_world(task.home)
    assert np.linalg.norm(goals - home, axis=1).min() >= MIN_SEPARATION
    assert (np.ptp(goals, axis=0) > (0.25, 0.02, 0.18)).all()


def test_pick_and_place_samples_are_safe_and_half_on_the_table():
    task, rng = PickAndPlace(), np.random.default_rng(6)
    starts = np.array([task.sample_object(rng) for _ in range(400)])
    goals = np.array([task.sample_goal(rng, start) for start in starts])
    above = (0.0, 0.0, PUCK.height / 2 + CUP_LENGTH)
    assert safe(starts + above).all()
    assert safe(goals + above).all()
    assert np.allclose(starts[:, 2], PUCK.height / 2)
    assert np.linalg.norm(goals - starts, axis=1).min() >= MIN_SEPARATION
    on_table = np.isclose(goals[:, 2], PUCK.height / 2)
    assert 0.4 < on_table.mean() < 0.6
    assert goals[~on_table, 2].min() > PUCK.height / 2 + 0.02


def test_sampling_repeats_with_the_rng(task):
    def draw():
        rng = np.random.default_rng(7)
        start = task.sample_object(rng)
        return task.sample_goal(rng, start)

    assert np.array_equal(draw(), draw())


@pytest.mark.parametrize("value", ["here", (0.0, 1.0), (0.0, np.nan, 0.0), None, [[1, 2, 3]]])
def test_what_is_no_point_is_refused(task, value):
    with pytest.raises(ResetOptionError):
        task.check_goal(value)


def test_what_is_out_of_reach_is_refused_with_the_margin_and_the_limits(task):
    inside = task.sample_goal(np.random.default_rng(8), (0.0, 0.0, 0.0))
    assert np.array_equal(task.check_goal(inside), inside)
    with pytest.raises(UnreachableError, match="must lie between") as caught:
        task.check_goal(inside + (0.0, 0.2, 0.0))
    assert caught.value.margin < 0
    assert caught.value.leg == "box"


def test_the_checked_goal_is_a_copy(task):
    goal = task.sample_goal(np.random.default_rng(9), None)
    checked = task.check_goal(goal)
    goal[:] = 0.0
    assert not np.array_equal(checked, goal)


def test_an_object_below_the_table_is_refused():
    with pytest.raises(ResetOptionError):
        PickAndPlace().check_object((0.0, -0.03, 0.014))
    with pytest.raises(ResetOptionError):
        PickAndPlace().check_goal((0.0, -0.03, 0.0135))
    with pytest.raises(ResetOptionError):
        Reach().check_object((0.0, -0.03, 0.015))


def test_sparse_rewards_follow_success():
    task = PickAndPlace("sparse")
    goal = np.zeros(3)
    for gap, reward in ((0.0099, 0.0), (0.0101, -1.0)):
        assert task.goal_term((gap, 0.0, 0.0), goal) == reward
        assert task.success((gap, 0.0, 0.0), goal) == (reward == 0.0)
    assert task.state_terms(random_state(np.random.default_rng(10))) == {}


def test_unknown_tasks_and_rewards_are_refused():
    with pytest.raises(ConfigurationError):
        tasks.make("juggle", "sparse")
    with pytest.raises(ConfigurationError):
        tasks.make("reach", "none")
