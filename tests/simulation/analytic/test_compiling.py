"""What is compiled and kept on disk is what the sources say today."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tpm_gym.simulation.analytic.compiling import SOURCES, source_files
from tpm_gym.simulation.analytic.contact import collision, grasp, solver, stepping, vectors

TEXT = """
import sys
from tpm_gym.simulation.analytic.compiling import kept

@kept
def double(number: float, sources: str = sys.argv[1]) -> float:
    return 2 * number

assert double(1.5) == 3.0
print(sum(double.stats.cache_hits.values()), sum(double.stats.cache_misses.values()))
"""


def run(script: Sequence[str | Path], folder: Path, sources: str) -> str:
    """Hits and misses of what is kept on disk."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "kept")}
    command = [sys.executable, *script, sources]
    return subprocess.run(
        command, env=environment, check=True, capture_output=True, text=True
    ).stdout.strip()


def test_a_kept_function_is_compiled_again_when_any_source_has_changed(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(TEXT)
    assert run([script], tmp_path, "before") == "0 1"
    assert run([script], tmp_path, "before") == "1 0"
    assert run([script], tmp_path, "after") == "0 1"


def test_all_that_contact_is_compiled_from_is_among_the_sources() -> None:
    parts = [collision, grasp, solver, stepping, vectors]
    compiled = [f for part in parts for f in vars(part).values() if hasattr(f, "py_func")]
    called = {name for f in compiled for name in f.py_func.__code__.co_names}
    used = [value for part in parts for name, value in vars(part).items() if name in called]
    origins = {inspect.getfile(f) for f in used if inspect.isfunction(f) or inspect.isclass(f)}
    origins |= {f.py_func.__code__.co_filename for f in compiled}
    assert any(origin.endswith("vacuum.py") for origin in origins)
    assert origins <= {str(file) for file in source_files()}
    assert stepping.advance.py_func.__defaults__ == (SOURCES,)


def test_where_nothing_can_be_kept_functions_are_compiled_all_the_same(tmp_path: Path) -> None:
    assert run(["-c", TEXT], tmp_path, "before") == "0 1"  # functions of no file
