"""Helpers of the benchmarks: description of the computer, memory, records, tables, quartiles."""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import os
import platform
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.learning import provenance

ROOT = Path(__file__).resolve().parents[1]

_PACKAGES = ("panda-gym", "gymnasium-robotics", "mujoco")
_WRITE = "--write"

# -- the computer ---------------------------------------------------------------------------------


def describe(arguments: Sequence[str]) -> dict[str, Any]:
    """Describe the conditions of a measurement, without names of computers or folders.

    Args:
        arguments: The script and its arguments. ``--write`` is left out, so that a reader who
            repeats the command replaces no page.
    """
    loads = os.getloadavg() if hasattr(os, "getloadavg") else None
    return {
        "command": provenance.command_line([word for word in arguments if word != _WRITE]),
        "commit": provenance.git_commit(),
        "versions": provenance.versions() | {name: provenance.version(name) for name in _PACKAGES},
        "machine": provenance.machine(),
        "load_before": None if loads is None else round(loads[0], 2),
    }


def processor_line(description: dict[str, Any]) -> str:
    """Return processor, cores, Python, engine and load in one line, for tables and figures."""
    machine, versions = description["machine"], description["versions"]
    load = description["load_before"]
    busy = "" if load is None else f", load {load} at the start"
    return (
        f"{machine['processor'] or machine['architecture']}, {machine['cpu_count']} cores, "
        f"Python {versions['python']}, pybullet {versions['pybullet']}{busy}"
    )


def made_by(description: dict[str, Any]) -> str:
    """Return command and version in a few words, for pages."""
    return f"`{description['command']}`, tpm_gym {description['versions']['tpm_gym']}"


def memory() -> tuple[float, str]:
    """Return the memory of this process, MB (1e6 bytes), and its kind.

    Linux has the resident memory. Elsewhere the standard library has its peak only, which grows
    with the resident memory but never falls.

    Raises:
        SystemExit: The standard library of this system has neither.
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
    """Collect garbage, and let the C library return free memory to the system (glibc only).

    Otherwise a closed renderer leaves free memory in the heap, and the resident memory jumps by ten
    megabytes without a change of the memory in use.
    """
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)


def open_files() -> int | None:
    """Return the number of open file descriptors; None if the system does not report it."""
    try:
        return len(os.listdir("/proc/self/fd"))
    except OSError:
        return None


# -- records and pages ----------------------------------------------------------------------------


def make_parser(about: str, quick: str = "") -> argparse.ArgumentParser:
    """Return a parser with ``--write``, without which a benchmark only prints its results.

    With ``quick``, a help text, it has ``--quick`` too, which excludes ``--write``.
    """
    parser = argparse.ArgumentParser(description=about)
    group = parser.add_mutually_exclusive_group()
    group.add_argument(_WRITE, action="store_true", help="replace the record and fill its page")
    if quick:
        group.add_argument("--quick", action="store_true", help=f"{quick}; writes no files")
    return parser


def publish(
    record: dict[str, Any],
    file: Path,
    page: Path,
    name: str,
    lines: Callable[[dict[str, Any]], Iterable[str]],
    *,
    write: bool,
) -> None:
    """Print the lines of a record; with ``write``, replace the record's file and fill its page."""
    print(*lines(record), sep="\n")
    if write:
        provenance.write_json(file, record)
        fill(page, name, lines(read_record(file)))


def read_record(path: Path) -> dict[str, Any]:
    """Return a record; an empty one if there is no file."""
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Yield the lines of a table in Markdown."""
    yield "| " + " | ".join(head) + " |"
    yield "|---" * len(head) + "|"
    for row in rows:
        yield "| " + " | ".join(row) + " |"


def fill(page: Path, name: str, lines: Iterable[str]) -> None:
    """Replace the lines of a page between ``<!-- name: begin -->`` and ``<!-- name: end -->``."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    before, rest = page.read_text(encoding="utf-8").split(begin)
    _, after = rest.split(end)
    page.write_text(before + "\n".join([begin, *lines, end]) + after, encoding="utf-8")
    print("wrote", page.relative_to(ROOT))


def quartiles(values: ArrayLike) -> tuple[float, float, float]:
    """Return the lower quartile, the median and the upper quartile."""
    low, middle, high = np.percentile(np.asarray(values, dtype=np.float64), [25, 50, 75])
    return float(low), float(middle), float(high)


def spread(values: Sequence[float], form: str) -> str:
    """Format lower quartile, median and upper quartile as "median [lower, upper]"."""
    low, middle, high = (form.format(value) for value in values)
    return f"{middle} [{low}, {high}]"
