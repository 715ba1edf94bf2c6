"""Rooms import only what lies below them, and importing the package is cheap."""

import importlib
import pkgutil
import re
import subprocess
from dataclasses import is_dataclass

import pytest
from paths import ROOT
from processes import PYTHON, printed_by

import tpm_gym


def test_the_contracts_on_imports_hold(capsys):
    cli = pytest.importorskip("importlinter.cli")  # has no version for Python 3.10
    broken = cli.lint_imports(str(ROOT / "pyproject.toml"), no_cache=True, no_logo=True)
    assert not broken, capsys.readouterr().out


LEAN = """
import logging
logging.getLogger("tpm_gym").setLevel("ERROR")  # machine code need not be on disk
import sys, tpm_gym, tpm_gym.learning, tpm_gym.policy, tpm_gym.viewer, tpm_gym.envs.testing
from tpm_gym.tasks import Expert
tpm_gym.ENV_IDS
heavy = {"pybullet", "torch", "stable_baselines3", "matplotlib"}
def none_of(*packages):
    assert not {*packages, *heavy} & sys.modules.keys(), {*packages, *heavy} & sys.modules.keys()
none_of("mujoco", "yaml", "pydantic", "scipy", "viser", "numba")
from tpm_gym.kinematics import forward_all
theta = tpm_gym.PAPER_TPM.inverse([tpm_gym.PAPER_TPM.home])
assert "numba" in sys.modules
forward_all(theta)
none_of("mujoco", "pydantic", "viser")
policy = tpm_gym.load_policy("TPMReach-v0")
space = policy.description.observation_space
policy.act({name: box.sample() for name, box in space.items()})
none_of("mujoco", "viser")
import tpm_gym.learning.command_line
none_of("mujoco", "viser")
from tpm_gym.learning import EnvOptions, EvaluationConfig, evaluate
one = {"env": "TPMReach-v0", "episodes": 1, "env_options": EnvOptions(engine="analytic")}
evaluate(EvaluationConfig(policy=("expert", "random", "TPMReach-v0"), **one))
none_of("viser", "minari")
"""


def test_nothing_imports_an_engine_or_a_package_before_it_needs_it():
    done = subprocess.run([PYTHON, "-c", LEAN], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


MISSING = """
import sys, gymnasium, tpm_gym, tpm_gym.learning
from tpm_gym.learning.__main__ import main
sys.argv = ["tpm-gym", "view"]
for package, extra, use in (
    ("safetensors", "policy", lambda: tpm_gym.load_policy("TPMReach-v0")),
    ("pydantic", "policy", lambda: tpm_gym.load_policy("TPMReach-v0")),
    ("viser", "view", main),
    ("minari", "data", lambda: tpm_gym.learning.collect(tpm_gym.learning.CollectConfig())),
    ("stable_baselines3", "train", lambda: tpm_gym.learning.PenaltyHerReplayBuffer),
    ("mujoco", "mujoco", lambda: gymnasium.make("TPMReach-v0", engine="mujoco")),
    ("pybullet", "pybullet", lambda: gymnasium.make("TPMReach-v0")),
):
    sys.modules[package] = None
    try:
        use()
    except (tpm_gym.errors.MissingPackageError, SystemExit) as error:
        said = str(error)
    assert package in said and f"pip install 'tpm-gym[{extra}]'" in said, (package, said)
    del sys.modules[package]
assert "engine='mujoco' or engine='analytic'" in said
sys.modules["pybullet"] = None
for engine in ("mujoco", "analytic"):
    env = gymnasium.make("TPMPickAndPlace-v0", engine=engine)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
"""


def test_a_missing_package_is_named_with_its_extra_and_the_rest_works_without():
    printed_by(PYTHON, "-c", MISSING)


HOT = {"State", "Course"}
"""Made in every step; frozen, they would take three times as long to make."""


def test_every_dataclass_but_errors_and_what_is_made_in_every_step_is_frozen():
    for module in pkgutil.walk_packages(tpm_gym.__path__, "tpm_gym."):
        if not re.search("__main__|learning", module.name):
            for kind in vars(importlib.import_module(module.name)).values():
                if is_dataclass(kind) and getattr(kind, "__module__", "") == module.name:
                    frozen = kind.__dataclass_params__.frozen or kind.__name__ in HOT
                    assert frozen or issubclass(kind, Exception), kind
