"""No action may lose the mechanism: policies in training hammer, shove and drop."""

import gymnasium as gym
import numpy as np
import pytest

from tpm_gym.mechanism.mount import GRAVITY
from tpm_gym.simulation.state import CONTROL_PERIOD
from tpm_gym.tasks import Expert

DOWN = np.array([0.0, 0.0, 1.0, -1.0])
SUCKING = np.array([0.0, 0.0, 0.0, 2.0])


def shoved_into_the_table(rng):
    return np.append(rng.uniform(-1, 1, 2), (1.0, rng.uniform(-1, 1)))


def bang_bang_mostly_down(rng, step, action):
    action = rng.choice([-1.0, 1.0], 4)
    action[2] = 1.0 if rng.random() < 0.7 else -1.0
    return action


def hammering(rng, step, action):
    if step < 12:  # until it is over the block
        return action
    vertical = (1, 1, 1, 1, -1, -1, 1, 1, 1, -1, 1, 1)[step // 2 % 12]
    return np.append(rng.choice([-1, 0, 1], 2) * (step % 2), (vertical, 0.0))


HOSTILE = {
    "hammering on the block": hammering,
    "straight down": lambda rng, step, action: DOWN,
    "grasped, then down": lambda rng, step, action: action if step < 14 else DOWN + SUCKING,
    "dropped, then down": lambda rng, step, action: action if step < 14 else DOWN,
    "grasped, then shoved into the table": lambda rng, step, action: (
        action if step < 12 else shoved_into_the_table(rng)
    ),
    "noisy expert": lambda rng, step, action: np.clip(action + rng.normal(0.0, 0.5, 4), -1, 1),
    "bang-bang, mostly down": bang_bang_mostly_down,
}


@pytest.mark.parametrize("policy", HOSTILE.values(), ids=HOSTILE)
@pytest.mark.parametrize(
    ("env_id", "seeds"),
    [
        ("TPMPickAndPlace-v0", range(1, 2)),
        pytest.param("TPMPickAndPlace-v0", range(60), marks=pytest.mark.slow),
        pytest.param("TPMPickAndPlaceJoints-v0", range(60), marks=pytest.mark.slow),
    ],
)
def test_hostile_policies_do_not_lose_the_mechanism(env_id, policy, seeds):
    env = gym.make(env_id)
    expert = Expert(env)
    simulation = env.unwrapped.simulation
    (block,), time_step = simulation.scene.objects, simulation.engine.physics.time_step
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
            # Neither thrown about nor pressed through the table. A landing is noticed a time step
            # late, so it goes as deep as the block falls in one; but nothing may keep it there.
            height = state.object_position[0, 2]
            assert height < 0.4
            depth = block.height / 2 - height
            assert depth < 1e-3 + time_step * (fall + GRAVITY * CONTROL_PERIOD)
            fall = max(fall, -state.object_velocity[0, 2])
            pressed = pressed + CONTROL_PERIOD if depth > 1e-3 else 0.0
            assert pressed < 0.15
