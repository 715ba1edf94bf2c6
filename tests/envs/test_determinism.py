"""The same seed gives the same bits: again, later, elsewhere, side by side, copied or restored."""

import copy
import os
import pickle
import subprocess
import sys
from contextlib import closing
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import pytest
from episodes import (
    CASES,
    EVERYTHING,
    all_fingerprints,
    bits,
    continued,
    expert_episode,
    fingerprint,
    make,
    play,
    random_episode,
)
from paths import SUPPORT

from tpm_gym import TPMEnv
from tpm_gym.errors import ConfigurationError, EpisodeError
from tpm_gym.tasks.expert import Expert


@pytest.fixture(params=CASES, ids=lambda case: "-".join([case[0], *case[1]]))
def env(request):
    env_id, options = request.param
    env = make(env_id, **options)
    yield env
    env.close()


# -- again, later, elsewhere -----------------------------------------------------------------------


def test_first_and_fiftieth_episode_are_equal(env):
    first = fingerprint(expert_episode(env, 5))
    rebuilt = env.unwrapped.randomisation.length_error > 0  # slow, and little to remember
    for seed in range(8 if rebuilt else 48):
        for _ in random_episode(env, 100 + seed, steps=1 + seed % 4):
            pass
    assert fingerprint(expert_episode(env, 5)) == first


def test_fresh_processes_give_the_same_and_go_on_with_what_was_pickled(tmp_path):
    env = make("TPMPickAndPlace-v0", randomisation=EVERYTHING)
    for _ in expert_episode(env, 8, steps=20):
        pass
    path = tmp_path / "env.pickle"
    path.write_bytes(pickle.dumps(env))
    code = (
        "import sys; from episodes import all_fingerprints, continued;"
        "print(*all_fingerprints(), continued(sys.argv[1]), sep='\\n')"
    )
    command = [sys.executable, "-c", code, str(path)]
    places = os.pathsep.join([str(SUPPORT), os.environ.get("PYTHONPATH", "")])
    fresh = [
        subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": places},
        )
        for seed in ("0", "4711")
    ]
    expected = [*all_fingerprints(), continued(str(path))]
    assert env.unwrapped.state.held == 0
    assert repr(play(env, [np.full(4, 0.3)] * 10)) == expected[-1]  # what was pickled holds it too
    for process in fresh:
        printed = process.communicate()[0].splitlines()
        assert process.returncode == 0
        assert printed[-len(expected) :] == expected
    env.close()


# -- saved and restored ----------------------------------------------------------------------------


def touching(env: gym.Env[Any, Any]) -> bool:
    """Whether the cup touches the block."""
    engine = env.unwrapped.simulation.engine
    return bool(engine.client.getContactPoints(engine.robot.tool[0], engine.bodies[0]))


@pytest.mark.parametrize(
    ("env_id", "randomisation"), [("TPMThrow-v0", EVERYTHING), ("TPMThrowJointsDense-v0", {})]
)
def test_saved_states_go_on_equally_on_their_way_in_contact_and_holding(env_id, randomisation):
    env = make(env_id, randomisation=randomisation, max_episode_steps=1000)
    bare = env.unwrapped
    # The expert comes down without vacuum first: a contact, then a grasp.
    observation, _ = env.reset(seed=2, options={"object": (-0.05, -0.03, 0.015)})
    expert = Expert(env)
    moments, actions, expected = {}, [], []
    for step in range(40):
        held, touched = bare.state.held == 0, touching(env)
        moments[step] = (bare.save_state(), "held" if held else "touched" if touched else "free")
        action = expert.act(observation)
        if step < 14:
            action[3] = -1.0
        actions.append(action)
        observation = env.step(action)[0]
        expected.append((bits(observation), bits(vars(bare.state))))
    stops = (30, 0, 8, 12, 13, 16, 22, 39)
    assert {moments[stop][1] for stop in stops} == {"free", "touched", "held"}
    for stop in stops:
        snapshot = moments[stop][0]
        bare.reset(seed=stop)  # somebody else's episode, on another machine
        bare.step(np.ones(4))
        bare.restore_state(snapshot)
        for step in range(stop, min(stop + 12, 40)):
            observation = env.step(actions[step])[0]
            assert (bits(observation), bits(vars(bare.state))) == expected[step]
            bare.save_state()  # as was done the first time
    env.close()


def test_the_state_after_saving_or_copying_is_that_of_the_snapshot_or_copy():
    # A turned block: an engine that restarts from its orientation may round it.
    with closing(make("TPMConveyorDense-v0", max_episode_steps=1000)) as env:
        bare = env.unwrapped
        for _ in random_episode(env, 4, steps=40):
            pass
        snapshot = bare.save_state()
        expected = bits(vars(bare.state))
        bare.restore_state(snapshot)
        assert bits(vars(bare.state)) == expected
        bare.step(np.zeros(4))
        with closing(copy.deepcopy(bare)) as other:
            assert bits(vars(other.simulation.state().take(0))) == bits(vars(bare.state))


@pytest.mark.usefixtures("needs_pybullet")
def test_a_copy_goes_on_equally_while_a_block_leaves_the_belt():
    """Bullet moves the belt in a time step; its end must not stay ahead where contacts begin."""
    with closing(make("TPMConveyorDense-v0", max_episode_steps=1000)) as env:
        bare, still = env.unwrapped, np.zeros(4, np.float32)
        bare.reset(seed=10)
        for step in range(29):
            bare.step(still)
            if step < 23:
                continue
            with closing(copy.deepcopy(bare)) as other:
                bare.step(still)
                other.step(still)
                assert bits(vars(bare.state)) == bits(vars(other.state))
        end = bare.task.scene.belt.end
        assert abs(end - bare.state.object_position[0, 0]) < bare.task.scene.objects[0].width / 2


def test_a_second_snapshot_of_the_same_moment_changes_nothing():
    # Bullet normalises the turned block's quaternion each time that it is placed.
    with closing(make("TPMPush-v0")) as env:
        bare, expert = env.unwrapped, Expert(env)
        observation, _ = env.reset(seed=3)
        for _ in range(40):
            observation = env.step(expert.act(observation))[0]
            bare.save_state()
            expected = bits(vars(bare.state))
            bare.save_state()
            assert bits(vars(bare.state)) == expected


# -- copied ----------------------------------------------------------------------------------------


def test_a_copy_made_before_the_first_reset_or_after_an_episode_starts_equally():
    env = TPMEnv("pick_and_place", randomisation=EVERYTHING)
    early = copy.deepcopy(env)
    with pytest.raises(EpisodeError, match="reset"):
        early.step(np.zeros(4))
    expected = fingerprint(random_episode(env, 2, steps=10))
    assert fingerprint(random_episode(early, 2, steps=10)) == expected
    for failing, call in (("move", lambda: env.step(np.zeros(4))), ("reset", env.reset)):
        with patch.object(env.simulation, failing, None), pytest.raises(TypeError):
            call()
        late = copy.deepcopy(env)
        with pytest.raises(EpisodeError, match="reset"):
            late.step(np.zeros(4))
        env.reset()
    assert fingerprint(random_episode(late, 2, steps=10)) == expected
    for one in (env, early, late):
        one.close()


def test_a_copy_of_a_closed_environment_is_closed():
    env = TPMEnv("reach")
    env.reset(seed=0)
    env.close()
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        with pytest.raises(EpisodeError, match="closed"):
            other.reset()
        pybullet = pytest.importorskip("pybullet")
        with pytest.raises(pybullet.error):  # and holds no client
            other.simulation.engine.read()


def test_an_environment_with_a_window_refuses_to_be_copied():
    env = TPMEnv("reach")
    env.reset(seed=0)
    env._core._engine["gui"] = True  # as if it had one
    for copied in (pickle.dumps, copy.deepcopy):
        with pytest.raises(ConfigurationError, match="copied or pickled") as caught:
            copied(env)
        assert caught.value.name == "render_mode"
    env.close()
