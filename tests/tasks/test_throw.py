"""Throw: blocks slide to goals that the cup cannot reach."""

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from episodes import expert_episode
from machines import each_machine
from states import random_state

from tpm_gym.errors import ConfigurationError, UnreachableError
from tpm_gym.mechanism import PAPER_TPM, WIDE_TPM
from tpm_gym.tasks import Throw

each_engine = pytest.mark.parametrize("engine", ["pybullet", "mujoco", "analytic"])


def thrown(env: Any, seed: int, **options: Any) -> tuple[Any, Any]:
    """Final distance from the goal (3,) m, and positions and velocities (k, 2, 3) of the block."""
    rows = []
    for last in expert_episode(env, seed, Throw.max_episode_steps, options or None):
        state = env.unwrapped.state
        rows.append((state.object_position[0], state.object_velocity[0]))
        observation, _, info = last
    miss = observation["achieved_goal"] - observation["desired_goal"]
    assert info["is_success"] == (np.linalg.norm(miss) < Throw.tolerance)
    return miss, np.array(rows)


@each_engine
@each_machine
@pytest.mark.parametrize("episodes", [20, pytest.param(200, marks=pytest.mark.slow)])
def test_the_expert_throws_to_within_a_fourth_of_the_tolerance(engine, machine, episodes):
    env = gym.make("TPMThrow-v0", engine=engine, machine=machine)
    low, high = env.unwrapped.task.reach_of(Throw.block)
    ends = set()
    for seed in range(episodes):
        miss, rows = thrown(env, seed)
        assert np.linalg.norm(miss) < Throw.tolerance / 4
        assert np.linalg.norm(rows[-1, 1]) < 1e-3
        place = rows[-1, 0, 0]
        assert place < low[0] - 0.03 or place > high[0] + 0.03
        ends.add(bool(place > high[0]))
    assert ends == {False, True}


@each_machine
def test_tempting_ways_are_only_just_safe(machine):
    env = gym.make("TPMThrow-v0", engine="analytic", machine=machine, goals="tempting")
    for seed in range(6):
        *steps, (_, _, info) = expert_episode(env, seed, Throw.max_episode_steps)
        least = min(info["conditioning"] for _, _, info in steps) / machine.safe_conditioning
        assert info["is_success"]
        assert 0.95 < least < 1.1


SLOW = replace(PAPER_TPM, step_limit=(0.022, 0.005, 0.030))  # too slow for the longest throws


@pytest.mark.parametrize("machine", [PAPER_TPM, WIDE_TPM, SLOW])
def test_the_expert_throws_to_the_ends_of_the_range(machine):
    env = gym.make("TPMThrow-v0", engine="analytic", machine=machine)
    y = machine.mount.to_world(machine.home)[1]
    for box in env.unwrapped.task.goals_of(Throw.block):
        for corner in box:
            miss, _ = thrown(env, 0, goal=(corner[0], y, corner[2]))
            assert np.linalg.norm(miss) < Throw.tolerance / 4


@each_machine
def test_goals_out_of_throwing_range_are_refused_with_the_range(machine):
    task, rng = Throw(machine), [np.random.default_rng(0)]
    (left, start), (stop, right) = task.goals_of(Throw.block)
    inside = machine.mount.to_world(machine.home)
    y, level = inside[1], Throw.block.height / 2
    low, high = task.reach_of(Throw.block)
    assert start[0] == pytest.approx(low[0] - 0.04)
    assert stop[0] == pytest.approx(high[0] + 0.04)
    wrong = [start[0] + 1e-5, stop[0] - 1e-5, left[0] - 1e-5, right[0] + 1e-5, inside[0]]
    for place in (*((x, y, level) for x in wrong), (stop[0], 0.7, level), (stop[0], y, 0.03)):
        with pytest.raises(UnreachableError, match=r"goal must lie in .* or in") as caught:
            task.start(rng, {"goal": place})
        assert caught.value.margin < 0
        assert str(right.round(4).tolist()) in str(caught.value)
    for place in (left, start, stop, right):
        np.testing.assert_array_equal(task.start(rng, {"goal": place})["goal"], [place])
    with pytest.raises(UnreachableError, match="object must lie"):
        task.start(rng, {"object": stop})


@pytest.mark.parametrize("change", [{"table": (0.19, 0.3)}, {"step_limit": (0.016, 0.005, 0.03)}])
def test_machines_that_cannot_throw_are_refused_by_name(change):
    with pytest.raises(ConfigurationError, match=r"'paper'.*table.*beyond its") as caught:
        Throw(replace(PAPER_TPM, **change))
    assert caught.value.name == "machine"


def test_a_machine_throws_only_where_its_table_goes_on():
    task = Throw(replace(WIDE_TPM, table=(0.5, 0.65)))
    goals = task.start([np.random.default_rng(seed) for seed in range(20)])["goal"]
    assert (goals[:, 0] < task.reach_of(Throw.block)[0][0]).all()


@pytest.mark.parametrize("place", [-0.409, -0.1, 0.289])  # within the tolerance of goals
def test_a_block_on_its_way_to_a_goal_is_not_lost_and_costs_no_way_to_the_cup(place):
    task = Throw(PAPER_TPM, "dense")
    at = np.array([[[place, -0.03, 0.015]]])
    state = random_state(np.random.default_rng(0), (1,), 1, object_position=at)
    assert not task.lost(state)
    assert (task.shaping(state)["approach"] < 0) == (place == -0.1)
    for beyond in (-0.44, 0.32):
        at = np.array([[[beyond, -0.03, 0.015]]])
        assert task.lost(replace(state, object_position=at))
