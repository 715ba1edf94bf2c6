"""What every environment of tpm_gym promises, whatever its task, machine, engine.

Each check takes a callable that makes an environment, as ``partial(gym.make, env_id)`` does::

    @pytest.mark.parametrize("check", CHECKS)
    def test_mine_conforms(check):
        check(lambda: gym.make("TPMMine-v0"))
"""

from __future__ import annotations

import copy
import json
import pickle
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from episodes import bits, fingerprint, play, random_episode
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from tpm_gym.errors import ActionError, EpisodeError, ResetOptionError, UnreachableError
from tpm_gym.mechanism.cup import CUP
from tpm_gym.tasks import Expert

Make = Callable[[], gym.Env[Any, Any]]

INFO = {
    "is_success": bool,
    "closure_error": float,
    "vacuum": float,
    "conditioning": float,
    "singularity_penalty": float,
    "assembly_mode_changed": bool,
    "working_mode_changed": bool,
    "object_lost": bool,
    "reward_terms": dict,
}


def the_checkers_of_gymnasium_and_sb3_find_nothing(make: Make) -> None:
    with closing(make()) as env, warnings.catch_warnings():
        warnings.simplefilter("error")
        gymnasium_check_env(env.unwrapped)
        sb3_check_env(env.unwrapped)


def observations_are_in_the_space_and_of_order_one_and_info_is_plain(make: Make) -> None:
    largest = 0.0
    with closing(make()) as env:
        for index, (observation, reward, info) in enumerate(random_episode(env, 1)):
            assert env.observation_space.contains(observation)
            if index == 0:
                info.pop("randomisation", None)
            assert {name: type(value) for name, value in info.items()} == INFO
            assert all(type(term) is float for term in info["reward_terms"].values())
            assert 0.0 <= info["conditioning"] <= 1.0
            assert 0.0 <= info["vacuum"] <= CUP.vacuum
            assert 0.0 <= info["singularity_penalty"] <= 1.0
            assert not info["assembly_mode_changed"] | info["working_mode_changed"]
            if index:
                assert sum(info["reward_terms"].values()) == pytest.approx(reward, abs=1e-12)
            largest = max(largest, np.abs(observation["observation"]).max())
    assert 0.5 < largest < 5.0


def episodes_are_truncated_at_their_last_step_and_never_terminated(make: Make) -> None:
    with closing(make()) as env:
        env.reset(seed=0)
        steps = env.spec.max_episode_steps
        flags = [env.step(env.action_space.sample())[2:4] for _ in range(steps)]
    assert flags == [(False, False)] * (steps - 1) + [(False, True)]


def resets_are_randomised_but_repeat_with_the_seed(make: Make) -> None:
    with closing(make()) as env:
        first, second, again = (env.reset(seed=seed)[0]["desired_goal"] for seed in (3, 4, 3))
        assert not np.array_equal(first, second)
        assert np.array_equal(first, again)
        assert not np.array_equal(env.reset()[0]["desired_goal"], again)


def observations_share_no_memory(make: Make) -> None:
    with closing(make()) as env:
        steps = list(random_episode(env, 7, steps=3))
        for index, (observation, _, _) in enumerate(steps):
            for other, _, _ in steps[index + 1 :]:
                assert not any(np.shares_memory(observation[k], other[k]) for k in other)
        state, goal = bits(vars(env.unwrapped.state)), env.unwrapped.goal
        for array in steps[-1][0].values():
            array[:] = 9.0
        env.unwrapped.goal[:] = 9.0
        assert bits(vars(env.unwrapped.state)) == state
        assert np.array_equal(env.unwrapped.goal, goal)


def compute_reward_is_vectorised_and_keeps_what_info_holds(make: Make) -> None:
    with closing(make()) as env:
        steps = list(random_episode(env, 8))[1:]
        achieved, desired = (
            np.array([observation[name] for observation, _, _ in steps])
            for name in ("achieved_goal", "desired_goal")
        )
        infos, compute = [info for _, _, info in steps], env.unwrapped.compute_reward
    assert np.array_equal(compute(achieved, desired, infos), [reward for _, reward, _ in steps])
    assert compute(achieved[0], desired[0], infos[0]) == steps[0][1]
    goal_terms = [info["reward_terms"]["goal"] for info in infos]
    empty: list[dict[str, Any]] = [{}] * len(steps)
    assert np.array_equal(compute(achieved, desired, empty), goal_terms)
    # Relabelled with what was achieved, every goal term is at its best, and the others stay.
    assert np.array_equal(compute(achieved, achieved, empty), np.zeros(len(steps)))
    others = [sum(info["reward_terms"].values()) - info["reward_terms"]["goal"] for info in infos]
    assert np.allclose(compute(achieved, achieved, infos), others, rtol=0, atol=1e-12)


def bad_actions(size: int) -> Iterator[Any]:
    """What is no action of that length."""
    ones = np.ones(size)
    yield from (np.full(size, np.nan), np.where(np.arange(size) == 1, np.inf, ones))
    yield from (np.ones(size + 1), np.ones((1, size)), 0.0, None, [[0.0], [0.0, 1.0]], {})
    yield from ("up", ["0.1"] * size, [10**400] + [0] * (size - 1), [10**5000] * size)
    yield from (ones + 1j, np.array(["2026-01-01"] * size, dtype="datetime64[D]"))
    yield from (np.ma.masked_array(ones, mask=ones), torch.ones(size, requires_grad=True))


def bad_actions_raise_and_leave_the_simulation_as_it_was(make: Make) -> None:
    def run(env: gym.Env[Any, Any], hostile: bool) -> Any:
        half = np.full(env.action_space.shape, 0.5)
        env.reset(seed=9)
        for _ in range(3):
            env.step(half)
        state = bits(vars(env.unwrapped.state))
        for action in bad_actions(half.size) if hostile else ():
            with pytest.raises(ActionError):
                env.unwrapped.step(action)
            assert bits(vars(env.unwrapped.state)) == state
        return play(env, [-half] * 3)

    with closing(make()) as env:
        assert run(env, True) == run(env, False)


def actions_beyond_the_space_are_clipped_and_left_as_they_are(make: Make) -> None:
    def run(env: gym.Env[Any, Any], size: float) -> Any:
        env.reset(seed=10)
        action = np.full(env.action_space.shape, size)
        result = bits(env.unwrapped.step(action))
        assert (action == size).all()
        return result

    with closing(make()) as env:
        assert run(env, 1.0) == run(env, 1e9) == run(env, np.finfo(np.float64).max)


def bad_reset_options_raise_and_leave_the_episode_as_it_was(make: Make) -> None:
    with closing(make()) as env:
        bare = env.unwrapped
        blocks, size = bare.task.scene.objects, bare.task.goal_size
        home = bare.machine.mount.to_world(bare.machine.home)
        bad: list[Any] = [{"colour": "red"}, ["goal"], 7]
        for name, length in (("goal", size), *((block.name, 3) for block in blocks)):
            numbers = ([5.0] * length, [np.nan] * length, [0.0] * (length + 1), [10**400] * length)
            bad += [{name: value} for value in (*numbers, "there", None)]
        bad += [{block.name: home} for block in blocks]  # impaled
        env.reset(seed=11)
        env.step(np.ones(env.action_space.shape))
        state, goal = bits(vars(bare.state)), bare.goal
        for options in bad:
            with pytest.raises((ResetOptionError, UnreachableError)) as caught:
                bare.reset(options=options)
            if isinstance(caught.value, ResetOptionError) and isinstance(options, dict):
                assert caught.value.name in options
            assert bits(vars(bare.state)) == state
            assert np.array_equal(bare.goal, goal)
        env.step(np.ones(env.action_space.shape))
        assert env.observation_space.contains(env.reset(seed=12)[0])


def stepping_outside_an_episode_raises(make: Make) -> None:
    bare = make().unwrapped
    action = np.zeros(bare.action_space.shape)
    for call in (lambda: bare.step(action), lambda: bare.state, bare.save_state):
        with pytest.raises(EpisodeError, match="reset"):
            call()
    bare.reset(seed=0)
    snapshot = bare.save_state()
    bare.close()
    bare.close()
    for call in (
        lambda: bare.step(action),
        bare.reset,
        bare.render,
        bare.save_state,
        lambda: bare.restore_state(snapshot),
    ):
        with pytest.raises(EpisodeError, match="closed"):
            call()


def what_is_saved_copied_or_pickled_goes_on_equally_to_the_next_episode(make: Make) -> None:
    with closing(make()) as env, closing(make()) as restored:
        for other in (env, restored):  # wrappers count for themselves
            for _ in random_episode(other, 4, steps=15):
                pass
        restored.unwrapped.reset(seed=99)
        moment, now = env.unwrapped.save_state(), bits(vars(env.unwrapped.state))
        copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
        rng = np.random.default_rng(2)
        actions = rng.uniform(-1, 1, (env.spec.max_episode_steps - 15, *env.action_space.shape))
        expected = play(env, actions), bits(env.reset()[0])
        assert expected[0][-1][0][3] is True  # truncated
        seen = restored.unwrapped.restore_state(pickle.loads(pickle.dumps(moment)))
        assert restored.observation_space.contains(seen)
        assert bits(vars(restored.unwrapped.state)) == now
        for other in (*copies, restored):
            assert (play(other, actions), bits(other.reset()[0])) == expected
            other.close()
        env.step(actions[0])  # with the others closed


def specs_survive_json(make: Make) -> None:
    with closing(make()) as env:
        again = EnvSpec.from_json(env.spec.to_json())
        assert json.loads(again.to_json()) == json.loads(env.spec.to_json())
        with closing(gym.make(again)) as other:
            assert fingerprint(random_episode(other, 3, 5)) == fingerprint(
                random_episode(env, 3, 5)
            )


def the_expert_solves_it_and_loses_nothing(make: Make) -> None:
    with closing(make()) as env:
        expert = Expert(env)
        for seed in range(2):
            observation, info = env.reset(seed=seed)
            expert.reset(observation)
            done = False
            while not done:
                action = expert.act(observation)
                assert env.action_space.contains(action)
                observation, _, _, done, info = env.step(action)
                assert not info["object_lost"]
                assert info["closure_error"] < 0.5e-3
            assert info["is_success"]


CHECKS: tuple[Callable[[Make], None], ...] = (
    the_checkers_of_gymnasium_and_sb3_find_nothing,
    observations_are_in_the_space_and_of_order_one_and_info_is_plain,
    episodes_are_truncated_at_their_last_step_and_never_terminated,
    resets_are_randomised_but_repeat_with_the_seed,
    observations_share_no_memory,
    compute_reward_is_vectorised_and_keeps_what_info_holds,
    bad_actions_raise_and_leave_the_simulation_as_it_was,
    actions_beyond_the_space_are_clipped_and_left_as_they_are,
    bad_reset_options_raise_and_leave_the_episode_as_it_was,
    stepping_outside_an_episode_raises,
    what_is_saved_copied_or_pickled_goes_on_equally_to_the_next_episode,
    specs_survive_json,
    the_expert_solves_it_and_loses_nothing,
)
