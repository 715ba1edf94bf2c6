"""Episodes repeat exactly, records say what happened, and intervals cover what they promise."""

import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import scipy.stats
from numpy.typing import NDArray

from tpm_gym.learning.environments import make_envs
from tpm_gym.learning.errors import PolicyError, RolloutError
from tpm_gym.learning.estimates import bootstrap, wilson
from tpm_gym.learning.policies import NoisyPolicy, TrainedPolicy, load_policy
from tpm_gym.learning.rollout import TEST_SEED, Episode, run_episodes, summarise

PICK = "TPMPickAndPlace-v0"


class Scripted:
    """Vector of one environment that delivers the steps it was given, in every episode."""

    num_envs = 1
    task = SimpleNamespace(events=())

    def __init__(self, steps: list[dict[str, Any]]) -> None:
        self.steps = steps
        self.seeds: list[int] = []

    def reset(self, *, seed: int) -> tuple[Any, dict[str, Any]]:
        self.seeds.append(seed)
        self.index = 0
        return {}, {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        info = {name: np.array([value]) for name, value in self.steps[self.index].items()}
        self.index += 1
        truth, gap = np.zeros((1, 3)), info.pop("fk_error")
        self.state = SimpleNamespace(
            fk_position=truth + [[0.0, 0.0, gap[0]]],
            platform_position=truth,
            torque=info.pop("torque"),
        )
        done = np.array([self.index == len(self.steps)])
        return {}, info.pop("reward"), np.array([False]), done, info


class Idle:
    """Acts, and remembers the seeds it was reset with."""

    def __init__(self) -> None:
        self.seeds: list[int] = []

    def reset(self, observation: Any, seeds: Sequence[int]) -> None:
        self.seeds += seeds

    def act(self, observation: Any) -> NDArray[Any]:
        return np.zeros((1, 3))


def scripted_step(
    reward: float = -1.0, success: bool = False, conditioning: float = 0.5, gap: float = 1e-5
) -> dict[str, Any]:
    return {
        "reward": reward,
        "is_success": success,
        "conditioning": conditioning,
        "singularity_penalty": max(0.0, 1 - (conditioning / 0.08) ** 4),
        "closure_error": gap,
        "fk_error": 2 * gap,
        "torque": np.array([1.0, -2.0, 2.0]),
    }


def test_record_says_what_happened():
    env = Scripted(
        [
            scripted_step(-1.0, False, 0.5, 1e-5),
            scripted_step(-0.5, True, 0.07, 7e-5),
            scripted_step(-0.25, False, 0.3, 2e-5) | {"torque": np.array([0.0, 0.0, -6.0])},
        ]
    )
    (record,) = run_episodes(env, Idle(), 1, first_seed=5)
    assert record == Episode(
        seed=5,
        success_at_end=False,
        success_once=True,
        total_reward=-1.75,
        conditioning_min=0.07,
        conditioning_mean=pytest.approx(0.29),
        closure_error_max=7e-5,
        length=3,
        unsafe_share=pytest.approx(1 / 3),
        fk_error_max=pytest.approx(1.4e-4),
        torque_rms=pytest.approx(math.sqrt((2 * (1 + 4 + 4) + 36) / 9)),
        torque_peak=6.0,
    )
    assert record.as_dict()["return"] == -1.75
    (record,) = run_episodes(Scripted([scripted_step(success=True)]), Idle(), 1, first_seed=0)
    assert record.success_at_end
    assert record.success_once


def test_an_event_of_a_single_step_is_recorded():
    steps = [scripted_step() | {"hit": hit, "left": False} for hit in (False, True, False)]
    env = Scripted(steps)
    env.task = SimpleNamespace(events=("hit", "left"))
    records = run_episodes(env, Idle(), 1, first_seed=5)
    assert records[0].events == {"hit_once": True, "left_once": False}
    env.steps = steps[:1]
    records += run_episodes(env, Idle(), 3, first_seed=6)
    assert [record.as_dict()["hit_once"] for record in records] == [True, False, False, False]
    assert summarise(records)["hit_once"] == wilson([True, False, False, False])


def test_seeds_count_up_for_environment_and_policy():
    env, policy = Scripted([scripted_step()]), Idle()
    records = run_episodes(env, policy, 3, first_seed=40)
    assert [record.seed for record in records] == env.seeds == policy.seeds == [40, 41, 42]


@pytest.mark.parametrize("name", ["reward", "conditioning", "closure_error", "fk_error", "torque"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_values_that_are_not_finite_raise(name, value):
    wrong = np.array([0.0, value, 0.0]) if name == "torque" else value
    env = Scripted([scripted_step(), scripted_step() | {name: wrong}])
    with pytest.raises(RolloutError, match=f"seed 3, step 1: {name} is {value}"):
        run_episodes(env, Idle(), 1, first_seed=3)


def test_a_return_that_overflows_raises():
    env = Scripted([scripted_step() | {"reward": 1.7e308}] * 2)
    with pytest.raises(RolloutError, match=r"seed 3: its return overflows; .* penalty_weight"):
        run_episodes(env, Idle(), 1, first_seed=3)


@pytest.mark.parametrize("spec", ["random", "expert", PICK])
def test_batches_give_the_records_of_single_environments(spec):
    """More episodes than environments; returns only to the rounding of the network's batches."""
    options = {"engine": "analytic", "randomisation": {"latency": 1}}
    records, ended = [], []
    for count in (1, 3):
        with closing(make_envs(PICK, count, **options)) as envs:
            policy = load_policy(spec, envs)
            records.append(run_episodes(envs, policy, 5, TEST_SEED, on_episodes=ended.append))
    assert ended == [*[1] * 5, 3, 2]
    for one, other in zip(*records, strict=True):
        rounded = {name: 0.0 for name, value in vars(one).items() if isinstance(value, float)}
        assert replace(one, **rounded) == replace(other, **rounded)
        for name in rounded:
            assert getattr(one, name) == pytest.approx(getattr(other, name), abs=1e-3), name


@pytest.mark.parametrize(("successes", "trials"), [(81, 263), (15, 148), (0, 20), (29, 29), (1, 1)])
def test_wilson_interval_is_that_of_scipy(successes, trials):
    estimate = wilson([i < successes for i in range(trials)])
    theirs = scipy.stats.binomtest(successes, trials).proportion_ci(method="wilson")
    assert estimate.mean == successes / trials
    assert (estimate.low, estimate.high) == pytest.approx((theirs.low, theirs.high), abs=1e-15)


def test_bootstrap_intervals_are_those_of_scipy():
    scores = np.random.default_rng(3).random(12)
    found = bootstrap(scores.tolist())
    expected = scipy.stats.bootstrap(
        (scores,), np.mean, n_resamples=20_000, method="percentile", rng=0
    ).confidence_interval
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high), abs=0.01)
    assert found.mean == pytest.approx(scores.mean())


def test_summary_keeps_the_worst_of_all_episodes():
    steps = [scripted_step(gap=3e-5, conditioning=0.4), scripted_step(gap=9e-5, conditioning=0.2)]
    records = run_episodes(Scripted(steps[:1]), Idle(), 3, 0)
    records += run_episodes(Scripted(steps), Idle(), 1, 3)
    metrics = summarise(records)
    assert metrics["closure_error_max"].worst == 9e-5
    assert metrics["closure_error_max"].mean == pytest.approx((3 * 3e-5 + 9e-5) / 4)
    assert metrics["conditioning_min"].worst == 0.2
    assert metrics["conditioning_min"].mean == pytest.approx(0.35)
    assert metrics["conditioning_mean"].mean == pytest.approx((3 * 0.4 + 0.3) / 4)
    assert metrics["return"].mean == pytest.approx(-1.25)
    assert metrics["torque_peak"].worst == 2.0
    assert metrics["torque_rms"].worst == pytest.approx(math.sqrt(3))
    assert metrics["fk_error_max"].worst == pytest.approx(2 * 9e-5)
    assert metrics["success_at_end"].worst is None


def test_unknown_policies_say_what_there_is(tmp_path):
    with closing(make_envs(PICK, 1, engine="analytic")) as envs:
        with pytest.raises(PolicyError, match=r"expert, random, an exported policy"):
            load_policy("exprt", envs)
        with pytest.raises(PolicyError, match=r"best\.json or .*last\.json"):
            load_policy(str(tmp_path), envs)


@pytest.mark.parametrize("name", ["random", "noisy"])
def test_actions_do_not_depend_on_the_goal(name):
    """Environment and policy draw from one seed; from one generator, they correlated by 0.9."""
    count = 1000
    with closing(make_envs("TPMReach-v0", count, engine="analytic")) as envs:
        still = Mock(act=lambda observation: np.zeros((count, 3)))
        policy = load_policy("random", envs) if name == "random" else NoisyPolicy(still, 0.4)
        observation, _ = envs.reset(seed=0)
        policy.reset(observation, range(count))
        actions = np.hstack([policy.act(observation) for _ in range(3)])
    assert actions.std() == pytest.approx(0.4 if name == "noisy" else 3**-0.5, rel=0.05)
    assert 0.99 < np.abs(actions).max() <= 1.0
    for sizes in (actions, np.abs(actions)):
        joined = np.hstack([observation["desired_goal"], sizes])
        assert np.abs(np.corrcoef(joined.T)[:3, 3:]).max() < 0.15


def test_a_trained_policy_draws_actions_only_if_asked_to():
    model = Mock(predict=lambda seen, deterministic: (deterministic, None))
    assert [TrainedPolicy(model, mean).act({}) for mean in (True, False)] == [True, False]
