"""Modules import only what lies below them, and none outgrows its size."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE, TRAIN = ROOT / "src" / "tpm_gym", ROOT / "train"
ORDER = [
    "errors",
    "geometry",
    "branches",
    "parts",
    "reach",
    "single",
    "kinematics",
    "jacobian",
    "singularity",
    "workspace",
    "aspects",
    "links",
    "mechanism",
    "urdf",
    "poc",
    "topology",
    "state",
    "randomisation",
    "physics",
    "engine",
    "robot",
    "cup",
    "scenery",
    "simulation",
    "rewards",
    "control",
    "tasks",
    "reports",
    "checks",
    "expert",
    "env",
    "registration",
    "strict_json",
    "policy_file",
    "policy",
]
ENGINE_SIDE = {"engine", "simulation", "robot", "cup", "scenery"}
MODULES = sorted(path.stem for path in PACKAGE.glob("*.py") if path.stem != "__init__")
FILES = sorted([*PACKAGE.rglob("*.py"), *TRAIN.rglob("*.py")])
LONGEST_FUNCTION, LONGEST_FILE = 60, 400


def syntax(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def imported(path: Path) -> set[str]:
    """Absolute names of all that a file imports, wherever in the file it does so."""
    names: set[str] = set()
    for node in ast.walk(syntax(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            source = node.module or ""
            if node.level:
                source = f"tpm_gym.{source}".rstrip(".")
            names |= {source} | {f"{source}.{alias.name}" for alias in node.names}
    return names


def own_imports(module: str) -> set[str]:
    """Modules of the package that a module of the package imports."""
    names = imported(PACKAGE / f"{module}.py")
    return {
        name
        for name in ORDER
        if any(n.startswith("tpm_gym.") and n.split(".")[1] == name for n in names)
    }


def reached(module: str) -> set[str]:
    """The same, through other modules too."""
    found: set[str] = set()
    waiting = {module}
    while waiting:
        fresh = own_imports(waiting.pop()) - found
        found |= fresh
        waiting |= fresh
    return found


def test_every_module_has_its_place_in_the_order() -> None:
    assert sorted(ORDER) == MODULES
    assert [
        path for path in PACKAGE.iterdir() if path.is_dir() and path.name != "__pycache__"
    ] == []


@pytest.mark.parametrize("module", ORDER)
def test_modules_import_only_from_rows_above(module: str) -> None:
    assert own_imports(module) <= set(ORDER[: ORDER.index(module)])


@pytest.mark.parametrize("module", ORDER)
def test_modules_do_not_import_the_package_itself(module: str) -> None:
    submodules = {f"tpm_gym.{name}" for name in ORDER}
    for name in imported(PACKAGE / f"{module}.py"):
        if name.startswith("tpm_gym."):
            assert any(name == s or name.startswith(f"{s}.") for s in submodules), name


@pytest.mark.parametrize("module", ["rewards", "control", "tasks", "expert"])
def test_tasks_know_nothing_of_the_engine_even_at_second_hand(module: str) -> None:
    assert reached(module).isdisjoint(ENGINE_SIDE)


def test_registration_imports_no_module_of_the_package() -> None:
    assert own_imports("registration") == set()


def test_only_one_module_imports_the_engine() -> None:
    users = {
        path.name
        for path in PACKAGE.glob("*.py")
        if any(name.split(".")[0] in {"pybullet", "pybullet_data"} for name in imported(path))
    }
    assert users == {"engine.py"}


def test_only_the_environment_and_its_users_import_gymnasium() -> None:
    users = {
        path.stem
        for path in PACKAGE.glob("*.py")
        if any(name.split(".")[0] == "gymnasium" for name in imported(path))
    }
    assert users <= {"env", "registration", "reports", "expert", "policy", "policy_file"}


def test_the_package_imports_nothing_from_train() -> None:
    forbidden = {"train", *(path.stem for path in TRAIN.glob("*.py"))}
    for path in PACKAGE.glob("*.py"):
        assert forbidden.isdisjoint(name.split(".")[0] for name in imported(path)), path.name


def test_importing_the_package_imports_neither_engine_nor_learning_library() -> None:
    heavy = ["pybullet", "torch", "safetensors", "stable_baselines3", "matplotlib", "yaml"]
    code = f"import sys, tpm_gym; print([name for name in {heavy} if name in sys.modules])"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_files_and_functions_stay_short(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= LONGEST_FILE
    for node in ast.walk(syntax(path)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno is not None
            assert node.end_lineno - node.lineno + 1 <= LONGEST_FUNCTION, node.name
