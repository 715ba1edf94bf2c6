import gymnasium as gym
import numpy as np
import pytest

import tpm_gym
from tpm_gym.tasks.control import STEP_LIMIT
from tpm_gym.tasks.expert import Expert, _trapezoid
from tpm_gym.tasks.rewards import SAFE_CONDITIONING


def episode(env, expert, seed, disturb=None, options=None):
    """Infos of an episode, and the largest closure error."""
    observation, info = env.reset(seed=seed, options=options)
    expert.reset(observation)
    infos = []
    for step in range(50):
        if disturb is not None:
            disturb(env.unwrapped, step)
        action = expert.act(observation)
        assert env.action_space.contains(action)
        observation, _, _, _, info = env.step(action)
        infos.append(info)
    return infos


@pytest.mark.parametrize("env_id", [i for i in tpm_gym.ENV_IDS if "Dense" not in i])
def test_it_solves_every_task_and_keeps_clear_of_the_singularity(env_id):
    env = gym.make(env_id)
    expert = Expert(env)
    for seed in range(12):
        infos = episode(env, expert, seed)
        assert infos[-1]["is_success"]
        assert max(info["closure_error"] for info in infos) < 0.5e-3
        assert min(info["conditioning"] for info in infos) > 0.95 * SAFE_CONDITIONING
    env.close()


def test_on_the_table_it_lets_go_and_in_the_air_it_holds():
    env = gym.make("TPMPickAndPlace-v0")
    expert = Expert(env)
    for height, holds in ((0.015, False), (0.1, True)):
        options = {"object": (-0.12, -0.03, 0.015), "goal": (0.0, -0.03, height)}
        assert episode(env, expert, 0, options=options)[-1]["is_success"]
        assert env.unwrapped.state.holding is holds
    env.close()


def test_it_tries_again_when_the_puck_is_lost():
    env = gym.make("TPMPickAndPlace-v0")
    expert = Expert(env)
    lost = []

    def knock_off(unwrapped, step):
        if unwrapped.state.holding and not lost:
            lost.append(step)
            unwrapped.simulation._cup.let_go()

    options = {"object": (-0.1, -0.03, 0.015), "goal": (0.0, -0.03, 0.1)}
    infos = episode(env, expert, 0, knock_off, options)
    assert lost
    assert infos[-1]["is_success"]
    env.close()


def test_the_longest_paths_fit_into_an_episode():
    env = gym.make("TPMPickAndPlace-v0")
    expert = Expert(env)
    options = {"object": (-0.2, -0.04, 0.015), "goal": (0.1, -0.027, 0.015)}
    assert episode(env, expert, 0, options=options)[-1]["is_success"]
    env.close()


def test_trapezoids_start_and_stop_gently_and_respect_the_step_limit():
    rng = np.random.default_rng(0)
    for stop in rng.uniform(-0.3, 0.3, (100, 3)) * (1, 0.1, 1):
        fractions = _trapezoid(np.zeros(3), stop)
        steps = np.diff(fractions, prepend=0.0)
        assert fractions[-1] == pytest.approx(1.0)
        assert (steps > 0).all()
        assert np.allclose(steps, steps[::-1])
        assert (np.abs(steps[:, None] * stop) <= STEP_LIMIT * (1 + 1e-9)).all()
        assert steps[0] == pytest.approx(steps.min())


@pytest.mark.slow
def test_990_of_1000_episodes_succeed_with_the_loops_closed():
    env = gym.make("TPMPickAndPlace-v0")
    expert = Expert(env)
    results = [episode(env, expert, seed) for seed in range(1000)]
    assert sum(infos[-1]["is_success"] for infos in results) >= 990
    assert max(info["closure_error"] for infos in results for info in infos) < 0.5e-3
    env.close()
