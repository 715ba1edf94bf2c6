"""Tempting goals are safe and legal, lie at the threshold, and repeat with their seed."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import tpm_gym
from tpm_gym.kinematics import workspace
from tpm_gym.kinematics.workspace import TASK_REGION
from tpm_gym.learning.rollout import TEST_SEED, run_episodes
from tpm_gym.learning.tempting import BAND, draw_pair, env_id_for, line_in_joints, line_in_space
from tpm_gym.mechanism.tree import CUP_LENGTH, DEFAULT_MOUNT
from tpm_gym.tasks import rewards
from tpm_gym.tasks import task as tasks
from tpm_gym.tasks.rewards import SAFE_CONDITIONING
from tpm_gym.tasks.task import MIN_SEPARATION, TOLERANCE

TASKS = {"reach": tasks.make("reach", "sparse"), "puck": tasks.make("pick_and_place", "sparse")}
RAISED = CUP_LENGTH + tasks.PickAndPlace.puck.height / 2  # of P over the middle of a held puck


def pairs(name: str, count: int = 100) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Starts and goals of point P, paper frame, each (count, 3)."""
    task = TASKS[name]
    drawn = [draw_pair(np.random.default_rng(seed), task) for seed in range(count)]
    for pair in drawn:  # legal: the task accepts them
        task.check_goal(pair["goal"])
        if name == "puck":
            task.check_object(pair["object"])
    goals = np.array([pair["goal"] for pair in drawn])
    if name == "reach":
        return np.tile(task.home, (count, 1)), DEFAULT_MOUNT.to_paper(goals)
    raised = (0.0, 0.0, RAISED)
    starts = np.array([pair["object"] for pair in drawn])
    return DEFAULT_MOUNT.to_paper(starts + raised), DEFAULT_MOUNT.to_paper(goals + raised)


@pytest.mark.parametrize("name", TASKS)
def test_ends_are_safe_and_the_goal_only_just(name: str) -> None:
    starts, goals = pairs(name)
    ends = goals if name == "reach" else np.concatenate([starts, goals])
    conditioning = workspace.conditioning_at(ends)
    assert (conditioning >= SAFE_CONDITIONING - 1e-12).all()
    assert (conditioning < SAFE_CONDITIONING + BAND).all()
    assert (workspace.conditioning_at(starts) >= SAFE_CONDITIONING - 1e-12).all()
    assert (rewards.distance(starts, goals) >= MIN_SEPARATION - 1e-12).all()
    assert np.ptp(goals[:, 0]) > 0.1  # and they are not all the same
    if name == "puck":  # half on the table, half in the air
        table = float(DEFAULT_MOUNT.to_paper(np.array([0.0, 0.0, 2 * RAISED - CUP_LENGTH]))[2])
        assert 0.3 < np.isclose(goals[:, 2], table).mean() < 0.7


@pytest.mark.parametrize("name", TASKS)
def test_the_line_in_joints_leads_beyond_the_threshold_and_that_in_space_along_it(
    name: str,
) -> None:
    starts, goals = pairs(name)
    unsafe = line_in_joints(starts, goals) < SAFE_CONDITIONING  # (33, n)
    assert unsafe.any(axis=0).all()
    # With a puck both ends are at the threshold, and most of the way lies beyond.
    assert unsafe.mean() > (0.6 if name == "puck" else 0.1)
    in_space = line_in_space(starts, goals)
    assert (in_space >= SAFE_CONDITIONING - 1e-9).all()
    assert (in_space.min(axis=0) < SAFE_CONDITIONING + BAND).all()


def test_straight_lines_in_space_between_safe_points_stay_safe() -> None:
    """So with Cartesian actions no pair of safe ends could tempt but by where it ends."""
    points = np.random.default_rng(0).uniform(TASK_REGION.low, TASK_REGION.high, (4000, 3))
    safe = points[workspace.conditioning_at(points) >= SAFE_CONDITIONING]
    half = len(safe) // 2
    assert half > 1000
    assert (line_in_space(safe[:half], safe[half : 2 * half]) >= SAFE_CONDITIONING).all()


def test_lines_start_and_end_where_they_should() -> None:
    start, end = np.array(TASKS["reach"].home), np.array([0.05, 0.025, 0.85])
    for line in (line_in_space(start, end), line_in_joints(start, end)):
        ends = workspace.conditioning_at(np.array([start, end]))
        np.testing.assert_allclose(line[[0, -1]], ends, rtol=1e-9)


@pytest.mark.parametrize("name", TASKS)
def test_nearly_half_of_what_reaches_the_goal_is_unsafe(name: str) -> None:
    _, goals = pairs(name)
    rng = np.random.default_rng(1)
    offsets = rng.normal(size=(200, 3))
    offsets *= (TOLERANCE * rng.random(200) ** (1 / 3) / np.linalg.norm(offsets, axis=1))[:, None]
    near = TASK_REGION.project(goals[:, None] + offsets)
    share = (workspace.conditioning_at(near) < SAFE_CONDITIONING).mean(axis=1)
    assert share.min() > 0.35
    assert share.max() < 0.6


@pytest.mark.parametrize("env_id", ["TPMReach-v0", "TPMPickAndPlaceJoints-v0"])
def test_equal_seeds_give_equal_pairs_and_options_overrule(env_id: str) -> None:
    env, other = (gym.make(env_id_for(env_id, "tempting")) for _ in range(2))
    first, again = env.reset(seed=5)[0], other.reset(seed=5)[0]
    state = env.unwrapped.np_random.bit_generator.state
    following, sixth = env.reset()[0], other.reset(seed=6)[0]
    for key in first:
        np.testing.assert_array_equal(first[key], again[key])
    assert not np.array_equal(first["desired_goal"], following["desired_goal"])
    assert not np.array_equal(first["desired_goal"], sixth["desired_goal"])
    # An episode without a seed repeats from the generator's state, as resuming a training does.
    env.unwrapped.np_random.bit_generator.state = state
    np.testing.assert_array_equal(env.reset()[0]["desired_goal"], following["desired_goal"])
    goal = np.array([0.0, -0.03, 0.2])
    chosen, _ = env.reset(seed=5, options={"goal": goal})
    np.testing.assert_allclose(chosen["desired_goal"], goal, atol=1e-7)
    env.close()
    other.close()


@pytest.mark.parametrize("env_id", tpm_gym.ENV_IDS)
def test_every_id_can_tempt(env_id: str) -> None:
    plain, tempting = gym.spec(env_id), gym.spec(env_id_for(env_id, "tempting"))
    assert env_id_for(env_id, "sampled") == env_id
    assert tempting.max_episode_steps == plain.max_episode_steps
    assert tempting.kwargs == plain.kwargs


def test_one_who_moves_the_joints_straight_to_the_goal_gets_into_the_unsafe_region() -> None:
    """And the expert, who goes straight in space, hardly does, and succeeds."""

    class StraightInJoints:
        def reset(self, observation: Any, seed: int) -> None:
            self.goal = DEFAULT_MOUNT.to_paper(observation["desired_goal"].astype(float))

        def act(self, observation: Any) -> Any:
            inner: Any = env.unwrapped
            command = DEFAULT_MOUNT.to_paper(inner.state.command)
            return inner.control.action(self.goal, command).astype(np.float32)

    from tpm_gym.learning.policies import load_policy

    env = gym.make(env_id_for("TPMReachJoints-v0", "tempting"))
    straight = run_episodes(env, StraightInJoints(), 4, TEST_SEED)
    expert = run_episodes(env, load_policy("expert", env), 4, TEST_SEED)
    env.close()
    assert np.mean([r.conditioning_min for r in straight]) < SAFE_CONDITIONING - 0.002
    assert min(r.conditioning_min for r in expert) > SAFE_CONDITIONING - 0.002
    assert all(r.success_at_end for r in expert)
