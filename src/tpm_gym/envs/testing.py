"""Conformance checks for environments with your own task, machine or engine.

Each check takes a callable that makes an environment through Gymnasium, such as
``lambda: gym.make("TPMMine-v0")``. If the environment breaks a promise, the check raises a
:class:`~tpm_gym.errors.ConformanceError` that names the promise. With pytest::

    @pytest.mark.parametrize("check", CHECKS)
    def test_mine_conforms(check):
        check(lambda: gym.make("TPMMine-v0"))
"""

from __future__ import annotations

import copy
import hashlib
import importlib
import io
import json
import math
import pickle
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, redirect_stdout
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env as check_by_gymnasium
from numpy.typing import NDArray

from tpm_gym.arrays import brief
from tpm_gym.envs.core import INFO
from tpm_gym.errors import (
    ActionError,
    ConfigurationError,
    ConformanceError,
    EpisodeError,
    ResetOptionError,
    TPMError,
    UnreachableError,
)
from tpm_gym.mechanism.cup import CUP
from tpm_gym.tasks.expert import Expert

__all__ = ["CHECKS", "Make", "Step", "bits", "check_env", "fingerprint", "play", "random_episode"]

Env = gym.Env[Any, Any]
Make = Callable[[], Env]
Step = tuple[dict[str, Any], float, dict[str, Any]]
"""Observation, reward and info."""


def check_env(make: Make) -> None:
    """Run all checks, which takes some seconds; print nothing.

    Args:
        make: Makes the environment, with its time limit.

    Raises:
        ConformanceError: If a promise is broken.
    """
    for check in CHECKS:
        check(make)


# -- episodes to compare ------------------------------------------------------------------------


def random_episode(env: Env, seed: int, steps: int = 50) -> Iterator[Step]:
    """Reset with ``seed``, then take random steps; yield the results of the reset and each step.

    Each component of the actions is -1, 0 or 1.
    """
    rng = np.random.default_rng(seed)
    observation, info = env.reset(seed=seed)
    yield observation, 0.0, info
    for _ in range(steps):
        action = rng.choice([-1.0, 0.0, 1.0], env.action_space.shape)
        observation, reward, _, _, info = env.step(action.astype(np.float32))
        yield observation, float(reward), info


def fingerprint(steps: Iterable[Step]) -> str:
    """Return a hash of every bit of an episode."""
    digest = hashlib.sha256()
    for observation, reward, info in steps:
        for array in observation.values():
            digest.update(array.tobytes())
        digest.update(repr((reward, info)).encode())
    return digest.hexdigest()


def bits(value: Any) -> Any:
    """Return nested results with arrays replaced by their bytes, so that == compares every bit."""
    if isinstance(value, dict):
        return {name: bits(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [bits(entry) for entry in value]
    return value.tobytes() if isinstance(value, np.ndarray) else value


def play(env: Env, actions: Iterable[Any]) -> list[Any]:
    """Play actions; return each step's results and the state after it, with arrays as bytes."""
    return [(bits(env.step(action)), _state_of(env)) for action in actions]


def _state_of(env: Any) -> Any:
    return bits(vars(env.unwrapped.state))


def _require(promise: str, kept: Any, found: str = "this does not hold") -> None:
    if not kept:
        raise ConformanceError(promise, found)


def _refused(call: Callable[[], Any], *kinds: type[TPMError]) -> TPMError:
    """Call a function that must raise one of the errors ``kinds``, and return its error."""
    names = " or ".join(kind.__name__ for kind in kinds)
    try:
        call()
    except kinds as error:
        return error
    except Exception as error:
        raise ConformanceError(f"{names} is raised", repr(error)) from error
    raise ConformanceError(f"{names} is raised", "nothing was")


# -- checks -------------------------------------------------------------------------------------


def passes_the_checkers_of_gymnasium_and_sb3(make: Make) -> None:
    """Run Gymnasium's checker, and Stable-Baselines3's checker if the package is installed."""
    sb3 = None
    if find_spec("stable_baselines3") is not None:  # its own warnings are no errors
        sb3 = importlib.import_module("stable_baselines3.common.env_checker")
    # Stable-Baselines3 prints that compute_reward() makes a goal environment, as it should be.
    quiet = redirect_stdout(io.StringIO())
    with closing(make()) as env, warnings.catch_warnings(), quiet:
        warnings.simplefilter("error")
        try:
            inner: Any = env.unwrapped
            # Engines must draw colours only.
            inner.metadata = {**inner.metadata, "render_modes": ["rgb_array"]}
            check_by_gymnasium(inner)
            if sb3 is not None:
                sb3.check_env(env.unwrapped)
        except AssertionError as error:
            promise = "the checkers of Gymnasium and Stable-Baselines3 find nothing"
            raise ConformanceError(promise, str(error)) from error


def gives_observations_of_order_one_and_plain_infos(make: Make) -> None:
    """Check the types, bounds and keys of observations and infos."""
    largest = 0.0
    with closing(make()) as env:
        for index, (observation, reward, info) in enumerate(random_episode(env, 1)):
            inside = env.observation_space.contains(observation)
            _require("observations are in the space", inside, str(observation))
            # Wrappers add entries; rl_zoo3 even patches Gymnasium's own TimeLimit.
            kinds = {name: type(info.get(name)) for name in INFO}
            _require(f"info has the types {INFO}", kinds == INFO, str(kinds))
            terms = info["reward_terms"]
            plain = all(type(term) is float for term in terms.values())
            _require("reward terms are floats", plain, str(terms))
            for name, high in (("conditioning", 1), ("vacuum", CUP.vacuum)):
                _require(f"{name} is in [0, {high}]", 0 <= info[name] <= high, str(info[name]))
            penalty = info["singularity_penalty"]
            _require("the penalty is in [0, 1]", 0 <= penalty <= 1, str(penalty))
            left = info["assembly_mode_changed"] or info["working_mode_changed"]
            _require("no random action leads past a singularity", not left)
            total = sum(terms.values()) if index else 0.0
            same = math.isclose(total, reward, rel_tol=1e-12, abs_tol=1e-12)
            _require("reward terms sum to the reward", same, f"{total} is not {reward}")
            largest = max(largest, float(np.abs(observation["observation"]).max()))
    _require("observations are of order one", 0.5 < largest < 5.0, f"largest is {largest}")


def truncates_episodes_at_their_last_step(make: Make) -> None:
    """Check that an episode is truncated at its last step, and never terminated."""
    with closing(make()) as env:
        env.reset(seed=0)
        steps = _steps_of(env)
        flags = [env.step(env.action_space.sample())[2:4] for _ in range(steps)]
    expected = [(False, False)] * (steps - 1) + [(False, True)]
    _require(f"is truncated in step {steps}, never terminated", flags == expected, str(flags))


def _steps_of(env: Env) -> int:
    steps = None if env.spec is None else env.spec.max_episode_steps
    if steps is None:
        raise ConfigurationError("make", env, "a callable that uses gym.make, which sets a limit")
    return steps


def repeats_resets_with_the_seed(make: Make) -> None:
    """Compare the goals after resets with equal seeds, different seeds and no seed."""
    with closing(make()) as env:
        first, second, again = (env.reset(seed=seed)[0]["desired_goal"] for seed in (3, 4, 3))
        last = env.reset()[0]["desired_goal"]
    _require("other seeds give other goals", not np.array_equal(first, second))
    _require("equal seeds give equal goals", np.array_equal(first, again))
    _require("a reset without a seed draws a new goal", not np.array_equal(last, again))


def shares_no_memory(make: Make) -> None:
    """Overwrite returned arrays, and check that the environment does not change."""
    with closing(make()) as env:
        steps = list(random_episode(env, 7, steps=3))
        for index, (observation, _, _) in enumerate(steps):
            for other, _, _ in steps[index + 1 :]:
                shared = [k for k in other if np.shares_memory(observation[k], other[k])]
                _require("observations share no memory", not shared, f"{shared} do")
        inner: Any = env.unwrapped
        state, goal = _state_of(env), inner.goal
        for array in steps[-1][0].values():
            array[:] = 9.0
        inner.goal[:] = 9.0
        _require("observations are copies of the state", _state_of(env) == state)
        _require("the goal is a copy", np.array_equal(inner.goal, goal))


def computes_rewards_of_batches(make: Make) -> None:
    """Check compute_reward for the desired goals and for the achieved goals of an episode."""
    with closing(make()) as env:
        steps = list(random_episode(env, 8))[1:]
        inner: Any = env.unwrapped
        compute = inner.compute_reward
    achieved, desired = (
        np.array([observation[name] for observation, _, _ in steps])
        for name in ("achieved_goal", "desired_goal")
    )
    infos, rewards = [info for *_, info in steps], [reward for _, reward, _ in steps]
    found = compute(achieved, desired, infos)
    _require("compute_reward gives the rewards", np.array_equal(found, rewards), str(found))
    one = compute(achieved[0], desired[0], infos[0])
    _require("compute_reward gives one reward", one == rewards[0], f"{one} is not {rewards[0]}")
    terms = [info["reward_terms"] for info in infos]
    empty: list[dict[str, Any]] = [{}] * len(steps)
    goals = np.array([own["goal"] for own in terms])
    alone = np.array_equal(compute(achieved, desired, empty), goals)
    _require("with an empty info compute_reward gives the goal's term", alone)
    best = compute(achieved, achieved, empty)
    _require("the goal's term is 0 where the goal is achieved", not best.any(), str(best))
    others = np.array([sum(own.values()) for own in terms]) - goals
    kept = np.allclose(compute(achieved, achieved, infos), others, rtol=0, atol=1e-12)
    _require("relabelled rewards keep the other terms", kept)


def bad_actions(size: int) -> Iterator[Any]:
    """Yield values that are not valid actions of length ``size``."""
    ones = np.ones(size)
    yield from (np.full(size, np.nan), np.where(np.arange(size) == 1, np.inf, ones))
    yield from (np.ones(size + 1), np.ones((1, size)), 0.0, None, [[0.0], [0.0, 1.0]], {})
    yield from ("up", ["0.1"] * size, [10**400] + [0] * (size - 1), [10**5000] * size)
    yield from (ones + 1j, np.array(["2026-01-01"] * size, dtype="datetime64[D]"))
    yield np.ma.masked_array(ones, mask=ones > 0)
    if torch := sys.modules.get("torch"):
        yield torch.ones(size, requires_grad=True)


def refuses_bad_actions_and_has_not_moved_then(make: Make) -> None:
    """Step with values that are not valid actions; check that state and later steps stay equal."""

    def run(env: Env, hostile: bool) -> Any:
        half: NDArray[Any] = np.full(env.action_space.shape or (), 0.5)
        env.reset(seed=9)
        for _ in range(3):
            env.step(half)
        state = _state_of(env)
        for action in bad_actions(half.size) if hostile else ():
            _refused(lambda action=action: env.unwrapped.step(action), ActionError)  # type: ignore[misc]
            _require("a refused action moves nothing", _state_of(env) == state, str(type(action)))
        return play(env, [-half] * 3)

    with closing(make()) as env:
        _require("refused actions leave no trace", run(env, True) == run(env, False))


def clips_actions_and_leaves_them_as_they_are(make: Make) -> None:
    """Check that actions beyond the bounds of the action space act like actions at its bounds.

    Also check that step() does not change the action.
    """

    def run(env: Env, size: float) -> Any:
        env.reset(seed=10)
        action: NDArray[Any] = np.full(env.action_space.shape or (), size)
        result = bits(env.unwrapped.step(action))
        _require("step() does not write into its action", (action == size).all())
        return result

    with closing(make()) as env:
        ends = [run(env, size) for size in (1.0, 1e9, float(np.finfo(np.float64).max))]
    _require("actions are clipped", ends[0] == ends[1] == ends[2])


def refuses_bad_options_and_keeps_the_episode_then(make: Make) -> None:
    """Reset with impossible options, and check that the episode continues unchanged."""
    with closing(make()) as env:
        bare: Any = env.unwrapped
        blocks, size = bare.task.scene.objects, bare.task.goal_size
        home = bare.machine.mount.to_world(bare.machine.home)
        bad: list[Any] = [{"colour": "red"}, ["goal"], 7, np.zeros(2)]
        for name, length in (("goal", size), *((block.name, 3) for block in blocks)):
            numbers = ([5.0] * length, [np.nan] * length, [0.0] * (length + 1), [10**400] * length)
            bad += [{name: value} for value in (*numbers, "there", None)]
        bad += [{block.name: home} for block in blocks]  # inside the robot

        def now() -> Any:
            return _state_of(env), bare.goal.tolist(), bare.np_random.bit_generator.state

        ones: NDArray[Any] = np.ones(env.action_space.shape or ())
        env.reset(seed=11)
        env.step(ones)
        before = now()
        for options in bad:
            for seed in (None, 5):
                error = _refused(
                    lambda seed=seed, options=options: bare.reset(seed=seed, options=options),  # type: ignore[misc]
                    ResetOptionError,
                    UnreachableError,
                )
                if isinstance(error, ResetOptionError) and isinstance(options, dict):
                    _require("errors name the option", error.name in options, error.name)
                _require("refused options change nothing", now() == before, str(brief(options)))
        env.step(ones)
        inside = env.observation_space.contains(env.reset(seed=12)[0])
        _require("a reset after refused options works", inside)


def refuses_steps_outside_an_episode(make: Make) -> None:
    """Check that steps before the first reset and after close() are refused."""
    bare: Any = make().unwrapped
    action: NDArray[Any] = np.zeros(bare.action_space.shape)
    for call in (lambda: bare.step(action), lambda: bare.state, bare.save_state):
        said = str(_refused(call, EpisodeError))
        _require("errors before the first episode speak of reset", "reset" in said, said)
    bare.reset(seed=0)
    snapshot = bare.save_state()
    bare.close()
    bare.close()
    calls: tuple[Callable[[], Any], ...] = (
        lambda: bare.step(action),
        bare.reset,
        bare.render,
        bare.save_state,
        lambda: bare.restore_state(snapshot),
    )
    for call in calls:
        said = str(_refused(call, EpisodeError))
        _require("errors after close() say so", "closed" in said, said)


def continues_copies_and_snapshots_equally(make: Make) -> None:
    """Continue an episode in a copy, after pickling, and from a snapshot.

    The results must equal those of the original environment, up to and including the next reset.
    """
    with closing(make()) as env, closing(make()) as restored:
        steps = min(15, _steps_of(env) // 2)
        for other in (env, restored):  # wrappers count their own steps
            for _ in random_episode(other, 4, steps=steps):
                pass
        inner: Any = restored.unwrapped
        inner.reset(seed=99)
        saving: Any = env.unwrapped
        moment, now = saving.save_state(), _state_of(env)
        copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
        shape = (_steps_of(env) - steps, *(env.action_space.shape or ()))
        actions = np.random.default_rng(2).uniform(-1, 1, shape)
        expected = play(env, actions), bits(env.reset()[0])
        _require("the last step truncates", expected[0][-1][0][3] is True)
        seen = inner.restore_state(pickle.loads(pickle.dumps(moment)))
        inside = restored.observation_space.contains(seen)
        _require("restore_state() returns an observation", inside, str(seen))
        _require("restoring gives the saved state", _state_of(restored) == now)
        for name, other in zip(("copy", "pickle", "snapshot"), (*copies, restored), strict=True):
            found = play(other, actions), bits(other.reset()[0])
            _require(f"a {name} continues equally", found == expected)
            other.close()
        env.step(actions[0])  # with the others closed


def gives_the_rows_of_its_vector_environment(make: Make) -> None:
    """Compare every row of a vector environment with a single environment."""
    with closing(make()) as env:
        spec: Any = copy.deepcopy(env.spec)
        spec.kwargs.pop("render_mode", None)
        shape = (3, *(env.action_space.shape or ()))
        envs: Any = gym.make_vec(spec, num_envs=3)
        with closing(envs):
            envs.reset(seed=9)
            envs.step(np.zeros(shape, dtype=np.float32))  # so that the next reset ends episodes
            rng = np.random.default_rng(0)
            actions = rng.uniform(-1, 1, (min(10, _steps_of(env) - 1), *shape)).astype(np.float32)
            batch, _ = envs.reset(seed=[0, 1, 2])
            batches, rewards = [batch], []
            for taken in actions:
                batch, paid, *_ = envs.step(taken)
                batches.append(copy.deepcopy(batch))
                rewards.append(paid.copy())
        for row in range(3):
            alone, _ = env.reset(seed=row)
            for index, batch in enumerate(batches):
                if index:
                    alone, reward, *_ = env.step(actions[index - 1, row])
                    found = rewards[index - 1][row]
                    said = f"{found} is not {reward}"
                    _require(f"row {row} of a vector has its reward", found == reward, said)
                of_row = bits({name: values[row] for name, values in batch.items()})
                _require(f"row {row} of a vector is the environment", of_row == bits(alone))


def survives_json(make: Make) -> None:
    """Send the environment's spec through JSON, and compare episodes."""
    with closing(make()) as env:
        spec: Any = env.spec
        again = EnvSpec.from_json(spec.to_json())
        same = json.loads(again.to_json()) == json.loads(spec.to_json())
        _require("the spec survives JSON", same)
        with closing(gym.make(again)) as other:
            prints = [fingerprint(random_episode(one, 3, 5)) for one in (env, other)]
    _require("a spec from JSON makes the same environment", prints[0] == prints[1])


def is_solved_by_its_expert(make: Make) -> None:
    """Check that the expert succeeds with seeds 0 and 1.

    The check is skipped for pixel observations, and for tasks without a plan for the expert.
    """
    with closing(make()) as env:
        if "pixels" in getattr(env.observation_space, "spaces", ()):
            return
        expert = Expert(env)
        for seed in range(2):
            observation, info = env.reset(seed=seed)
            done = False
            while not done:
                try:
                    action = expert.act(observation)
                except ConfigurationError as error:
                    if error.name == "expert":
                        return
                    raise
                inside = env.action_space.contains(action)
                _require("the expert's actions are in the space", inside, str(action))
                observation, _, _, done, info = env.step(action)
                _require("the expert loses no object", not info["object_lost"])
                gap = info["closure_error"]
                _require("loops stay closed within 0.5 mm", gap < 0.5e-3, f"{1e3 * gap:.2g} mm")
            _require(f"the expert succeeds with seed {seed}", info["is_success"])


CHECKS: tuple[Callable[[Make], None], ...] = (
    passes_the_checkers_of_gymnasium_and_sb3,
    gives_observations_of_order_one_and_plain_infos,
    truncates_episodes_at_their_last_step,
    repeats_resets_with_the_seed,
    shares_no_memory,
    computes_rewards_of_batches,
    refuses_bad_actions_and_has_not_moved_then,
    clips_actions_and_leaves_them_as_they_are,
    refuses_bad_options_and_keeps_the_episode_then,
    refuses_steps_outside_an_episode,
    continues_copies_and_snapshots_equally,
    gives_the_rows_of_its_vector_environment,
    survives_json,
    is_solved_by_its_expert,
)
"""Checks of this suite, in order."""
