"""Every id keeps what tpm_gym promises, on every machine, in every engine."""

from typing import Any

import gantry  # noqa: F401  registers a machine
import gymnasium as gym
import kinematic  # noqa: F401  registers an engine
import numpy as np
import pytest
from episodes import EVERYTHING, OF_SERVOS, conforms

import tpm_gym
from tpm_gym.envs import testing
from tpm_gym.envs.testing import check_env
from tpm_gym.errors import ConformanceError
from tpm_gym.tasks import Reach

CASES: list[tuple[str, dict[str, Any]]] = [
    *((env_id, {}) for env_id in tpm_gym.ENV_IDS),
    *((e, {"machine": "wide", "engine": "analytic"}) for e in tpm_gym.ENV_IDS if "Dense" in e),
    ("TPMPickAndPlaceJoints-v0", {"goals": "tempting"}),
    ("TPMPickAndPlace-v0", {"randomisation": EVERYTHING}),
    ("TPMReachJoints-v0", {"engine": "mujoco"}),
    ("TPMPickAndPlace-v0", {"engine": "mujoco", "randomisation": EVERYTHING}),
    ("TPMPickAndPlaceJointsDense-v0", {"engine": "mujoco", "machine": "wide", "drive": "servo"}),
    ("TPMPickAndPlace-v0", {"engine": "mujoco", "machine": "gantry"}),
    ("TPMConveyorDense-v0", {"engine": "mujoco"}),
    ("TPMPickAndPlaceDense-v0", {"engine": "analytic", "machine": "delta"}),
    ("TPMReachJointsDense-v0", {"engine": "analytic"}),
    ("TPMPickAndPlace-v0", {"engine": "analytic", "randomisation": EVERYTHING}),
    ("TPMPickAndPlaceJoints-v0", {"engine": "analytic", "machine": "wide"}),
    (
        "TPMPickAndPlace-v0",
        {"engine": "analytic", "drive": "servo", "randomisation": EVERYTHING | OF_SERVOS},
    ),
    ("TPMPickAndPlaceJoints-v0", {"drive": "servo", "randomisation": EVERYTHING | OF_SERVOS}),
    ("TPMPickAndPlace-v0", {"machine": "gantry"}),
    ("TPMPickAndPlaceJoints-v0", {"engine": "analytic", "shield": True, "goals": "tempting"}),
    ("TPMPickAndPlace-v0", {"drive": "servo", "shield": True, "randomisation": {"latency": 2}}),
    ("TPMCycleDense-v0", {"engine": "mujoco", "drive": "servo"}),
    ("TPMCycle-v0", {"engine": "analytic", "drive": "servo", "machine": "wide"}),
    ("TPMCycleJoints-v0", {"engine": "analytic", "goals": "tempting"}),
    ("TPMReach-v0", {"engine": "kinematic"}),
    ("TPMPickAndPlaceJoints-v0", {"engine": "kinematic"}),
]


OF_MOTION = (
    testing.passes_the_checkers_of_gymnasium_and_sb3,
    testing.shares_no_memory,
    testing.refuses_bad_actions_and_has_not_moved_then,
    testing.clips_actions_and_leaves_them_as_they_are,
    testing.refuses_bad_options_and_keeps_the_episode_then,
    testing.refuses_steps_outside_an_episode,
    testing.continues_copies_and_snapshots_equally,
    testing.gives_the_rows_of_its_vector_environment,
    testing.is_solved_by_its_expert,
)
"""Checks of what an id with sparse rewards shares with the same id with dense rewards."""


@pytest.mark.parametrize(("env_id", "options"), CASES, ids=str)
def test_it_keeps_what_is_promised(env_id, options):
    also_dense = (env_id.replace("-v0", "Dense-v0"), options) in CASES
    conforms(lambda: gym.make(env_id, **options), without=OF_MOTION if also_dense else ())


def but_the_reward(env_id: str) -> dict[str, Any]:
    """Return an id's entry in the registry without its name and its kind of reward."""
    entry = vars(gym.spec(env_id))
    kwargs = {name: value for name, value in entry["kwargs"].items() if name != "reward"}
    return {**entry, "id": None, "name": None, "kwargs": kwargs}


def test_sparse_and_dense_ids_differ_in_nothing_but_the_reward():
    """Therefore the checks of motion are not repeated with sparse rewards."""
    for env_id in tpm_gym.ENV_IDS:
        dense = env_id.replace("-v0", "Dense-v0")
        if dense in tpm_gym.ENV_IDS:
            assert but_the_reward(env_id) == but_the_reward(dense)


def test_nothing_is_printed_if_all_is_kept(capsys):
    check_env(lambda: gym.make("TPMReach-v0", engine="analytic"))
    assert capsys.readouterr() == ("", "")


class Unseeded(Reach):
    """Draws from a generator of its own."""

    rng = np.random.default_rng(0)

    def sample(self, rngs: Any, chosen: Any) -> Any:
        return super().sample([self.rng] * len(rngs), chosen)


class Eager(Reach):
    """Says that it succeeded always."""

    def gap(self, achieved: Any, desired: Any) -> Any:
        return 0.0 * super().gap(achieved, desired)

    def goal_term(self, gap: Any) -> Any:
        return super().goal_term(gap) - 1.0


@pytest.mark.parametrize(
    ("task", "promise"), [(Unseeded, "the checkers of Gymnasium"), (Eager, "the goal's term is 0")]
)
def test_what_does_not_keep_it_is_found(task, promise):
    with pytest.raises(ConformanceError, match=promise) as caught:
        check_env(lambda: gym.make("TPMReach-v0", engine="kinematic", task=task))
    assert caught.value.promise in str(caught.value)
