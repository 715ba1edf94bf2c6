"""Compiled functions are those of today's sources, whatever the files on disk say."""

import importlib
import logging
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from processes import PYTHON, printed_by

from tpm_gym import compiling

SOURCES = {
    "__init__": "",
    "scale": "SCALE = 2.0\n",
    "law": "from own.scale import SCALE\n\ndef law(x: float) -> float:\n    return SCALE * x\n",
    "other": "OTHER = 1\n",
    "main": """
from tpm_gym.compiling import compilable, kept
from own import law

compilable(law.law)

@kept
def apply(x: float) -> float:
    return below(x)

def below(x: float) -> float:
    return law.law(x)

compilable(below)
""",
}

NESTED = """
from tpm_gym.compiling import compilable, kept
from own import law

compilable(law.law)

def rows(law):
    def evaluate(x: float) -> float:
        return law(x)

    compilable(evaluate)
    return evaluate

def loop(row):
    def apply(x: float) -> float:
        return row(x)

    return apply

apply = kept(loop(rows(law.law)))
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "own").mkdir()
    for name, text in SOURCES.items():
        (tmp_path / "own" / f"{name}.py").write_text(text)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "kept"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def fresh() -> Any:
    """The function, as a new process has it."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "own"]:
        del sys.modules[name]
    importlib.invalidate_caches()
    return importlib.import_module("own.main").apply


def called() -> tuple[float, int]:
    """What the function returns, and how many signatures were on disk."""
    function = fresh()
    return function(1.5), sum(function.stats.cache_hits.values())


def environment_of(folder: Path) -> dict[str, str]:
    """Return the variables of another process that imports from and keeps code in the folder."""
    paths = os.pathsep.join([str(folder), *sys.path])
    return os.environ | {"NUMBA_CACHE_DIR": str(folder / "kept"), "PYTHONPATH": paths}


def test_a_kept_function_is_compiled_again_when_what_is_compiled_into_it_changes(folder):
    assert [called(), called()] == [(3.0, 0), (3.0, 1)]
    (folder / "own/other.py").write_text("OTHER = 2\n")
    assert called() == (3.0, 1)
    (folder / "own/scale.py").write_text("SCALE = 4.0\n")
    assert [called(), called()] == [(6.0, 0), (6.0, 1)]
    (folder / "own/law.py").write_text("def law(x: float) -> float:\n    return x\n")
    assert [called(), called()] == [(1.5, 0), (1.5, 1)]


def test_a_function_that_was_compiled_without_bytecode_is_found_with_it(folder):
    (folder / "own/main.py").write_text(NESTED)
    code = "from own.main import apply; print(apply(1.5), sum(apply.stats.cache_hits.values()))"
    environment = environment_of(folder)
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    found = [printed_by(PYTHON, "-c", code, env=environment) for _ in range(2)]
    assert found == ["3.0 0\n", "3.0 1\n"]


LAWS = """
import numpy as np
from beside import root
from own import law as namespace

HALF = 0.5

def twice(x): return 2.0 * x
def thrice(x): return 3.0 * x
def power(x, ns): return ns.law(x)
def named(x, base=HALF): return base * x

def loop(law=twice, a=2.0, b=3.0, table=np.zeros(2000)):
    def apply(x): return law(x) * a - b + table[500] + power(x, namespace) + root(x) + named(x)

    return apply
"""


def laws(folder: Path) -> Any:
    """The module of LAWS, as a new process has it; it uses another package, ``beside``."""
    sys.modules.pop("beside", None)
    (folder / "own/main.py").write_text(LAWS)
    if not (folder / "beside.py").exists():
        (folder / "beside.py").write_text("def root(x): return x\n")
    with pytest.raises(AttributeError):  # no function ``apply``
        fresh()
    return sys.modules["own.main"]


def test_functions_that_differ_in_their_closure_alone_have_different_stamps(folder):
    main, table = laws(folder), np.zeros(2000)
    table[500] = 1e-12
    functions = [
        main.loop(),
        main.loop(main.thrice),
        main.loop(a=3.0, b=2.0),
        main.loop(b=2.0),
        main.loop(table=table),
        main.loop(table=table.astype(np.float32)),
        main.loop((main.twice, main.thrice, main.twice)),
        main.loop((main.twice, main.thrice, main.thrice)),
        main.loop(np.dtype(np.float32)),
        main.loop(np.dtype(np.float64)),
        main.loop(None),
    ]
    stamps = [compiling.stamp(function) for function in functions]
    assert len(set(stamps)) == len(stamps)
    assert compiling.stamp(laws(folder).loop()) == stamps[0]


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("beside.py", "return x", "return -x"),  # another package
        ("own/scale.py", "2.0", "4.0"),  # used by the function of a module that is an argument
        ("own/law.py", "SCALE * x", "SCALE + x"),
    ],
)
def test_the_stamp_covers_other_packages_and_modules_as_arguments(folder, file, old, new):
    before = compiling.stamp(laws(folder).loop())
    (folder / file).write_text((folder / file).read_text().replace(old, new))
    assert compiling.stamp(laws(folder).loop()) != before


def test_defaults_and_the_options_of_compiling_are_in_the_stamp(folder, monkeypatch):
    main = laws(folder)
    stamps = [compiling.stamp(main.loop())]
    main.named.__defaults__ = (0.25,)
    stamps.append(compiling.stamp(main.loop()))
    monkeypatch.setattr(compiling, "__file__", str(folder / "own/law.py"))
    stamps.append(compiling.stamp(main.loop()))
    assert len(set(stamps)) == 3


def test_a_source_that_is_edited_after_its_import_does_not_spoil_what_is_kept(folder):
    function = fresh()
    text = SOURCES["law"].replace("SCALE * x", "SCALE + x")
    (folder / "own/law.py").write_text(text)
    assert function(1.5) == 3.0  # the code that was imported
    assert [called(), called()] == [(3.5, 0), (3.5, 1)]


def test_a_process_that_was_killed_between_index_and_code_leaves_no_wrong_code(folder):
    called()
    (code,) = folder.glob("kept/*/*.nbc")
    old = code.read_bytes()
    (folder / "own/scale.py").write_text("SCALE = 4.0\n")
    called()
    code.write_bytes(old)  # the index is new
    assert [called(), called()] == [(6.0, 0), (6.0, 1)]


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
@pytest.mark.parametrize("content", [b"", b"nonsense", None])
def test_a_damaged_file_is_replaced(folder, ending, content):
    called()
    (damaged,) = folder.glob(f"kept/*/*.{ending}")
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[: len(whole) // 2] if content is None else content)
    assert [called(), called()] == [(3.0, 0), (3.0, 1)]


def test_where_nothing_can_be_kept_functions_are_compiled_all_the_same(folder):
    function = fresh()
    place = Path(function.stats.cache_path)
    shutil.rmtree(place)
    place.touch()  # a file where the folder was
    assert function(1.5) == 3.0
    scope: dict[str, Any] = {"compiling": compiling, "__name__": "nowhere"}
    exec("@compiling.kept\ndef triple(x):\n    return 3 * x\n", scope)  # a function of no file
    assert scope["triple"](1.5) == 4.5


def test_processes_that_start_together_are_all_right(folder):
    command = [PYTHON, "-B", "-c", "from own.main import apply; print(apply(1.5))"]
    together = [
        subprocess.Popen(command, env=environment_of(folder), stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    assert [process.communicate(timeout=120)[0] for process in together] == ["3.0\n"] * 2
    assert called() == (3.0, 1)


class Elapsed:
    """A timer whose time is over as soon as it starts."""

    daemon = False

    def __init__(self, interval: float, function: Callable[[], None]) -> None:
        assert interval == compiling.PATIENCE
        self.start = function

    def cancel(self) -> None:
        """Do nothing: it is too late."""


def test_a_long_wait_is_announced_once_and_a_longer_one_again(folder, monkeypatch, caplog):
    # Neither other threads' turns nor loggers that libraries have changed decide what is seen.
    logger = logging.Logger("own")
    logger.addHandler(caplog.handler)
    monkeypatch.setattr(compiling, "_LOGGER", logger)
    monkeypatch.setattr(compiling.threading, "Timer", Elapsed)
    monkeypatch.setattr(compiling._Cache, "_announced", None)
    called()
    (folder / "own/scale.py").write_text("SCALE = 4.0\n")
    assert [called(), called()] == [(6.0, 0), (6.0, 1)]
    (message,) = caplog.messages
    assert message.startswith("compiling own.main.apply")
    assert str(folder / "kept") in message
    later = time.monotonic() + compiling._PAUSE
    monkeypatch.setattr(compiling.time, "monotonic", lambda: later)
    (folder / "own/scale.py").write_text("SCALE = 5.0\n")
    called()
    assert caplog.messages[1:] == ["still compiling: now own.main.apply"]


STAMPS = """
import importlib, pkgutil, sys
import tpm_gym
from tpm_gym.compiling import stamp

for room in sys.argv[1:]:
    package = importlib.import_module(f"tpm_gym.{room}")
    for module in pkgutil.walk_packages(package.__path__, f"tpm_gym.{room}."):
        importlib.import_module(module.name)
for name, module in sorted(sys.modules.items()):
    if name.startswith(("tpm_gym.mechanism", "tpm_gym.simulation.compiled")):
        loops = vars(getattr(module, "LOOPS", object)).values()
        for function in [*vars(module).values(), *loops]:
            if getattr(function, "py_func", None):
                print(name, function.__name__, stamp(function.py_func))
"""


def test_another_process_finds_what_is_kept():
    few, more = (
        printed_by(PYTHON, "-c", STAMPS, *rooms).splitlines()
        for rooms in (["mechanism", "kinematics"], ["tasks", "analysis", "mechanism", "envs"])
    )
    assert len(few) >= 16
    assert set(few) <= set(more)
