"""A task that was written outside the package, with two objects."""

import importlib
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import pytest
from episodes import expert_episode
from registries import registries_put_back

import tpm_gym
from tpm_gym.envs.testing import check_env
from tpm_gym.errors import ConfigurationError, ResetOptionError, UnreachableError
from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.simulation import Block, Scene
from tpm_gym.tasks.task import Entry


@pytest.fixture(scope="module", autouse=True)
def sorting():
    """The task's file; what it registers is gone afterwards."""
    with registries_put_back("sorting"):
        yield importlib.import_module("sorting")


@pytest.fixture
def env():
    return gym.make("TPMSortDense-v0", render_mode="rgb_array")


def test_it_conforms():
    check_env(lambda: gym.make("TPMSortJointsDense-v0"))


@pytest.mark.parametrize(
    ("env_id", "machine"),
    [("TPMSort-v0", "paper"), ("TPMSortJoints-v0", "paper"), ("TPMSort-v0", "wide")],
)
def test_its_expert_sorts(env_id, machine):
    env = gym.make(env_id, machine=machine)
    for seed in range(5):
        *_, (_, _, info) = expert_episode(env, seed, steps=100)
        assert info["is_success"]


def test_its_own_terms_are_part_of_the_reward(env):
    env.reset(seed=0)
    info = env.step(np.ones(4))[4]
    assert set(info["reward_terms"]) == {"goal", "singularity", "tilt", "empty"}
    assert info["reward_terms"]["empty"] == -0.1


def test_the_worse_placed_block_decides(env):
    task, place = env.unwrapped.task, np.array([0.0, -0.03, 0.015, -0.1, -0.03, 0.018])
    both, red, blue = np.array([[1, 0, 0, 0, 1, 0], [1, 0, 0, 0, 0, 0], [0, 0, 0, 0, 1, 0]])
    offsets = [0.009 * both, 0.011 * red, 0.011 * blue]
    gaps = [task.gap(place + off, place) for off in offsets]
    assert [bool(task.success(gap)) for gap in gaps] == [True, False, False]


def test_users_place_the_blocks_by_name(env):
    red, blue = (0.05, -0.03, 0.015), (-0.05, -0.03, 0.018)
    goal = (0.0, -0.03, 0.015, -0.1, -0.03, 0.018)
    observation, _ = env.reset(options={"red": red, "blue": blue, "goal": goal})
    assert np.allclose(observation["desired_goal"], goal, atol=1e-6)
    assert np.allclose(env.unwrapped.goal, goal, atol=1e-6)
    assert np.allclose(observation["achieved_goal"], [*red, *blue], atol=1e-6)
    assert np.allclose(env.unwrapped.state.object_position, [red, blue], atol=1e-6)
    with pytest.raises(ResetOptionError, match="clear of blue"):
        env.reset(options={"red": red, "blue": (0.06, -0.03, 0.018)})
    with pytest.raises(ResetOptionError, match=r"'red', 'blue', 'goal'"):
        env.reset(options={"object": red})
    with pytest.raises(UnreachableError):  # each place for its own block
        env.reset(options={"goal": (0.0, -0.03, 0.015, 0.0, -0.03, 0.015)})


def test_the_blocks_are_drawn_in_their_colours(env):
    env.reset(seed=0, options={"red": (0.05, -0.03, 0.015), "blue": (-0.05, -0.03, 0.018)})
    r, g, b = env.render().astype(int).transpose(2, 0, 1)
    assert ((r > 2 * b) & (r > 2 * g)).sum() > 100
    assert ((b > 2 * r) & (b > 2 * g)).sum() > 100


def test_a_block_that_the_cup_cannot_come_down_to_is_refused(sorting):
    class Coin(sorting.Sort):
        scene = Scene((Block("coin", height=0.020), sorting.Sort.blue), markers=2)

    with pytest.raises(ConfigurationError, match=r"'coin'.*at least 0\.027 m high"):
        Coin(PAPER_TPM)
    with pytest.raises(ConfigurationError, match="a name of its own"):
        Scene((Block(), Block()), markers=2)


@pytest.mark.parametrize(
    ("part", "value", "message"),
    [
        ("goal_size", 4, "goal_size = 4 .*three for each point"),
        ("goal_size", 3, "markers = 2 .*valid: 1, .*markers=1"),
        ("achieved", lambda *_: np.zeros(3), r"achieved\(\) = .*\(3,\).*of shape \(n, 6\)"),
        ("shaping", lambda *_: None, r"shaping\(\) = None .*a dictionary"),
        ("observed", tpm_gym.tasks.Task.robot_entries, r"observed\(\) = .*'red_held'.*add obj"),
        ("vacuum", False, "vacuum = False .*: True: the plan of Wrong"),
    ],
)
def test_what_is_wrong_in_a_task_is_named(sorting, part, value, message):
    wrong = type("Wrong", (sorting.Sort,), {part: value})
    with pytest.raises(ConfigurationError, match=message):
        list(expert_episode(tpm_gym.TPMEnv(wrong), 0, steps=50))


def test_an_event_that_mixes_robots_is_named(sorting):
    class Wrong(sorting.Sort):
        events = ("fast",)

        def fast(self, state):
            return np.linalg.norm(state.fk_velocity) > 0.1

    with pytest.raises(ConfigurationError, match=r"fast\(\) = .*of shape \(\) .*reduce by axis=-1"):
        tpm_gym.TPMEnv(Wrong)


def test_an_event_is_a_truth_value_with_a_name_of_its_own(sorting):
    def speed(self, state):
        return np.linalg.norm(state.fk_velocity, axis=-1)

    def fast(self, state):
        return speed(self, state) > 0.1

    wrong = type("Wrong", (sorting.Sort,), {"events": ("speed",), "speed": speed})
    with pytest.raises(ConfigurationError, match=r"speed\(\) = .of type float64. .*bool"):
        tpm_gym.TPMEnv(wrong)
    wrong = type("Wrong", (sorting.Sort,), {"events": ("conditioning",), "conditioning": fast})
    with pytest.raises(ConfigurationError, match=r"events = .conditioning. .*names other than"):
        tpm_gym.TPMEnv(wrong)


def an_entry(scale, source):
    """Return observed() with a further entry."""

    def observed(self):
        centre = (0.0,) * len(scale)
        return (*self.robot_entries(), Entry("extra", "m", "-", centre, scale, source))

    return observed


@pytest.mark.parametrize(
    ("part", "value", "message"),
    [
        ("observed", an_entry((1.0,), lambda state: state.fk_position), r"'extra' = .*\(n, 1\)"),
        ("observed", an_entry((1.0,), lambda state: state.torque[:, 0]), r"'extra' = .*\(n, 1\)"),
        ("observed", an_entry((0.0,) * 3, lambda state: state.torque), "'extra', scale = .*other"),
        ("observed", an_entry((np.nan,) * 3, lambda state: state.torque), "'extra', scale = .*fin"),
        ("observed", lambda self: (), "at least one Entry"),
        ("gap", lambda self, a, b: np.zeros((len(a), 1)), r"gap\(\) = .*\(7, 1\).*\(n,\)"),
        ("sample", lambda *_: None, r"sample\(\) = None .*the keys"),
        ("tolerance", np.nan, "tolerance = nan .*positive"),
        ("tolerance", -0.01, "tolerance = -0.01 .*positive"),
        ("camera_delay", 1.5, "camera_delay = 1.5 .*whole number"),
        ("goal_size", 3.0, "goal_size = 3.0 .*three for each"),
        ("events", ("absent",), "'absent' .*methods"),
        ("events", ("tolerance",), "'tolerance' .*methods"),
        ("events", ("_hidden",), "'_hidden' .*begin with _"),
        ("events", ("final_obs",), "'final_obs' .*names other than"),
    ],
)
def test_values_that_would_go_wrong_later_are_refused_early(sorting, part, value, message):
    wrong = type("Wrong", (sorting.Sort,), {part: value})
    with pytest.raises(ConfigurationError, match=message):
        tpm_gym.TPMEnv(wrong, engine="analytic")


def test_an_event_has_one_value_for_each_robot(sorting):
    def both(self, state):
        return state.object_position[..., 2] > 0.1

    wrong = type("Wrong", (sorting.Sort,), {"events": ("both",), "both": both})
    with pytest.raises(ConfigurationError, match=r"both\(\) = .*\(7, 2\)"):
        tpm_gym.TPMEnv(wrong)


def test_where_there_is_no_room_sampling_says_so(sorting):
    class Crowd(sorting.Sort):
        def sample(self, rngs, chosen):
            with patch.object(sorting, "APART", 0.5):
                return super().sample(rngs, chosen)

    with pytest.raises(ConfigurationError, match=r"0\.5 m from red, blue"):
        tpm_gym.TPMEnv(Crowd)
