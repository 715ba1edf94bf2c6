"""Ids mean what they say; users add their own; importing the package imports little."""

import re

import gymnasium as gym
import pytest

import tpm_gym
from tpm_gym import TPMEnv, register_task
from tpm_gym.envs.ids import env_ids
from tpm_gym.errors import ConfigurationError
from tpm_gym.tasks import Conveyor, Crossing, Cycle, PickAndPlace, Push, Reach, Stack, Throw
from tpm_gym.tasks.registry import TASKS

_CLASSES = (Reach, PickAndPlace, Push, Stack, Throw, Conveyor, Crossing, Cycle)
TASK_CLASSES = {kind.__name__: kind for kind in _CLASSES}


class Lift(PickAndPlace):
    """A user's."""


def test_all_ids_are_registered_under_their_documented_names():
    assert set(tpm_gym.ENV_IDS) == {
        f"TPM{task}{control}{reward}-v0"
        for task, kind in TASK_CLASSES.items()
        for control in ("", "Joints")[: len(kind.controls)]
        for reward in ("", "Dense")
    }
    assert set(tpm_gym.ENV_IDS) <= set(gym.registry)


@pytest.mark.parametrize("env_id", tpm_gym.ENV_IDS)
def test_an_id_means_what_it_and_the_datasheet_say(env_id):
    env = gym.make(env_id, engine="analytic")  # which is made fastest
    inner = env.unwrapped
    name = re.fullmatch("TPM(.*?)(Joints)?(Dense)?-v0", env_id)[1]
    assert type(inner.task) is TASK_CLASSES[name]
    assert inner.task.reward == ("dense" if "Dense" in env_id else "sparse")
    control = "JointControl" if "Joints" in env_id else "CartesianControl"
    assert type(inner.control).__name__ == control
    sizes = [
        env.action_space.shape[0],
        *(env.observation_space[part].shape[0] for part in ("observation", "desired_goal")),
        env.spec.max_episode_steps,
    ]
    assert f"| {name} | {' | '.join(map(str, sizes))} |" in TPMEnv.__doc__


@pytest.mark.usefixtures("registries")
def test_a_users_task_gets_four_ids_and_a_name():
    ids = register_task("Lift", Lift, version=3, max_episode_steps=7)
    assert ids == ("TPMLift-v3", "TPMLiftDense-v3", "TPMLiftJoints-v3", "TPMLiftJointsDense-v3")
    assert tpm_gym.ENV_IDS[-4:] == ids
    assert len(tpm_gym.ENV_IDS) == 2 * sum(len(k.controls) for k in TASK_CLASSES.values()) + 4
    env = gym.make(ids[-1], machine="wide")
    assert type(env.unwrapped.task) is Lift
    assert env.spec.max_episode_steps == 7
    TPMEnv("lift")


@pytest.mark.usefixtures("registries")
def test_registering_twice_is_harmless_and_a_class_defined_anew_replaces_its_forerunner():
    for name, task in (("Reach", Reach), ("PickAndPlace", PickAndPlace), ("Lift", Lift)):
        register_task(name, task)
        before = dict(gym.registry)
        register_task(name, task)
        assert gym.registry == before
    anew = type("Lift", (Reach,), {"__module__": Lift.__module__})
    register_task("Lift", anew)
    env = gym.make("TPMLift-v0")
    assert type(env.unwrapped.task) is anew


@pytest.mark.parametrize(
    ("name", "task", "options", "blamed"),
    [
        ("Reach", Lift, {}, "name"),
        ("Reach", Reach, {"max_episode_steps": 100}, "name"),  # the ids' are 50
        ("ReachJoints", Lift, {}, "name"),  # its id is that of Reach with joints
        ("PickAndPlaceDense", Lift, {}, "name"),
        *((name, Lift, {}, "name") for name in ("lift", "", "Lift up", "Lift-v0", None, 3)),
        ("Lift", Lift(tpm_gym.mechanism.tpm.PAPER_TPM), {}, "task"),
        ("Lift", dict, {}, "task"),
        ("Lift", tpm_gym.tasks.Task, {}, "task"),
        *(("Lift", Lift, {"version": value}, "version") for value in (-1, 1.0, "1", None)),
        *(
            ("Lift", Lift, {"max_episode_steps": value}, "max_episode_steps")
            for value in (0, 50.0, "50", True)
        ),
    ],
)
@pytest.mark.usefixtures("registries")
def test_what_cannot_be_registered_is_refused_and_leaves_nothing(name, task, options, blamed):
    ids, tasks = dict(gym.registry), dict(TASKS)
    with pytest.raises(ConfigurationError) as caught:
        register_task(name, task, **options)
    assert caught.value.name == blamed
    assert (gym.registry, TASKS) == (ids, tasks)


def test_other_ids_are_not_taken_for_ours(registries):
    gym.register("Elsewhere-v0", entry_point="elsewhere:Env")
    assert "Elsewhere-v0" not in env_ids()
    with pytest.raises(AttributeError, match="ENV_IDX"):
        _ = tpm_gym.ENV_IDX
