"""Rooms import only what lies below them, and importing the package is cheap."""

import importlib
import pkgutil
import re
import subprocess
import sys
from dataclasses import is_dataclass

import pytest
from paths import ROOT

import tpm_gym


def test_the_contracts_on_imports_hold(capsys):
    cli = pytest.importorskip("importlinter.cli")  # has no version for Python 3.10
    broken = cli.lint_imports(str(ROOT / "pyproject.toml"), no_cache=True, no_logo=True)
    assert not broken, capsys.readouterr().out


def test_importing_the_package_imports_neither_an_engine_nor_what_learning_needs():
    heavy = {"pybullet", "mujoco", "torch", "stable_baselines3", "matplotlib", "yaml", "pydantic"}
    code = (
        "import sys, tpm_gym, tpm_gym.learning, tpm_gym.policy; tpm_gym.ENV_IDS;"
        "from tpm_gym.tasks import Expert; import tpm_gym.envs.testing;"
        f"print({heavy | {'scipy'}!r} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout.strip(), done.stderr) == ("set()", "")


HOT = {"State", "Course"}
"""Made in every step; frozen, they would take three times as long to make."""


def test_every_dataclass_but_errors_and_what_is_made_in_every_step_is_frozen():
    for module in pkgutil.walk_packages(tpm_gym.__path__, "tpm_gym."):
        if not re.search("__main__|learning", module.name):
            for kind in vars(importlib.import_module(module.name)).values():
                if is_dataclass(kind) and getattr(kind, "__module__", "") == module.name:
                    frozen = kind.__dataclass_params__.frozen or kind.__name__ in HOT
                    assert frozen or issubclass(kind, Exception), kind
