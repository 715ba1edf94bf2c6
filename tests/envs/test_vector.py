"""Vector environments: as Gymnasium wants them, and each row as the environment alone."""

import copy
import os
import pickle
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from episodes import EVERYTHING, OF_SERVOS, bits
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from processes import PYTHON, printed_by

from tpm_gym.envs.vector import TPMVectorEnv
from tpm_gym.errors import (
    ActionError,
    ConfigurationError,
    EpisodeError,
    InputError,
    ResetOptionError,
    UnreachableError,
)
from tpm_gym.kinematics import ELBOWS_OUT, inverse

PICK, JOINTS, REACH = "TPMPickAndPlace-v0", "TPMPickAndPlaceJointsDense-v0", "TPMReach-v0"
LATE = "TPMConveyorDense-v0"  # its camera is late
MODES = [mode.value for mode in AutoresetMode]


def make(env_id: str = PICK, count: int = 5, **options: Any) -> TPMVectorEnv:
    envs = gym.make_vec(env_id, num_envs=count, engine="analytic", **options)
    assert isinstance(envs, TPMVectorEnv)
    return envs


def actions_of(envs: Any, steps: int, seed: int = 0) -> Any:
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, (steps, *envs.action_space.shape)).astype(np.float32)


def assert_same(one: Any, other: Any) -> None:
    """Equal to the bit where a mask says so, through nested dictionaries and arrays of objects."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key, value in one.items():
            mask = ... if isinstance(value, dict) else one.get(f"_{key}", ...)
            pair = (value, other[key]) if mask is ... else (value[mask], other[key][mask])
            assert_same(*pair)
    elif isinstance(one, (tuple, list)) or (isinstance(one, np.ndarray) and one.dtype == object):
        for pair in zip(one, other, strict=True):
            assert_same(*pair)
    else:
        np.testing.assert_array_equal(one, other)


@pytest.fixture
def threads_for_few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let threads step few environments too, which is slow, but quick to test."""
    monkeypatch.setattr("tpm_gym.envs.vector._FEWEST", 1)


@pytest.mark.parametrize(
    ("env_id", "options"),
    [
        (REACH, {"randomisation": {"latency": 3}, "machine": "wide"}),
        (JOINTS, {"drive": "servo", "randomisation": {**EVERYTHING, **OF_SERVOS}}),
        ("TPMPickAndPlaceJoints-v0", {"randomisation": EVERYTHING, "goals": "tempting"}),
    ],
    ids=str,
)
def test_one_alone_has_the_bits_of_one_among_many(env_id, options):
    count, seed = 33, 3
    envs = make(env_id, count, **options)
    watched = {row: gym.make(env_id, engine="analytic", **options) for row in (0, 8, 32)}
    observation, _ = envs.reset(seed=seed)
    for row, env in watched.items():
        alone, _ = env.reset(seed=seed + row)
        assert_same(alone, {name: values[row] for name, values in observation.items()})
    for actions in actions_of(envs, 49):
        observation, rewards, _, _, infos = envs.step(actions)
        for row, env in watched.items():
            alone, reward, _, _, info = env.step(actions[row])
            assert_same(alone, {name: values[row] for name, values in observation.items()})
            assert reward == rewards[row]
            terms = info.pop("reward_terms")
            assert terms == {name: infos["reward_terms"][name][row] for name in terms}
            assert info == {name: infos[name][row] for name in info}


@pytest.mark.parametrize("mode", MODES)
def test_it_does_what_gymnasiums_vectors_of_single_environments_do(mode):
    count = 3
    options = {"max_episode_steps": 7, "randomisation": EVERYTHING}
    theirs = SyncVectorEnv(
        [lambda: gym.make(LATE, engine="analytic", **options)] * count,
        autoreset_mode=AutoresetMode(mode),
    )
    ours = make(LATE, count, autoreset_mode=mode, **options)
    assert ours.metadata["autoreset_mode"] == AutoresetMode(mode)
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    for got, wanted in zip(ours.reset(seed=1), theirs.reset(seed=1), strict=True):
        assert_same(got, wanted)
    assert ours.np_random_seed == theirs.np_random_seed
    states = [[rng.bit_generator.state for rng in envs.np_random] for envs in (ours, theirs)]
    assert states[0] == states[1]
    for step, actions in enumerate(actions_of(ours, 17)):
        got, wanted = ours.step(actions), theirs.step(actions)
        for one, other in zip(got, wanted, strict=True):
            assert_same(one, other)
        assert ours.observation_space.contains(got[0])
        some = np.arange(count) == step % count
        masks = [got[3] & ~some, got[3] & some] if mode == "Disabled" else [some & (step == 1)]
        for mask in masks:
            if mask.any():
                options = {"reset_mask": mask}
                pair = ours.reset(options=dict(options)), theirs.reset(options=dict(options))
                for row in np.flatnonzero(mask):
                    one, other = ({k: v[row] for k, v in seen.items()} for seen, _ in pair)
                    assert_same(one, other)
    assert ours.episode.tolist() == [env.unwrapped.episode for env in theirs.envs]


@pytest.mark.parametrize(("mode", "drive"), [*zip(MODES, ["ideal", "servo", "ideal"], strict=True)])
@pytest.mark.usefixtures("threads_for_few")
def test_threads_change_no_bit(mode, drive):
    options = {"randomisation": EVERYTHING, "drive": drive, "max_episode_steps": 7, "stagger": True}
    runs = []
    for threads in (1, 3):
        envs = make(PICK, 5, autoreset_mode=mode, num_threads=threads, **options)
        found = [envs.reset(seed=1)]
        for actions in actions_of(envs, 16):
            found.append(envs.step(actions))
            if mode == "Disabled" and found[-1][3].any():
                found.append(envs.reset(options={"reset_mask": found[-1][3]}))
        moment = envs.save_state()
        assert len(moment) == threads
        found.append((envs.step(actions), bits(vars(envs.state)), envs.goal))
        envs.restore_state(moment)
        found.append((envs.step(actions), bits(vars(envs.state)), envs.goal))
        runs.append(found)
        envs.close()
    for run in runs[1:]:
        assert_same(run, runs[0])


def test_the_first_episodes_are_of_different_lengths_where_that_is_asked_for():
    envs = make(REACH, 10, stagger=True, max_episode_steps=20)
    envs.reset(seed=0)
    ended = np.array([envs.step(actions)[3] for actions in actions_of(envs, 10)])
    envs.reset(options={"reset_mask": np.arange(10) == 0})  # the others go on
    ended = np.append(ended, [envs.step(actions)[3] for actions in actions_of(envs, 10)], axis=0)
    assert ended.sum(axis=1).max() <= 2
    assert ended.sum(axis=0).tolist() == [0] + 9 * [1]


@pytest.mark.parametrize("mode", ["assembly", "working"])
def test_past_a_singularity_an_episode_is_truncated_and_the_others_go_on(mode):
    envs: Any = gym.make_vec(REACH, num_envs=3)
    envs.reset(seed=0)
    simulation, (x, y, z) = envs._parts[1].core.simulation, envs.machine.home
    if mode == "working":
        folded = replace(ELBOWS_OUT, cos_beta=-ELBOWS_OUT.cos_beta)
        simulation.reset(np.array([0]), inverse((x, y, z), folded))
    for step in range(1, 5) if mode == "assembly" else ():
        simulation.move(np.array([(x, y - 0.01 * step, z)]), np.zeros(1, dtype=np.bool_))
    *_, ended, infos = envs.step(np.zeros((3, 3)))
    assert ended.tolist() == infos[f"{mode}_mode_changed"].tolist() == [False, True, False]
    assert not envs.step(np.zeros((3, 3)))[3].any()
    envs.close()


@pytest.mark.parametrize("randomisation", [None, EVERYTHING], ids=["nominal", "everything"])
def test_what_is_saved_goes_on_equally(randomisation):
    envs, other, unsaved = (
        make(PICK, 7, randomisation=randomisation, stagger=True) for _ in range(3)
    )
    course = actions_of(envs, 90)
    for each in (envs, unsaved):
        each.reset(seed=0)
        for actions in course[:30]:
            each.step(actions)
    moment = envs.save_state()
    expected = [unsaved.step(actions) for actions in course[30:]]
    with pytest.raises(InputError, match="got 'another number of environments"):
        make(PICK, 6, randomisation=randomisation).restore_state(moment)
    for again in (envs, other, envs):
        again.restore_state(moment)
        again.reset()  # changes nothing in the snapshot
        again.restore_state(moment)
        assert again.np_random_seed == tuple(range(7))
        for actions, wanted in zip(course[30:], expected, strict=True):
            assert_same(again.step(actions)[0], wanted[0])


@pytest.mark.parametrize(("count", "threads"), [(6, 1), (4095, 1), (4096, 2), (4097, 2)])
def test_threads_have_as_many_environments_as_are_worth_it(count, threads):
    envs, alone = (make(PICK, count, num_threads=number) for number in (64, 1))
    assert_same(*(each.reset(seed=0) for each in (envs, alone)))
    assert len(envs.save_state()) == threads
    actions = actions_of(envs, 1)[0]
    assert_same(*(each.step(actions) for each in (envs, alone)))


@pytest.mark.usefixtures("threads_for_few")
def test_copies_step_in_threads_of_their_own():
    before = threading.enumerate()
    envs = make(PICK, 6, num_threads=2)
    envs.reset(seed=0)
    course = actions_of(envs, 5)
    envs.step(course[0])
    copies = copy.deepcopy(envs), pickle.loads(pickle.dumps(envs))
    expected = [envs.step(actions) for actions in course]
    envs.close()
    for each in copies:
        for actions, wanted in zip(course, expected, strict=True):
            assert_same(each.step(actions)[0], wanted[0])
        each.close()
    assert set(threading.enumerate()) <= set(before)


@pytest.mark.usefixtures("threads_for_few")
def test_refused_snapshots_change_nothing():
    envs, alone = make(PICK, 6, num_threads=2), gym.make(PICK, engine="analytic")
    single = make(PICK, 1)
    for each in (envs, alone, single):
        each.reset(seed=0)
    first, _ = envs.save_state()
    envs.reset(seed=1)
    goal = envs.goal
    for wrong in (None, single.save_state()[0]):
        with pytest.raises(InputError, match="snapshot"):
            envs.restore_state([first, wrong])
        np.testing.assert_array_equal(envs.goal, goal)
    with pytest.raises(InputError, match="of a vector environment"):
        single.restore_state([alone.unwrapped.save_state()])


@pytest.mark.parametrize("engine", ["analytic", "pybullet"])
def test_the_first_reset_may_be_of_some(engine):
    mask, actions = np.array([False, True, False]), np.zeros((3, 3), dtype=np.float32)
    envs, all_at_once = (gym.make_vec(REACH, num_envs=3, engine=engine) for _ in range(2))
    observation, infos = envs.reset(seed=4, options={"reset_mask": mask})
    expected, _ = all_at_once.reset(seed=4)
    assert_same(infos["_conditioning"], mask)
    for name, values in observation.items():
        assert_same(values[mask], expected[name][mask])
        assert np.isfinite(values).all()
    _, rewards, _, _, infos = envs.step(actions)  # resets the others
    expected, wanted, *_ = all_at_once.step(actions)
    assert_same(rewards, np.where(mask, wanted, 0.0))
    envs.close()
    envs = gym.make_vec(REACH, num_envs=3, engine=engine, autoreset_mode="Disabled")
    envs.reset(seed=4, options={"reset_mask": mask})
    with pytest.raises(EpisodeError, match=r"environment 0.*reset_mask"):
        envs.step(actions)
    envs.reset(options={"reset_mask": ~mask})
    envs.step(actions)
    envs.close()
    all_at_once.close()


@pytest.mark.parametrize("env_id", [REACH, PICK])
def test_resets_draw_what_those_of_one_environment_do_whatever_is_chosen_between(env_id):
    count = 40
    envs, alone = make(env_id, count), gym.make(env_id, engine="analytic")
    even = np.arange(count) % 2 == 0
    envs.reset(seed=0)
    alone.reset(seed=6)
    chosen = {"goal": envs.goal[6]}
    for seed, options in ((None, {}), (None, chosen), (None, {}), (5, {}), (None, chosen), (8, {})):
        observation, _ = envs.reset(seed=seed, options={"reset_mask": even, **options})
        wanted, _ = alone.reset(seed=None if seed is None else seed + 6, options=options)
        assert_same({name: values[6] for name, values in observation.items()}, wanted)
        envs.reset(options={"reset_mask": ~even})


BAD: list[tuple[Callable[[TPMVectorEnv], Any], type[Exception], str]] = [
    (lambda envs: envs.step(np.zeros((5, 3))), ActionError, r"\(5, 4\)"),
    (lambda envs: envs.step(np.full((5, 4), np.nan)), ActionError, "finite"),
    *(
        (lambda envs, seed=seed: envs.reset(seed=seed), InputError, "0 or more, or 5")
        for seed in ([1, 2], 1.5, "1", -1, [1, 2, 3, 4, -4], "12345", [True] * 5)
    ),
    (lambda envs: envs.reset(options=[1]), ResetOptionError, "a dictionary"),
    (lambda envs: envs.reset(options={"reset_mask": [1, 0]}), ResetOptionError, "booleans"),
    (
        lambda envs: envs.reset(options={"reset_mask": np.zeros(5, dtype=bool)}),
        ResetOptionError,
        "at least one of them true",
    ),
    (lambda envs: envs.reset(options={"cube": 1}), ResetOptionError, "object"),
    (lambda envs: (envs.close(), envs.reset()), EpisodeError, "closed"),
]


@pytest.mark.parametrize(("misuse", "error", "message"), BAD)
def test_misuse_is_refused(misuse, error, message):
    envs = make()
    envs.reset(seed=0)
    with pytest.raises(error, match=message):
        misuse(envs)


def test_options_are_refused_by_name():
    for options, message in (
        ({"num_envs": 0}, "1 or more"),
        ({"max_episode_steps": 0}, "1 or more"),
        ({"stagger": "no"}, "True or False"),
        ({"autoreset_mode": "Never"}, "'NextStep', 'SameStep', 'Disabled'"),
        ({"num_envs": 10**12}, "num_envs"),
        ({"render_mode": "human"}, "render_mode"),
        ({"num_threads": 2, "observations": "pixels"}, "num_threads"),
        ({"num_threads": 0}, "1 or more"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            TPMVectorEnv(**{"task": "reach", "engine": "analytic", **options})
    with pytest.raises(EpisodeError, match="call reset"):
        make().step(np.zeros((5, 4)))
    envs = make(autoreset_mode="Disabled", max_episode_steps=1)
    envs.reset(seed=0)
    envs.step(np.zeros((5, 4)))
    with pytest.raises(EpisodeError, match="reset_mask"):
        envs.step(np.zeros((5, 4)))


@pytest.mark.parametrize(
    "wrong", [{"seed": [1, 2, 3, -4]}, {"seed": 5, "options": {"goal": "there"}}], ids=str
)
def test_a_refused_reset_seeds_nothing(wrong):
    found = []
    for refused in (False, True):
        envs = make(PICK, 4)
        envs.reset(seed=np.array([7, 8, 9, 10]))
        if refused:
            with pytest.raises((InputError, ResetOptionError)):
                envs.reset(**wrong)
        found.append((envs.step(np.zeros((4, 4)))[0], envs.reset()[0], envs.reset(seed=7)[0]))
    assert_same(*found)


@pytest.mark.usefixtures("threads_for_few")
@pytest.mark.parametrize("threads", [1, 2])
def test_a_refused_first_reset_of_some_starts_nothing(threads):
    envs = make(PICK, 4, num_threads=threads)
    options = {"reset_mask": np.arange(4) > 1, "goal": [9.0, 9.0, 9.0]}
    with pytest.raises(UnreachableError):
        envs.reset(seed=0, options=options)
    with pytest.raises(EpisodeError, match=r"environment 0; call reset\(\) first"):
        envs.step(np.zeros((4, 4)))


MANY = """
import time
import gymnasium as gym
import tpm_gym
envs = gym.make_vec("TPMPickAndPlace-v0", num_envs=16384, engine="analytic")
envs.reset(seed=0)
envs.step(envs.action_space.sample())
own, all_threads = time.thread_time(), time.process_time()
for _ in range(10):
    envs.step(envs.action_space.sample())
print((time.process_time() - all_threads) / (time.thread_time() - own))
"""


def test_one_thread_keeps_only_one_core_busy() -> None:
    """Threads of BLAS, which numpy wakes for long scalar products, would occupy the others."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "2")
    assert float(printed_by(PYTHON, "-c", MANY, env={**os.environ, **threads})) < 1.1
