"""The code of the README runs, and its commands exist."""

import re
import subprocess
import textwrap

import gymnasium
import numpy as np
import pytest
from paths import ROOT

import tpm_gym

README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language):
    pattern = rf"^( *)```{language}\n(.*?)^ *```"
    found = re.finditer(pattern, README, flags=re.MULTILINE | re.DOTALL)
    return [textwrap.dedent(match.group(2)) for match in found]


def test_the_python_blocks_run():
    namespace = {}
    for block in blocks("python"):  # what is learned in 5,000 steps, test-wheel sees
        exec(block.replace("5_000", "100").replace("2_000_100", "2_000_001"), namespace)
    namespace["env"].close()
    assert namespace["info"]["closure_error"] < 1e-3


def test_the_numbers_in_the_kinematics_block_are_right():
    block = next(block for block in blocks("python") if "kinematics.inverse" in block)
    namespace = {}
    exec(block, namespace)
    theta, jacobian, kinematics = (namespace[n] for n in ("theta", "jacobian", "kinematics"))
    printed = float(re.search(r"conditioning\(theta\)\s+# ([\d.]+)", block).group(1))
    assert jacobian.conditioning(theta) == pytest.approx(printed, abs=5e-4)
    assert np.allclose(kinematics.forward(theta), [-0.04, 0.028, 0.80])
    assert kinematics.inverse_all([-0.04, 0.028, 0.80]).theta.shape == (16, 3)


def test_every_id_in_the_readme_exists():
    for env_id in re.findall(r"\bTPM\w+-v\d", README):
        assert env_id in tpm_gym.ENV_IDS
        assert env_id in gymnasium.registry


def test_make_knows_the_commands():
    targets = re.findall(r"^make ([\w-]+)", README, flags=re.MULTILINE)
    assert targets == ["demo", "test"]
    for target in targets:
        command = ["make", "--dry-run", "--directory", str(ROOT), target]
        subprocess.run(command, check=True, capture_output=True)


def test_what_the_penalty_does_is_as_measured():
    results = (ROOT / "docs/results.md").read_text(encoding="utf-8")
    lines = re.findall(
        r"^- TPM\w+-v0, PPO: ([\d.]+)% without the penalty, ([\d.]+)% with it",
        results,
        re.MULTILINE,
    )
    without, with_it = np.array(lines, dtype=float).T
    told = r"of\s+their\s+time\s+below\s+that\s+without\s+the\s+penalty\s+and\s+at\s+most"
    page = (ROOT / "docs/environments.md").read_text(encoding="utf-8")
    low, high, most = re.search(rf"(\d+) to (\d+)% {told} ([\d.]+)%", page).groups()
    assert len(lines) == 4
    assert (int(low), int(high)) == (round(without.min()), round(without.max()))
    assert with_it.max() <= float(most) < 1.1 * with_it.max()
    rows = re.findall(
        r"^\| (TPM\w+)-v0 \| PPO .* \| ([01]) \| [^|]* \| ([\d.]+)%", results, re.MULTILINE
    )
    medians = {(env_id, weight): float(median) for env_id, weight, median in rows}
    successes = re.search(r"a\s+median\s+of\s+(\d+)%\s+instead\s+of\s+(\d+)%", page).groups()
    payer = [round(medians.pop(("TPMReachJointsDense", weight))) for weight in "10"]
    assert payer == [int(value) for value in successes]
    assert all(median >= 99 for (_, weight), median in medians.items() if weight == "1")
