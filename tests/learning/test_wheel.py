"""From the wheel, in an empty environment, away from the checkout: train, kill, resume, evaluate.

make test-wheel
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
import venv
from pathlib import Path

import pytest
from paths import ROOT

pytestmark = pytest.mark.slow

OUTSIDE = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The programs of an environment in which nothing but the wheel is installed."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(folder), str(ROOT)]
    subprocess.run(build, check=True)
    (wheel,) = folder.glob("*.whl")
    venv.create(folder / "env", with_pip=True)
    programs = folder / "env" / "bin"
    pip = [str(programs / "python"), "-m", "pip", "install", "-q"]
    constraints = ["-c", str(ROOT / "constraints.txt")]
    subprocess.run([*pip, *constraints, f"{wheel}[train]"], check=True, cwd=folder, env=OUTSIDE)
    return programs


def run(folder: Path, *command: str | Path) -> str:
    done = subprocess.run(
        command, cwd=folder, env=OUTSIDE, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_training_is_killed_resumed_and_evaluated_beside_the_expert(
    installed: Path, tmp_path: Path
) -> None:
    program = installed / "tpm-gym"
    words = ["train", "--env", "TPMReach-v0", "--steps", "1500", "--eval-episodes", "2"]
    process = subprocess.Popen(
        [program, *words, "--checkpoint-every", "100"],
        cwd=tmp_path,
        env=OUTSIDE,
        stdout=subprocess.DEVNULL,
    )
    checkpoints = tmp_path / "runs" / "TPMReach-v0-sac-s0" / "checkpoints"
    deadline = time.monotonic() + 120
    while not (checkpoints / "000001100").is_dir() and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.kill()
    process.wait()
    run_folder = Path("runs", "TPMReach-v0-sac-s0")
    assert "to 1,500" in run(tmp_path, program, "resume", run_folder)
    words = ["--policy", str(run_folder), "expert", "--episodes", "3", "--json", "out.json"]
    run(tmp_path, program, "evaluate", *words)
    trained, expert = json.loads((tmp_path / "out.json").read_text())["policies"]
    assert len(trained["records"]) == 3
    assert expert["success_at_end"]["mean"] == 1.0


def test_the_published_policies_come_along(installed: Path, tmp_path: Path) -> None:
    program = (
        "import gymnasium as gym, tpm_gym\n"
        "assert 'site-packages' in tpm_gym.__file__\n"
        "policy = tpm_gym.load_policy('TPMPickAndPlace-v0')\n"
        "env = gym.make('TPMPickAndPlace-v0'); observation, _ = env.reset(seed=0); done = False\n"
        "while not done:\n"
        "    observation, _, _, done, info = env.step(policy.act(observation))\n"
        "print(info['is_success'])\n"
    )
    assert "True" in run(tmp_path, installed / "python", "-c", program)


def test_the_readmes_lines_learn_reach(installed: Path, tmp_path: Path) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    (script,) = (block for block in blocks if "import recipe" in block)
    last = run(tmp_path, installed / "python", "-c", script).splitlines()[-1]
    assert last.endswith(" of 100")
    assert int(last.split()[0]) >= 95
