"""Versions, workflows and recipes agree with the package."""

import importlib.metadata
import re

import pytest
import yaml
from paths import ROOT

import tpm_gym

WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


@pytest.mark.parametrize(
    ("file", "pattern"),
    [("CITATION.cff", r"^version: (.*)$"), ("conda/recipe.yaml", r'^  version: "(.*)"$')],
)
def test_one_version_stands_everywhere(file, pattern):
    assert re.findall(pattern, (ROOT / file).read_text(), re.MULTILINE) == [tpm_gym.__version__]


def test_the_conda_recipe_asks_for_what_the_package_needs():
    text = (ROOT / "conda" / "recipe.yaml").read_text()
    required = yaml.safe_load(text)["requirements"]["run"]
    recipe = {line.split()[0]: line.split()[1] for line in required}
    recipe["mujoco"] = recipe.pop("mujoco-python")
    requires = importlib.metadata.requires("tpm-gym") or []
    mine = [line.split(";")[0].strip() for line in requires if "extra ==" not in line]
    for name, ranges in (re.match(r"([a-z-]+)(.*)", line).groups() for line in mine):
        assert set(recipe.pop(name).split(",")) == set(ranges.split(",")), name
    assert recipe == {"python": ">=3.10"}


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_workflows_run_only_targets_and_sessions_that_exist(path):
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    sessions = set(re.findall(r"^def ([a-z]+)\(", (ROOT / "noxfile.py").read_text(), re.MULTILINE))
    jobs = yaml.safe_load(path.read_text())["jobs"].values()
    runs = [step["run"] for job in jobs for step in job.get("steps", []) if "run" in step]
    assert {run.split()[1] for run in runs if run.startswith("make ")} <= targets
    assert {run.split()[2] for run in runs if run.startswith("nox ")} <= sessions
