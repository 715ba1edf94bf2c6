"""Rooms import only what lies below them, and importing the package is cheap."""

import subprocess
import sys

from importlinter.cli import lint_imports
from paths import ROOT


def test_the_contracts_on_imports_hold(capsys):
    broken = lint_imports(str(ROOT / "pyproject.toml"), no_cache=True, no_logo=True)
    assert not broken, capsys.readouterr().out


def test_importing_the_package_imports_neither_an_engine_nor_what_learning_needs():
    heavy = {"pybullet", "mujoco", "torch", "stable_baselines3", "matplotlib", "yaml", "pydantic"}
    code = (
        "import sys, tpm_gym, tpm_gym.learning, tpm_gym.policy; tpm_gym.ENV_IDS;"
        "from tpm_gym.tasks import Expert;"
        f"print({heavy | {'scipy'}!r} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout.strip(), done.stderr) == ("set()", "")
