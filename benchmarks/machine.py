"""What the benchmarks share: a description of the machine, memory, quartiles, the figures' style.

The scripts that train record versions and machine already, and the documentation's figures have
their style; both are taken from there.
"""

from __future__ import annotations

import ctypes
import gc
import os
import platform
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.learning import provenance

ROOT = Path(__file__).resolve().parents[1]
__all__ = [
    "describe",
    "fill",
    "give_back_free_memory",
    "memory",
    "open_files",
    "processor_line",
    "provenance",
    "quartiles",
]

_PACKAGES = ("panda-gym", "gymnasium-robotics", "mujoco")


def describe(arguments: Sequence[str]) -> dict[str, Any]:
    """What a speed depends on, and how to repeat it; no names of machines or folders.

    Args:
        arguments: The script and its arguments.
    """
    loads = os.getloadavg() if hasattr(os, "getloadavg") else None
    return {
        "command": provenance.command_line(arguments),
        "commit": provenance.git_commit(),
        "versions": provenance.versions() | {name: provenance.version(name) for name in _PACKAGES},
        "machine": provenance.machine(),
        "load_before": None if loads is None else round(loads[0], 2),
    }


def processor_line(description: dict[str, Any]) -> str:
    """One line for tables and figures: processor, cores, Python, engine, load at the start."""
    machine, versions = description["machine"], description["versions"]
    load = description["load_before"]
    busy = "" if load is None else f", load {load} at the start"
    return (
        f"{machine['processor'] or machine['architecture']}, {machine['cpu_count']} cores, "
        f"Python {versions['python']}, pybullet {versions['pybullet']}{busy}"
    )


def memory() -> tuple[float, str]:
    """Memory of this process in MB (1e6 bytes), and what it is.

    Linux tells what is resident now. Elsewhere the standard library knows only the most that ever
    was, which grows where the resident memory does, but never falls.

    Raises:
        SystemExit: On a system where the standard library knows neither.
    """
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6, "resident"
    except OSError:
        pass
    try:
        import resource
    except ImportError:
        sys.exit("the memory of a process is only known on Linux, macOS and BSD; run it there")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak * (1 if platform.system() == "Darwin" else 1024) / 1e6, "peak"


def give_back_free_memory() -> None:
    """Collect garbage, and let the C library return what it holds free (glibc only).

    Without, the resident memory jumps by whatever hole a closed renderer happens to leave in the
    heap, ten megabytes at a time, and says nothing about what is in use.
    """
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)


def open_files() -> int | None:
    """Number of this process's open file descriptors; None where the system does not tell."""
    try:
        return len(os.listdir("/proc/self/fd"))
    except OSError:
        return None


def fill(page: Path, name: str, lines: Iterable[str]) -> None:
    """Replace what stands in a page between ``<!-- name: begin -->`` and ``<!-- name: end -->``."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    before, rest = page.read_text(encoding="utf-8").split(begin)
    _, after = rest.split(end)
    page.write_text(before + "\n".join([begin, *lines, end]) + after, encoding="utf-8")


def quartiles(values: ArrayLike) -> tuple[float, float, float]:
    """Lower quartile, median, upper quartile."""
    low, middle, high = np.percentile(np.asarray(values, dtype=np.float64), [25, 50, 75])
    return float(low), float(middle), float(high)
