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
from tpm_gym.tasks import Motion, hanging
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


def test_a_name_instead_of_a_block_is_refused(sorting):
    task, moves = sorting.Sort(PAPER_TPM), Motion(PAPER_TPM, None)
    for use in (hanging, task.on_table, lambda block: next(moves.pick(block, 0.03))):
        with pytest.raises(ConfigurationError, match=r"block = 'red' .*Block, not its name"):
            use("red")


def test_goals_outside_the_observation_space_are_refused(sorting):
    class Astray(sorting.Sort):
        far = 0.0

        def sample(self, rngs, chosen):
            starts = super().sample(rngs, chosen)
            return {**starts, "goal": starts["goal"] + self.far}

    env = tpm_gym.TPMEnv(Astray, engine="analytic")
    env.reset(seed=0)
    env.task.far = 5.0
    with pytest.raises(ConfigurationError, match=r"sample\(\)\['goal'\] = .*-2 to 2 m"):
        env.reset(seed=0)
    env.task.far = 0.0
    env.reset(seed=0)


def event(name, happens):
    """Return the attributes of a task with an event."""
    return {"events": (name,), name: lambda self, state: happens(state)}


def an_entry(scale, source, columns=None):
    """Return observed() with a further entry."""

    def observed(self):
        centre = (0.0,) * len(scale)
        return (*self.robot_entries(), Entry("extra", "m", "-", centre, scale, source, columns))

    return {"observed": observed}


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"goal_size": 4}, "goal_size = 4 .*three for each point"),
        ({"goal_size": 3}, "markers = 2 .*valid: 1, .*markers=1"),
        ({"goal_size": 3.0}, "goal_size = 3.0 .*three for each"),
        *(({"tolerance": v}, f"tolerance = {v!r} .*positive") for v in (np.nan, -0.01, "x")),
        *(({"camera_delay": v}, f"camera_delay = {v} .*whole .*0 or more") for v in (-1, 1.5)),
        ({"achieved": lambda *_: np.zeros(3)}, r"achieved\(\) = .*\(3,\).*of shape \(n, 6\)"),
        ({"gap": lambda self, a, b: np.zeros((len(a), 1))}, r"gap\(\) = .*\(7, 1\).*\(n,\)"),
        ({"sample": lambda *_: None}, r"sample\(\) = None .*the keys"),
        ({"shaping": lambda *_: None}, r"shaping\(\) = None .*a dictionary"),
        ({"shaping": lambda _, state: {"a": [0.0] * len(state.held)}}, "an array"),
        ({"vacuum": False}, "vacuum = False .*: True: the plan of Wrong"),
        ({"observed": lambda self: ()}, "at least one Entry"),
        ({"observed": tpm_gym.tasks.Task.robot_entries}, r"observed\(\) = .*'red_held'.*add obj"),
        (an_entry((1.0,), lambda state: state.fk_position), r"'extra' = .*\(n, 1\)"),
        (an_entry((1.0,), lambda state: state.torque[:, 0]), r"'extra' = .*\(n, 1\)"),
        (an_entry((1.0,) * 2, lambda state: state.torque, (2, 4)), r"'extra' = .*\(n, 2\)"),
        (an_entry((0.0,) * 3, lambda state: state.torque), "'extra', scale = .*other"),
        (an_entry((np.nan,) * 3, lambda state: state.torque), "'extra', scale = .*fin"),
        *(({"events": (name,)}, f"'{name}' .*methods") for name in ("absent", "tolerance")),
        ({"events": ("_hidden",)}, "'_hidden' .*begin with _"),
        *(
            ({"events": (name,)}, f"'{name}' .*names other than")
            for name in ("randomisation", "final_obs", "final_info", "episode")
        ),
        (event("conditioning", lambda state: state.held < 0), "'conditioning' .*names other than"),
        (
            event("fast", lambda state: np.linalg.norm(state.fk_velocity) > 0.1),
            r"fast\(\) = .*of shape \(\) .*reduce by axis=-1",
        ),
        (event("speed", lambda state: state.fk_velocity[:, 0]), r"speed\(\) = .*float64. .*bool"),
        (
            event("both", lambda state: state.object_position[..., 2] > 0.1),
            r"both\(\) = .*\(7, 2\)",
        ),
    ],
)
def test_what_is_wrong_in_a_task_is_named(sorting, attributes, message):
    wrong = type("Wrong", (sorting.Sort,), attributes)
    with pytest.raises(ConfigurationError, match=message):
        list(expert_episode(tpm_gym.TPMEnv(wrong, engine="analytic"), 0, steps=50))


def test_where_there_is_no_room_sampling_says_so(sorting):
    class Crowd(sorting.Sort):
        def sample(self, rngs, chosen):
            with patch.object(sorting, "APART", 0.5):
                return super().sample(rngs, chosen)

    with pytest.raises(ConfigurationError, match=r"0\.5 m from red, blue"):
        tpm_gym.TPMEnv(Crowd)
