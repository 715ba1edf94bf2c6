"""Each example runs, is short, is listed, and prints what a reader can check."""

import importlib.util
import json
import re

import pytest
from paths import ROOT
from processes import PYTHON, printed_by

EXAMPLES = ROOT / "examples"
PRINTED = {
    "behaviour_cloning": ("1", r"network: [\d.]+% of 400 episodes"),
    "cleanrl_ppo": ("4096", r"4,096 steps: success at the end [\d.]+%"),
    "kinematics_only": (
        None,
        r"Jacobian against differences: \S+e-(0[7-9]|1\d) m/rad\n(y = .*\n){4}83\.4% of",
    ),
    "own_block_task": (None, r"expert: (9[5-9]\.\d|100\.0)% of 200 episodes, in the wall 0\.0%"),
    "own_machine": (None, r"the expert succeeds in (9\d|100) of 100 episodes"),
    "own_task": (None, r"expert: (9\d\.\d|100\.0)% of 200 episodes"),
    "ppo_analytic": ("4096", r"4,096 steps in \d+ s\nsuccess at the end: [\d.]+% of 500"),
    "sb3_hindsight": ("200", r"success at the end: [\d.]+% of 200 episodes"),
    "skrl_ppo": ("4096", r"success at the end: [\d.]+% of 200 episodes"),
}
"""Example -> its number of steps in this test, and the pattern of what it prints."""
NEEDS = {"skrl_ppo": "skrl"}


def run(name, folder, *arguments):
    """Run an example in a folder of its own, and return what it prints."""
    if name in NEEDS and importlib.util.find_spec(NEEDS[name]) is None:
        pytest.skip(f"{NEEDS[name]} is not installed")
    return printed_by(PYTHON, EXAMPLES / f"{name}.py", *arguments, cwd=folder)


LONG = "behaviour_cloning"  # plays 40,000 steps of the expert and of the network


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == LONG)) for name in PRINTED]
)
def test_an_example_runs(name, tmp_path):
    steps, pattern = PRINTED[name]
    printed = run(name, tmp_path, *([] if steps is None else [steps]))
    assert re.search(pattern, printed), printed


@pytest.mark.slow
def test_the_notebook_runs(capsys):
    if importlib.util.find_spec("nbclient") and importlib.util.find_spec("ipykernel"):
        import nbclient
        import nbformat

        nbclient.execute(nbformat.read(EXAMPLES / "first_run.ipynb", as_version=4))
        return
    names = {}
    for cell in json.loads((EXAMPLES / "first_run.ipynb").read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    printed = capsys.readouterr().out
    assert "success: True" in printed
    assert int(re.search(r"of the policy: (\d+) of 100", printed).group(1)) >= 95


def test_the_notebook_holds_no_outputs():
    cells = json.loads((EXAMPLES / "first_run.ipynb").read_text(encoding="utf-8"))["cells"]
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in cells)


def test_every_example_is_short_tested_and_on_the_page():
    scripts = sorted(EXAMPLES.glob("*.py"))
    assert [path.stem for path in scripts] == sorted(PRINTED)
    page = (ROOT / "docs/examples.md").read_text(encoding="utf-8")
    for path in (*scripts, EXAMPLES / "first_run.ipynb"):
        assert f"(../examples/{path.name})" in page, path.name
    for path in scripts:
        assert len(path.read_text(encoding="utf-8").splitlines()) < 60, path.name


SUCCESS = {"cleanrl_ppo": 90, "ppo_analytic": 90, "sb3_hindsight": 90, "skrl_ppo": 90}
"""Least success of a whole run, percent."""


@pytest.mark.slow
@pytest.mark.parametrize("name", SUCCESS)
def test_a_whole_run_succeeds(name, tmp_path):
    last = re.findall(r"success at the end:? ([\d.]+)%", run(name, tmp_path))[-1]
    assert float(last) >= SUCCESS[name]
