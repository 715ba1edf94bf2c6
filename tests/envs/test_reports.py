"""What an environment reports of a state: in its space, of its own, and consistent."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from states import random_state

from tpm_gym.envs import reports
from tpm_gym.simulation.state import State
from tpm_gym.tasks import rewards
from tpm_gym.tasks import task as tasks
from tpm_gym.tasks.task import Task

GOAL = np.array([0.01, -0.03, 0.1])


@pytest.fixture(params=["reach", "pick_and_place"])
def task(request: pytest.FixtureRequest) -> Task:
    return tasks.make(request.param, "dense")


def some_state(seed: int = 0, **changes: Any) -> State:
    state = random_state(np.random.default_rng(seed))
    return replace(state, **{"conditioning": 0.05, "holding": True, **changes})


def report(task: Task, state: State, weight: float = 1.0) -> dict[str, Any]:
    return reports.info(task, state, reports.observation(task, state, GOAL), weight)


def test_observations_are_in_their_space_however_wild_the_state(task: Task) -> None:
    space = reports.observation_space(task)
    assert set(space.spaces) == {"observation", "achieved_goal", "desired_goal"}
    assert space["observation"].shape == (task.observation_size,)
    for size in (1.0, 1e3, 1e30):
        state = some_state()
        wild = replace(state, fk_position=size * state.fk_position, fk_velocity=[-size] * 3)
        assert space.contains(reports.observation(task, wild, GOAL))


def test_clipping_leaves_what_is_inside_as_it_is(task: Task) -> None:
    state = some_state()
    seen = reports.observation(task, state, GOAL)
    exact = task.observe(state)
    inside = np.abs(exact) < 10
    assert inside.any()
    np.testing.assert_array_equal(seen["observation"][inside], exact[inside].astype(np.float32))
    np.testing.assert_array_equal(seen["observation"][~inside], 10 * np.sign(exact[~inside]))


def test_observations_are_copies(task: Task) -> None:
    state, goal = some_state(), GOAL.copy()
    seen = reports.observation(task, state, goal)
    before = {name: np.copy(value) for name, value in vars(state).items() if value is not None}
    for array in seen.values():
        assert array.dtype == np.float32
        array[:] = 9.0
    np.testing.assert_array_equal(goal, GOAL)
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(state, name), value)


def test_terms_and_flags_are_plain_and_follow_the_state(task: Task) -> None:
    info = report(task, some_state(closure_error=2e-5), weight=2.0)
    penalty = float(rewards.singularity_penalty(0.05))
    assert 0 < penalty < 1
    assert (info["conditioning"], info["closure_error"]) == (0.05, 2e-5)
    assert info["singularity_penalty"] == penalty
    assert info["reward_terms"]["singularity"] == -2 * penalty
    assert ("approach" in info["reward_terms"]) == (task.action_size == 4)
    assert info["assembly_mode_changed"] is info["working_mode_changed"] is False
    flags = ("is_success", "assembly_mode_changed", "working_mode_changed")
    assert all(type(info[name]) is bool for name in flags)
    assert all(type(term) is float for term in info["reward_terms"].values())


@pytest.mark.parametrize("mode", ["assembly", "working"])
@pytest.mark.parametrize("conditioning", [0.0, 0.05, 0.3])
def test_a_mode_change_is_flagged_and_costs_the_whole_penalty(
    task: Task, mode: str, conditioning: float
) -> None:
    info = report(task, some_state(mode_change=mode, conditioning=conditioning))
    assert info["assembly_mode_changed"] is (mode == "assembly")
    assert info["working_mode_changed"] is (mode == "working")
    assert info["singularity_penalty"] == 1
    assert info["reward_terms"]["singularity"] == -1


@pytest.mark.parametrize("weight", [0.0, 0.5, 3.0])
def test_goal_free_reward_is_all_but_the_goal_term(task: Task, weight: float) -> None:
    info = report(task, some_state(), weight)
    terms = info["reward_terms"]
    rest = reports.goal_free_reward(info, weight)
    assert rest == pytest.approx(sum(terms.values()) - terms["goal"], abs=1e-12)
    assert reports.goal_free_reward({}, weight) == 0


def test_success_is_judged_by_what_is_observed() -> None:
    task = tasks.make("reach", "sparse")
    for gap, success in ((0.0099, True), (0.0101, False)):
        info = report(task, some_state(fk_position=GOAL + (gap, 0.0, 0.0)))
        assert info["is_success"] is success
        assert info["reward_terms"]["goal"] == (0.0 if success else -1.0)
