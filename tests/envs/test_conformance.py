"""Every id keeps what tpm_gym promises, on every machine, in every engine."""

from typing import Any

import gantry  # noqa: F401  registers a machine
import gymnasium as gym
import kinematic  # noqa: F401  registers an engine
import numpy as np
import pytest
from episodes import EVERYTHING, OF_SERVOS, conforms

import tpm_gym
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


@pytest.mark.parametrize(("env_id", "options"), CASES, ids=str)
def test_it_keeps_what_is_promised(env_id, options):
    conforms(lambda: gym.make(env_id, **options))


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
    ("task", "promise"),
    [(Unseeded, "the checkers of Gymnasium"), (Eager, "the goal's term is 0")],
)
def test_what_does_not_keep_it_is_found(task, promise):
    with pytest.raises(ConformanceError, match=promise) as caught:
        check_env(lambda: gym.make("TPMReach-v0", engine="kinematic", task=task))
    assert caught.value.promise in str(caught.value)
