"""Conveyor: the expert meets blocks that it sees late, on belts of any speed."""

import gymnasium as gym
import numpy as np
import pytest
from episodes import expert_episode

from tpm_gym import TPMEnv
from tpm_gym.errors import ResetOptionError, UnreachableError
from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.tasks import Conveyor
from tpm_gym.tasks.conveyor import SPEEDS

STEPS = Conveyor.max_episode_steps


@pytest.mark.parametrize("speed", [SPEEDS[0], SPEEDS[1], 0.0])
def test_the_expert_picks_at_any_speed_of_the_belt(speed):
    env, grip = gym.make("TPMConveyor-v0", engine="analytic"), np.full(3, np.nan)
    end = env.unwrapped.task.belt.end  # beyond it, blocks stand still
    for x in (-0.19, end, None):
        # Without a place, a block on a belt that stands is drawn at the edge of the reach.
        options = {"belt_speed": speed} | ({} if x is None else {"object": (x, -0.03, 0.015)})
        for last in expert_episode(env, 0, STEPS, options):
            (observation, _, info), state = last, env.unwrapped.state
            if state.held == 0:
                grip = state.platform_position - state.object_position[0]
        assert state.belt_speed == speed
        assert info["is_success"]
        np.testing.assert_allclose(grip[:2], 0.0, atol=1e-3)
        gap = observation["achieved_goal"] - observation["desired_goal"]
        np.testing.assert_allclose(gap, 0.0, atol=1e-4)
        assert state.platform_position[2] - grip[2] > 0.04  # the cup has left the block


def test_blocks_come_within_reach_in_the_first_second_and_goals_are_in_the_tray():
    task = Conveyor(PAPER_TPM)
    starts = task.start([np.random.default_rng(seed) for seed in range(200)])
    wait = (task.reach_of(task.block)[0][0] - starts["object"][:, 0]) / starts["belt_speed"][:, 0]
    assert 0.6 < wait.max() < 1.0
    boxes = {"object": task.starts_of(task.block), "goal": task.goals_of(task.block)[0]}
    for name, (low, high) in boxes.items():
        place = starts[name]
        assert ((place >= low - 1e-9) & (place <= high + 1e-9)).all()


def test_tempting_ways_are_only_just_safe():
    env = gym.make("TPMConveyor-v0", engine="analytic", goals="tempting")
    for seed in range(6):
        *steps, (_, _, info) = expert_episode(env, seed, STEPS)
        assert info["is_success"]
        least = min(info["conditioning"] for _, _, info in steps)
        assert 0.95 < least / PAPER_TPM.safe_conditioning < 1.4


class Watched(Conveyor):
    """Reports when the block has moved by 5 mm."""

    events, origin = ("moved",), 0.0

    def moved(self, state):
        return state.object_position[:, 0, 0] > self.origin + 0.005

    lost = moved


def test_the_camera_alone_shows_the_block_late_and_as_many_steps_as_stated():
    env = TPMEnv(Watched, reward="dense", engine="analytic")
    rng, delay = np.random.default_rng(0), Conveyor.camera_delay
    for seed in range(2):  # the second episode shows nothing of the first
        observation, _ = env.reset(seed=seed)
        true, shown = [env.state.object_position[0].copy()], []
        env.task.origin = true[0][0]
        for step in range(12):
            seen = env.task.decode(observation["observation"])["object_position"]
            np.testing.assert_allclose(seen, observation["achieved_goal"], atol=1e-6)
            shown.append(seen)
            if step == 6:  # a snapshot keeps what the camera has yet to show
                snapshot = env.save_state()
                env.step(env.action_space.sample())
                observation = env.restore_state(snapshot)
            observation, *_, info = env.step(rng.uniform(-1, 1, 4))
            true.append(env.state.object_position[0].copy())
            state = env._core.state
            assert info["moved"] is info["object_lost"] is env.task.moved(state).item()
            assert info["reward_terms"]["approach"] == env.task.shaping(state)["approach"]
            env.state.object_position[:] = 5.0  # changes nothing that the camera shows
        expected = [true[max(0, k - delay)] for k in range(len(shown))]
        np.testing.assert_allclose(shown, expected, atol=1e-6)
        assert true[-1][0] - true[0][0] > 0.01


def test_impossible_options_of_the_belt_are_refused():
    task = Conveyor(PAPER_TPM)
    rngs = [np.random.default_rng(0)]
    for speed in (1.5, np.nan, [0.1, 0.1], "fast", [[0.1], [0.1, 0.2]]):
        with pytest.raises(ResetOptionError, match="belt_speed"):
            task.start(rngs, {"belt_speed": speed})
    start, end = task.belt.start, task.belt.end
    for name, x, z in (
        ("object", start + 0.02, 0.015),
        ("object", -0.19, 0.1),  # above the belt
        ("object", end + 0.01, 0.015),  # in the tray
        ("goal", end + 0.02, 0.015),  # beside the belt
        ("goal", end + 0.1, 0.1),
    ):
        with pytest.raises(UnreachableError, match=name):
            task.start(rngs, {name: (x, -0.03, z)})
