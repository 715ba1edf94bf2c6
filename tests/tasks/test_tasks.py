"""Tasks are functions of a state, over any leading axes, that say what they need of a user."""

import pickle
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from machines import each_machine
from states import random_state

from tpm_gym import TPMEnv, TPMVectorEnv
from tpm_gym.errors import ConfigurationError, InputError, ResetOptionError, UnreachableError
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.tpm import PAPER_TPM, WIDE_TPM
from tpm_gym.simulation.state import Block, Scene, State
from tpm_gym.tasks import (
    Conveyor,
    Entry,
    PickAndPlace,
    Push,
    Reach,
    Stack,
    Task,
    Throw,
)
from tpm_gym.tasks.registry import make_task

BLOCK = PickAndPlace.block
HANGING = np.array([0.0, 0.0, CUP.length + BLOCK.height / 2])  # P above the centre of a held block


class TwoBlocks(PickAndPlace):
    """The second block beside the first, and a goal for both."""

    scene = Scene(objects=(Block(), Block(name="other", width=0.02, height=0.032)), markers=2)
    goal_size = 6

    def sample(self, rngs: Any, chosen: Any) -> Any:
        places = {"object": [0.0, -0.03, 0.015], "other": [0.05, -0.03, 0.016]}
        places["goal"] = 2 * [-0.05, -0.03, 0.1]
        return {name: np.tile(place, (len(rngs), 1)) for name, place in places.items()} | chosen

    def observed(self) -> Any:
        own = Entry("own", "m/s", "-", (1.0,), (2.0,), lambda state: state.belt_speed[:, None])
        return (own, *reversed(super().observed()))


@pytest.fixture(params=[Reach, PickAndPlace, TwoBlocks])
def task(request):
    made: Task = request.param(PAPER_TPM, "dense")
    return made


def states(task: Task, seed: int = 0, count: int = 1, **values: Any) -> State:
    given = {
        name: np.broadcast_to(value, (count, *np.shape(value))) for name, value in values.items()
    }
    return random_state(np.random.default_rng(seed), (count,), len(task.scene.objects), **given)


def rngs(*seeds: int) -> list[np.random.Generator]:
    return [np.random.default_rng(seed) for seed in seeds or (0,)]


def test_decode_is_the_inverse_of_observe(task):
    state, task = states(task, 1, 5), pickle.loads(pickle.dumps(task))
    decoded = task.decode(task.observe(state))
    expected = {
        "position": state.fk_position,
        "velocity": state.fk_velocity,
        "command": state.command - state.fk_position,
    }
    for index, block in enumerate(task.scene.objects):
        expected[f"{block.name}_position"] = state.object_position[:, index]
        expected[f"{block.name}_offset"] = task.top(state, index) - task.lip(state)
        expected[f"{block.name}_velocity"] = state.object_velocity[:, index]
        expected[f"{block.name}_tilt"] = state.object_axis[:, index, :2]
        share = np.where(state.held == index, state.vacuum / CUP.vacuum, 0.0)
        expected[f"{block.name}_held"] = share[:, None]
    for name, value in expected.items():
        np.testing.assert_allclose(decoded[name], value, atol=1e-12)
    assert set(decoded) == {entry.name for entry in task.entries}
    for wrong in ("seen", [10**400] * task.observation_size, [0.0]):
        with pytest.raises(InputError, match="observation"):
            task.decode(wrong)


def test_the_observation_never_reads_the_platform_of_the_simulator(task):
    state = states(task, 2)
    other = replace(state, platform_position=np.ones((1, 3)), platform_tilt=np.full(1, 9.0))
    np.testing.assert_array_equal(task.observe(other), task.observe(state))
    np.testing.assert_array_equal(task.achieved(other), task.achieved(state))


# -- reward ----------------------------------------------------------------------------------------


def test_the_reward_has_the_documented_terms():
    goal, near = np.array([0.03, 0.0, 0.04]), 1 - 0.5**4
    for kind, reward, names in (
        (Reach, "sparse", {"goal": -1.0, "singularity": -2 * near}),
        (Reach, "dense", {"goal": -0.5, "singularity": -2 * near}),
        (PickAndPlace, "sparse", {"goal": -1.0, "singularity": -2 * near}),
        (PickAndPlace, "dense", {"goal": -0.5, "singularity": -2 * near, "approach": -0.15}),
    ):
        task = kind(PAPER_TPM, reward, penalty_weight=2)
        upright = np.array([[0.0, 0.0, 1.0]] * len(task.scene.objects)).reshape(-1, 3)
        state = states(task, conditioning=0.04, object_axis=upright)
        below = state.fk_position - HANGING - (0.0, 0.0, 0.03)
        state = replace(state, object_position=below[:, None])
        gap, penalty = task.gap(np.zeros((1, 3)), goal), task.penalty(state)
        found = {name: v.item() for name, v in task.reward_terms(state, gap, penalty).items()}
        assert found == pytest.approx(names)


@pytest.mark.parametrize(
    ("kind", "place"),
    [
        (Conveyor, lambda task, state: task.top(state)),
        (Push, lambda task, state: state.object_position[:, 0]),
        (Stack, lambda task, state: task.top(state, 1)),
        (Throw, lambda task, state: task.top(state)),
    ],
)
def test_half_the_way_from_the_cup_to_the_block_costs(kind, place):
    task = kind(PAPER_TPM, "dense")
    state = states(task, object_position=np.full((len(task.scene.objects), 3), -0.1))
    way = np.linalg.norm(task.lip(state) - place(task, state), axis=1)
    assert task.shaping(state) == {"approach": pytest.approx(-0.5 * way / 0.1)}


@pytest.mark.parametrize("mode", ["assembly", "working"])
def test_a_mode_change_costs_the_whole_penalty(mode):
    task = Reach(PAPER_TPM)
    for conditioning in (0.0, 0.05, 0.3):
        state = states(task, conditioning=conditioning, **{f"{mode}_mode_changed": np.True_})
        penalty = task.penalty(state)
        assert task.reward_terms(state, np.zeros(1), penalty)["singularity"] == -penalty == -1


def test_sparse_rewards_follow_success():
    task = PickAndPlace(PAPER_TPM)
    for off, reward in ((0.0099, 0.0), (0.01, -1.0), (0.0101, -1.0), (np.nan, -1.0)):
        gap = task.gap((off, 0.0, 0.0), np.zeros(3))
        assert task.goal_term(gap) == reward
        assert task.success(gap) == (reward == 0.0)


@pytest.mark.parametrize("safe", [0.01, 0.08, 0.4, 1.0])
def test_the_penalty_falls_with_the_conditioning_steepest_at_the_threshold(safe):
    # Flat there, crossing it would cost nothing, and policies would not care.
    task, c = Reach(replace(PAPER_TPM, safe_conditioning=safe)), np.linspace(0.0, 1.0, 1001)
    penalty = task.penalty(replace(states(task, count=1001), conditioning=c))
    np.testing.assert_allclose(penalty, np.maximum(0.0, 1 - (c / safe) ** 4), atol=1e-12)


def test_an_object_is_lost_off_the_table_and_out_of_reach():
    task, near = TwoBlocks(PAPER_TPM), (0.0, -0.03, 0.015)
    kept = [
        near,
        (0.0, -0.03, 0.3),  # held, or falling
        (0.13, -0.03, 0.015),  # the cup takes it off its middle
    ]
    lost = [(0.2, -0.03, 0.015), (0.0, 0.03, 0.015), (0.0, -0.03, -0.5)]
    lost += (near + np.diag([np.nan] * 3)).tolist()
    rows = states(task, count=9)
    for order in (slice(None), slice(None, None, -1)):
        places = np.array([(near, place)[order] for place in kept + lost])
        found = task.lost(replace(rows, object_position=places))
        assert found.tolist() == [False] * 3 + [True] * 6
    assert not Reach(PAPER_TPM).lost(states(Reach(PAPER_TPM)))


# -- starts ----------------------------------------------------------------------------------------


def test_starts_repeat_with_the_rng_and_take_what_is_chosen(task):
    first, again = (task.start(rngs(7)) for _ in range(2))
    assert set(first) == {"goal", *(block.name for block in task.scene.objects)}
    for name, (place,) in first.items():
        np.testing.assert_array_equal(again[name], [place])
        chosen = task.start(rngs(8, 9), {name: place.tolist()})
        np.testing.assert_array_equal(chosen[name], [place, place])
    goal = first["goal"][0].copy()
    task.goals = "tempting"
    np.testing.assert_array_equal(task.start(rngs(8), {"goal": goal})["goal"], first["goal"])
    task.goals = "sampled"
    kept = task.start(rngs(7), {"goal": goal})["goal"]
    goal[:] = 0.0
    np.testing.assert_array_equal(kept, first["goal"])


@pytest.mark.parametrize("options", [{"gaol": (0, 0, 0)}, [("goal", (0, 0, 0))], {3: 4}, "goal"])
def test_unknown_options_are_refused_with_the_known_ones(task, options):
    with pytest.raises(ResetOptionError, match="'goal'") as caught:
        task.start(rngs(), options)
    assert all(block.name in str(caught.value) for block in task.scene.objects)
    with pytest.raises(ResetOptionError):  # Reach has no object
        Reach(PAPER_TPM).start(rngs(), {"object": (0.0, -0.03, 0.015)})


@pytest.mark.parametrize("name", ["goal", "object"])
def test_what_is_out_of_reach_is_refused_with_the_range_that_is_enforced(name):
    task = PickAndPlace(PAPER_TPM)
    low, high = task.reach_of(BLOCK)
    for place in ((0.0, -0.03, 0.0135), (0.0, -0.03, -0.3), (0.0, 0.2, 0.015), (1.0, -0.03, 0.1)):
        with pytest.raises(UnreachableError) as caught:
            task.start(rngs(), {name: place})
        assert caught.value.leg == "box"
        assert caught.value.margin < 0
        assert f"{name} must lie in {low.round(4).tolist()}" in str(caught.value)
        assert low[2] == 0.015
    for place in (low, high):
        np.testing.assert_array_equal(task.start(rngs(), {name: place})[name], [place])


@each_machine
def test_an_object_does_not_start_inside_the_robot(machine):
    task = PickAndPlace(machine)
    home = machine.mount.to_world(machine.home)
    touching = home - HANGING
    for place in (home, touching + (0, 0, 0.001), touching + (0.02, 0.0, 0.02)):
        with pytest.raises(ResetOptionError, match="clear of the robot at home") as caught:
            task.start(rngs(), {"object": place, "goal": touching})
        assert caught.value.name == "object"
    for place in (touching, home + (0.12, 0.0, 0.0)):
        task.start(rngs(), {"object": place})


def test_an_object_does_not_start_inside_another():
    task = TwoBlocks(PAPER_TPM)
    task.start(rngs(), {"object": (0.022, -0.03, 0.015)})  # they touch
    for name, place in (("object", (0.023, -0.03, 0.02)), ("other", (0.01, -0.04, 0.04))):
        with pytest.raises(ResetOptionError, match="clear of") as caught:
            task.start(rngs(), {name: place})
        assert caught.value.name == name


HOME = PAPER_TPM.mount.to_world(PAPER_TPM.home)


@pytest.mark.parametrize(
    ("sampled", "message"),
    [
        ({"other": None}, r"sample\(\) = \['object', 'goal'\] .*object, other, goal"),
        ({"obj": np.zeros((2, 3))}, r"sample\(\) = .*'obj'"),
        ({"goal": np.zeros((2, 3))}, r"sample\(\)\['goal'\] = (?s:.*)shape \(2, 6\)"),
        ({"goal": np.zeros(6)}, r"sample\(\)\['goal'\] = (?s:.*)shape \(2, 6\)"),
        ({"object": np.full((2, 3), np.nan)}, r"sample\(\)\['object'\] = (?s:.*)finite"),
        ({"other": np.array([(0.01, -0.03, 0.015)] * 2)}, r"\['object'\] = .*clear of other"),
        ({"other": np.array([(0.1, -0.03, 0.015), HOME])}, r"\['other'\] = .*clear of the robot"),
    ],
)
def test_a_task_that_samples_what_cannot_be_is_refused(sampled, message):
    class Careless(TwoBlocks):
        def sample(self, rngs, chosen):
            start = {**super().sample(rngs, chosen), **sampled}
            return {name: place for name, place in start.items() if place is not None}

    with pytest.raises(ConfigurationError, match=message) as caught:
        Careless(PAPER_TPM).start(rngs(0, 1))
    assert not isinstance(caught.value, ResetOptionError)


def test_a_sample_that_ignores_what_is_chosen_is_refused():
    class Deaf(Reach):
        def sample(self, rngs, chosen):
            return super().sample(rngs, {})

    task = Deaf(PAPER_TPM)
    task.start(rngs())
    with pytest.raises(ConfigurationError, match=r"sample\(\)\['goal'\] = .*as the user chose it"):
        task.start(rngs(), {"goal": (0.0, -0.03, 0.2)})


# -- checked when an environment is made -----------------------------------------------------------


@pytest.mark.parametrize("limits", [(1.0, 2.0), ((0, 1, 1), (1, 1, 1)), ((1, 1, np.nan),) * 2])
def test_accelerations_that_limit_nothing_sensible_are_refused(limits):
    wrong = type("Wrong", (Reach,), {"accelerations": limits})
    with pytest.raises(ConfigurationError, match="accelerations = "):
        TPMEnv(wrong)


@pytest.mark.parametrize(
    ("method", "value", "blamed"),
    [
        ("achieved", lambda task, state: state.fk_position[:, :2], "achieved()"),
        ("achieved", lambda task, state: state.fk_position - state.torque.mean(0), "achieved()"),
        ("achieved", lambda task, state: state.fk_position - state.torque[0], "achieved()"),
        ("observe", lambda task, state: Task.observe(task, state)[::-1], "observe()"),
        ("gap", lambda task, one, other: np.linalg.norm(np.subtract(one, other)), "gap()"),
        ("shaping", lambda task, state: {"goal": state.held * 0.0}, "shaping()"),
        ("shaping", lambda task, state: {"singularity": state.held * 0.0}, "shaping()"),
        ("shaping", lambda task, state: {"v": np.linalg.norm(state.fk_velocity)}, "shaping()['v']"),
        ("shaping", lambda task, state: {"v": state.fk_velocity}, "shaping()['v']"),
        ("shaping", lambda task, state: {"_goal": state.held * 0.0}, "shaping()"),
        ("shaping", lambda task, state: {3: state.held * 0.0}, "shaping()"),
        ("departures", lambda task, goals: goals, "departures()"),  # of the world, not the machine
        ("departures", lambda task, goals: np.zeros(3), "departures()"),
        ("departures", lambda task, goals: goals * np.nan, "departures()"),
        ("shaping", lambda task, state: {"v": state.torque.max() - state.torque[:, 0]},
         "shaping()['v']"),
    ],
)  # fmt: skip
def test_a_method_that_mixes_robots_is_refused_by_name(method, value, blamed):
    wrong = type("Wrong", (Reach,), {method: value})
    for make in (TPMEnv, TPMVectorEnv):
        with pytest.raises(ConfigurationError) as caught:
            make(wrong)
        assert caught.value.name == blamed


class Forgetful(Reach):
    """Its reward depends on the calls before."""

    calls = 0

    def shaping(self, state: State) -> Any:
        self.calls += 1
        return {"n": np.full(len(state.held), -float(self.calls))}


def test_a_task_that_remembers_is_refused_as_such():
    found = r"shaping\(\)\['n'\] = '-\d.0 among 7 robots, -\d.0 alone' .*store nothing in the task"
    with pytest.raises(ConfigurationError, match=found):
        TPMEnv(Forgetful, engine="analytic")


def test_a_task_without_a_scene_is_refused():
    with pytest.raises(ConfigurationError, match=r"scene = None .*a Scene; Scene\(\) has no obj"):
        TPMEnv(type("Sceneless", (Reach,), {"scene": None}), engine="analytic")


# -- made by name, copied --------------------------------------------------------------------------


def test_tasks_are_made_by_name_or_class_or_taken_as_they_are():
    by_name = make_task("pick_and_place", machine="wide", reward="dense", penalty_weight=2)
    assert (type(by_name), by_name.machine, by_name.reward) == (PickAndPlace, WIDE_TPM, "dense")
    assert by_name.penalty_weight == 2.0
    by_class = make_task(TwoBlocks, goals="tempting")
    assert (type(by_class), by_class.machine, by_class.goals) == (TwoBlocks, PAPER_TPM, "tempting")
    assert make_task(by_class) is by_class


@pytest.mark.parametrize(
    "options",
    [
        {"machine": "wide"},
        {"machine": PAPER_TPM},
        {"reward": "dense"},
        {"goals": "sampled"},
        {"penalty_weight": 0},
    ],
    ids=repr,
)
def test_a_task_that_is_made_takes_no_options(options):
    with pytest.raises(ConfigurationError, match="has its own") as caught:
        make_task(Reach(PAPER_TPM), **options)
    assert caught.value.name in options


@pytest.mark.parametrize("task", ["juggle", None, 3, dict, ["reach"]], ids=repr)
def test_what_is_no_task_is_refused(task):
    with pytest.raises(ConfigurationError, match=r"'pick_and_place', .*'reach'") as caught:
        make_task(task)
    assert caught.value.name == "task"


@each_machine
def test_blocks_of_a_stack_start_beside_each_other(machine):
    task = make_task("stack", machine)
    starts = task.start([np.random.default_rng(seed) for seed in range(3000)])
    gap = np.abs(starts["lower"] - starts["upper"])[:, :2].max(axis=1)
    assert (gap > task.scene.objects[0].width).all()
    for one, other in combinations((starts["lower"], starts["upper"], starts["goal"][:, :3]), 2):
        assert np.linalg.norm(one - other, axis=1).min() > 0.045 - 1e-9


def test_the_block_of_a_stack_that_is_farther_from_its_goal_decides():
    assert Stack(PAPER_TPM).gap(np.zeros(6), [0.03, 0, 0, 0, 0.04, 0]) == pytest.approx(0.04)
