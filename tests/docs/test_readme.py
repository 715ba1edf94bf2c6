"""What pages say in words is as measured."""

import json
import re

import numpy as np
import pytest
from pages import blocks
from paths import ROOT


def test_the_numbers_in_the_kinematics_block_are_right():
    block = next(b for b in blocks(ROOT / "docs/robot.md", "python") if "kinematics.inverse" in b)
    names = {}
    exec(block, names)
    theta, jacobian, kinematics = (names[n] for n in ("theta", "jacobian", "kinematics"))
    printed = float(re.search(r"conditioning\(theta\)\s+# ([\d.]+)", block).group(1))
    assert jacobian.conditioning(theta) == pytest.approx(printed, abs=5e-4)
    assert np.allclose(kinematics.forward(theta), [-0.04, 0.028, 0.80])
    assert kinematics.inverse_all([-0.04, 0.028, 0.80]).theta.shape == (16, 3)


def test_the_readmes_training_takes_a_minute_or_two():
    records = (ROOT / "docs/results").glob("TPMPickAndPlaceDense-v0-ppo-analytic-s?.json")
    seconds = [json.loads(path.read_text())["evaluations"]["wall_seconds"][-1] for path in records]
    assert len(seconds) == 5
    assert 0.5 < np.median(seconds) / 60 < 2.5


def test_the_first_run_succeeds():
    block = blocks(ROOT / "docs/first-run.md", "python")[0]
    names = {}
    exec(block, names)
    assert names["info"]["is_success"]


def test_what_the_penalty_does_is_as_measured():
    results = (ROOT / "docs/results.md").read_text(encoding="utf-8")
    lines = re.findall(
        r"^- TPM\w+-v0, PPO: ([\d.]+)% without the penalty, ([\d.]+)% with it",
        results,
        re.MULTILINE,
    )
    without, with_it = np.array(lines, dtype=float).T
    told = "of their steps at a conditioning below 0.08, depending on the id. Policies trained"
    told += " with the penalty spend at most"
    page = " ".join((ROOT / "docs/environments.md").read_text(encoding="utf-8").split())
    low, high, most = re.search(rf"(\d+) to (\d+)% {told} ([\d.]+)%", page).groups()
    assert len(lines) == 4
    assert (int(low), int(high)) == (round(without.min()), round(without.max()))
    assert with_it.max() <= float(most) < 1.1 * with_it.max()
    rows = re.findall(
        r"^\| (TPM\w+)-v0 \| PPO .* \| ([01]) \| [^|]* \| ([\d.]+)%", results, re.MULTILINE
    )
    medians = {(env_id, weight): float(median) for env_id, weight, median in rows}
    by = r"(\d+)% instead of (\d+)%"
    joints = rf"on Reach the median is {by}, on pick-and-place {by}"
    told = [int(value) for value in re.search(joints, page).groups()]
    payers = ("TPMReachJointsDense", "TPMPickAndPlaceJointsDense")
    assert told == [round(medians.pop((env_id, weight))) for env_id in payers for weight in "10"]
    assert all(median >= 99 for (_, weight), median in medians.items() if weight == "1")
