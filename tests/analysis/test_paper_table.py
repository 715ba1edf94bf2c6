"""docs/paper.md covers all equations, and all functions and tests that it names exist."""

import importlib
import re
from functools import reduce

import pytest
from paths import ROOT

TEXT = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
TESTS = sorted(set(re.findall(r"`(test_\w+\.py)::(\w+)`", TEXT)))
FUNCTIONS = sorted(set(re.findall(r"`((?:poc|topology|kinematics|jacobian)\.[\w.]+)`", TEXT)))
SLIPS = ["test_paper.py", "test_paper_topology.py"]


def names_of_tests(file: str) -> set[str]:
    (path,) = (ROOT / "tests").rglob(file)
    source = path.read_text(encoding="utf-8")
    return set(re.findall(r"^def (test_\w+)", source, flags=re.MULTILINE))


def test_every_equation_has_its_row():
    rows = re.findall(r"^\| \((\d+)", TEXT, flags=re.MULTILINE)
    assert {int(number) for number in rows} == set(range(1, 18))


@pytest.mark.parametrize(("file", "name"), TESTS)
def test_named_tests_exist(file, name):
    assert name in names_of_tests(file)


@pytest.mark.parametrize("file", SLIPS)
def test_every_test_of_a_slip_is_in_the_table(file):
    assert names_of_tests(file) <= {name for named, name in TESTS if named == file}


@pytest.mark.parametrize("path", FUNCTIONS)
def test_named_functions_exist(path):
    module, *names = path.split(".")
    room = {"poc": "analysis.", "topology": "analysis.", "jacobian": "kinematics."}.get(module, "")
    assert callable(reduce(getattr, names, importlib.import_module(f"tpm_gym.{room}{module}")))
