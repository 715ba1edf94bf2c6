import gymnasium as gym
import pytest

import tpm_gym
from tpm_gym.envs.registration import MAX_EPISODE_STEPS, register


def test_all_eight_ids_are_registered_under_their_documented_names():
    expected = {
        f"TPM{task}{control}{reward}-v0"
        for task in ("Reach", "PickAndPlace")
        for control in ("", "Joints")
        for reward in ("", "Dense")
    }
    assert set(tpm_gym.ENV_IDS) == expected
    assert expected <= set(gym.registry)


@pytest.mark.parametrize("env_id", tpm_gym.ENV_IDS)
def test_an_id_means_what_it_says(env_id):
    env = gym.make(env_id)
    task = env.unwrapped.task
    assert type(task).__name__ == ("PickAndPlace" if "Pick" in env_id else "Reach")
    assert task.reward == ("dense" if "Dense" in env_id else "sparse")
    control = "JointControl" if "Joints" in env_id else "CartesianControl"
    assert type(env.unwrapped.control).__name__ == control
    assert env.action_space.shape == ((4,) if "Pick" in env_id else (3,))
    assert env.spec.max_episode_steps == MAX_EPISODE_STEPS == 50
    assert env.metadata["render_fps"] == 25
    env.close()


def test_registering_twice_is_harmless():
    before = dict(gym.registry)
    register()
    assert gym.registry == before
