"""Rollouts are those on record: to the bit, or near where a processor rounds otherwise.

Their records are made by ``python tests/support/rollouts.py tests/data/rollouts.json``.
"""

import json

import pytest
from paths import ROOT
from rollouts import cases, play

from tpm_gym.tasks import Expert

RECORDED = json.loads((ROOT / "tests" / "data" / "rollouts.json").read_text(encoding="utf-8"))
FAST = {("TPMPickAndPlaceDense-v0", "expert"), ("TPMPickAndPlaceJoints-v0", "published")}


def test_every_case_is_recorded_and_no_other():
    assert set(RECORDED) == {f"{env_id} {name}" for env_id, name in cases()}
    assert set(cases()) >= FAST


@pytest.mark.parametrize(
    ("env_id", "name"),
    [pytest.param(*case, marks=[pytest.mark.slow] * (case not in FAST)) for case in cases()],
)
def test_rollouts_are_those_on_record(env_id, name):
    found, recorded = play(env_id, name, Expert), RECORDED[f"{env_id} {name}"]
    # A policy computes in single precision, and its block may be about to slip or to tip.
    near = 1e-4 if name == "published" else 1e-9
    if found["sha256"] != recorded["sha256"]:
        for key in ("returns", "gaps"):
            assert found[key] == pytest.approx(recorded[key], rel=0, abs=near)
