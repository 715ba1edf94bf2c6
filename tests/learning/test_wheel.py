"""From the wheel, in an empty environment, away from the checkout: train, kill, resume, evaluate.

make test-wheel
"""

import json
import os
import re
import signal
import subprocess
import sys
import venv
from pathlib import Path

import pytest
from paths import ROOT
from processes import printed_by, signalled

pytestmark = pytest.mark.slow

OUTSIDE = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
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


def test_a_training_is_killed_resumed_and_evaluated_beside_the_expert_and_a_published_policy(
    installed, tmp_path
):
    program = installed / "tpm-gym"
    words = ["train", "--env", "TPMReach-v0", "--steps", "1500", "--eval-episodes", "2"]
    words += ["--checkpoint-every", "100"]
    saved = tmp_path / "runs" / "TPMReach-v0-sac-s0" / "checkpoints" / "000001100.checkpoint"
    signalled([program, *words], saved.is_file, signal.SIGKILL, cwd=tmp_path, env=OUTSIDE)
    run_folder = Path("runs", "TPMReach-v0-sac-s0")
    assert "to 1,500" in printed_by(program, "resume", run_folder, cwd=tmp_path, env=OUTSIDE)
    words = ["--policy", str(run_folder), "expert", "TPMReach-v0"]
    words += ["--episodes", "3", "--json", "out.json"]
    printed_by(program, "evaluate", *words, cwd=tmp_path, env=OUTSIDE)
    trained, expert, published = json.loads((tmp_path / "out.json").read_text())["policies"]
    assert len(trained["records"]) == 3
    assert expert["success_at_end"]["mean"] == published["success_at_end"]["mean"] == 1.0


def test_the_lines_of_the_first_run_learn_reach(installed, tmp_path):
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs/first-run.md").read_text(), re.DOTALL)
    (script,) = (block for block in blocks if "import recipe" in block)
    output = printed_by(installed / "python", "-c", script, cwd=tmp_path, env=OUTSIDE)
    last = output.splitlines()[-1]
    assert last.endswith(" of 100")
    assert int(last.split()[0]) >= 95
