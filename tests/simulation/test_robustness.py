"""No action may lose the mechanism: policies in training hammer, shove and drop."""

import gymnasium as gym
import numpy as np
import pytest

from tpm_gym.simulation.bullet.client import GRAVITY
from tpm_gym.simulation.state import CONTROL_PERIOD
from tpm_gym.tasks import Expert

IDS = ("TPMPickAndPlace-v0", "TPMPickAndPlaceJoints-v0")


def straight_down(rng, step, action):
    return np.array([0.0, 0.0, 1.0, -1.0])


def grasped_then_down(rng, step, action):
    return action if step < 14 else np.array([0.0, 0.0, 1.0, 1.0])


def dropped_then_down(rng, step, action):
    return action if step < 14 else np.array([0.0, 0.0, 1.0, -1.0])


def grasped_then_shoved_into_the_table(rng, step, action):
    return action if step < 12 else np.append(rng.uniform(-1, 1, 2), (1.0, rng.uniform(-1, 1)))


def noisy_expert(rng, step, action):
    return np.clip(action + rng.normal(0.0, 0.5, 4), -1, 1)


def bang_bang_mostly_down(rng, step, action):
    action = rng.choice([-1.0, 1.0], 4)
    action[2] = 1.0 if rng.random() < 0.7 else -1.0
    return action


HOSTILE = (
    straight_down,
    grasped_then_down,
    dropped_then_down,
    grasped_then_shoved_into_the_table,
    noisy_expert,
    bang_bang_mostly_down,
)


def survives(env_id, policy, seeds):
    env = gym.make(env_id)
    expert = Expert(env)
    simulation = env.unwrapped.simulation
    (puck,), time_step = simulation.scene.objects, simulation.engine.physics.time_step
    for seed in seeds:
        rng = np.random.default_rng(seed)
        observation, _ = env.reset(seed=seed)
        expert.reset(observation)
        fall = pressed = 0.0
        for step in range(50):
            action = policy(rng, step, expert.act(observation))
            observation, _, _, _, info = env.step(action.astype(np.float32))
            assert info["closure_error"] < 0.1e-3
            state = env.unwrapped.state
            assert not state.passed_singularity
            # Neither thrown about nor pressed through the table. A landing is noticed one time
            # step late, so it goes as deep as the puck falls in one; but nothing may keep it there.
            height = state.object_position[0, 2]
            assert height < 0.4
            depth = puck.height / 2 - height
            assert depth < 1e-3 + time_step * (fall + GRAVITY * CONTROL_PERIOD)
            fall = max(fall, -state.object_velocity[0, 2])
            pressed = pressed + CONTROL_PERIOD if depth > 1e-3 else 0.0
            assert pressed < 0.15
    env.close()


@pytest.mark.parametrize("policy", HOSTILE)
def test_hostile_policies_do_not_lose_the_mechanism(policy):
    survives("TPMPickAndPlace-v0", policy, range(1, 3))


@pytest.mark.slow
@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("policy", HOSTILE)
def test_hostile_policies_do_not_lose_the_mechanism_in_many_episodes(env_id, policy):
    survives(env_id, policy, range(100))
