import re

import gymnasium as gym
import numpy as np
import pytest
from tpm_gym.simulation.physics import Physics

from tpm_gym.envs.env import TPMEnv
from tpm_gym.errors import ClosureError, ConfigurationError, EpisodeError
from tpm_gym.kinematics.workspace import TASK_REGION
from tpm_gym.mechanism.tree import DEFAULT_MOUNT
from tpm_gym.tasks import task as tasks
from tpm_gym.tasks.expert import Expert
from tpm_gym.tasks.rewards import singularity_penalty


@pytest.fixture
def env():
    env = TPMEnv("pick_and_place")
    yield env
    env.close()


def test_options_place_the_object_and_the_goal(env):
    goal, place = (0.02, -0.03, 0.1), (-0.05, -0.025, 0.015)
    observation, _ = env.reset(seed=0, options={"object": place, "goal": goal})
    assert np.allclose(observation["desired_goal"], goal)
    assert np.allclose(observation["achieved_goal"], place)
    assert np.allclose(env.state.object_position, place)
    assert np.allclose(env.goal, goal)


def test_observations_come_from_forward_kinematics_while_moving(env):
    env.reset(seed=2)
    for _ in range(10):
        observation = env.step(np.array([1.0, -1.0, 0.5, 0.0]))[0]
        decoded = env.task.decode(observation["observation"])
        assert np.allclose(decoded["position"], env.state.fk_position, atol=1e-6)
        assert np.allclose(decoded["velocity"], env.state.fk_velocity, atol=1e-5)


def drive_to_the_singular_side(env):
    """Step towards small y until the command stops; the last step's results."""
    env.reset(seed=3)
    for _ in range(12):
        result = env.step(np.array([0.5, -1.0, 0.0]))
    return result


def test_the_penalty_grows_towards_the_singularity_and_follows_the_weight():
    rewards = []
    for weight in (0.0, 1.0, 2.0):
        env = TPMEnv("reach", penalty_weight=weight)
        _, reward, _, _, info = drive_to_the_singular_side(env)
        assert info["conditioning"] < 0.08
        assert info["singularity_penalty"] == float(singularity_penalty(info["conditioning"]))
        assert info["singularity_penalty"] > 0.1
        assert sum(info["reward_terms"].values()) == pytest.approx(reward)
        rewards.append(reward)
        env.close()
    assert rewards[0] - rewards[1] == pytest.approx(info["singularity_penalty"])
    assert rewards[0] - rewards[2] == pytest.approx(2 * info["singularity_penalty"])


def test_hindsight_keeps_the_penalty_by_the_difference_of_goal_terms():
    env = TPMEnv("reach")
    observation, reward, _, _, info = drive_to_the_singular_side(env)
    achieved, goal, other = observation["achieved_goal"], observation["desired_goal"], np.zeros(3)
    for new_goal in (achieved, other):
        relabelled = (
            reward
            - env.compute_reward(achieved, goal, {})
            + env.compute_reward(achieved, new_goal, {})
        )
        assert relabelled == pytest.approx(env.compute_reward(achieved, new_goal, info))
    env.close()


def test_a_lost_loop_voids_the_episode_and_a_reset_recovers(env):
    env.reset(seed=4)
    healthy = env.simulation.move

    def broken(*arguments):
        raise ClosureError(0.02, 0.005)

    env.simulation.move = broken
    with pytest.raises(ClosureError, match="reset"):
        env.step(np.zeros(4))
    with pytest.raises(EpisodeError, match="reset"):
        env.step(np.zeros(4))
    env.simulation.move = healthy
    env.reset(seed=4)
    assert env.step(np.zeros(4))[4]["closure_error"] < 1e-4


@pytest.mark.parametrize("stop", [2, 5, 6, 8, 12, 20, 30])
def test_a_saved_state_continues_bit_equally(env, stop):
    observation, _ = env.reset(seed=3)
    expert = Expert(env)
    expert.reset(observation)
    actions = []
    for step in range(40):
        if step == stop:
            snapshot = env.save_state()
            held = env.state.holding
        actions.append(expert.act(observation))
        observation = env.step(actions[-1])[0]
    next_goal = env.reset()[0]["desired_goal"]
    env.reset(seed=6)
    restored = env.restore_state(snapshot)
    assert env.state.holding is held
    for action in actions[stop:]:
        restored = env.step(action)[0]
    for name, array in observation.items():
        assert np.array_equal(restored[name], array)
    assert np.array_equal(env.reset()[0]["desired_goal"], next_goal)


@pytest.mark.parametrize("physics", [5, {}, Physics(control_period=0.2)])
def test_physics_that_do_not_fit_the_tasks_are_refused(physics):
    with pytest.raises(ConfigurationError, match="physics"):
        TPMEnv(physics=physics)


def test_a_state_cannot_be_saved_outside_an_episode(env):
    with pytest.raises(EpisodeError):
        env.save_state()


def test_rgb_array_gives_pictures_of_the_asked_size():
    env = gym.make("TPMPickAndPlace-v0", render_mode="rgb_array", width=96, height=64)
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (64, 96, 3)
    assert picture.dtype == np.uint8
    assert picture.std() > 10
    env.close()


def test_human_mode_without_a_display_is_refused_instead_of_ending_the_process(monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(ConfigurationError, match="display"):
        TPMEnv(render_mode="human")
    env = TPMEnv()
    assert env.metadata["render_modes"] == ["rgb_array"]
    assert TPMEnv.metadata["render_modes"] == ["human", "rgb_array"]
    env.close()


def test_the_datasheet_lists_the_entries_and_numbers_that_the_code_uses():
    text = TPMEnv.__doc__
    rows = re.findall(r"^    \| (\w+) \| (\d) \| (.+) \|$", text, flags=re.MULTILINE)
    entries = [(e.name, str(len(e.scale)), e.meaning) for e in tasks.PickAndPlace.entries]
    assert rows == entries
    assert "at most 30, 5, 30 mm" in text
    assert list(tasks.STEP_LIMIT) == [0.03, 0.005, 0.03]
    assert "(1 - (c / 0.08)^4) where c = 1/cond(J) < 0.08, else 0" in text
    assert singularity_penalty(0.05) == pytest.approx(1 - (0.05 / 0.08) ** 4)
    assert singularity_penalty(0.08) == 0.0 < singularity_penalty(0.0799)
    low, high = np.array(TASK_REGION.low), np.array(TASK_REGION.high)
    (x0, y0, z1), (x1, y1, z0) = DEFAULT_MOUNT.to_world(low), DEFAULT_MOUNT.to_world(high)
    box = f"{x0:.4g} <= x <= {x1:.4g}, {y1:.4g} <= y <= {y0:.4g}, {z0:.4g} <= z <= {z1:.4g} m"
    assert box in text
    puck = tasks.PickAndPlace.puck
    size = (1e3 * puck.width, 1e3 * puck.height, 1e3 * puck.mass)
    assert "(square, {:.0f} mm wide, {:.0f} mm high, {:.0f} g)".format(*size) in text
    assert f"below {1e3 * tasks.TOLERANCE:.0f} mm" in text
    assert f"at least {1e3 * tasks.MIN_SEPARATION:.0f} mm" in text


@pytest.mark.parametrize("sideways", [(-1.0, -1.0), (1.0, 1.0), (1.0, -1.0), (0.0, 0.0)])
def test_hammering_on_the_puck_at_full_speed_does_not_lose_the_mechanism(env, sideways):
    for offset in (-0.016, 0.0, 0.016):
        options = {"object": (-0.04 + offset, -0.028, 0.015), "goal": (0.05, -0.03, 0.1)}
        env.reset(seed=0, options=options)
        for vertical in (1, 1, 1, 1, -1, -1, 1, 1, 1, -1, 1, 1):
            down = np.array([0.0, 0.0, vertical, 0.0])
            env.step(down)
            info = env.step(down + (*sideways, 0.0, 0.0))[4]
            assert info["closure_error"] < 0.15e-3
