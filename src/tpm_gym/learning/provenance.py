"""Provenance of a result (versions, commit, computer, command); writing files in one step."""

import json
import os
import platform
import shlex
import subprocess
import sys
import tempfile
import uuid
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from tpm_gym.errors import MissingPackageError
from tpm_gym.learning.errors import ConfigError

_PACKAGES: Final = (
    *("numpy", "numba", "torch", "gymnasium", "pybullet"),
    *("stable-baselines3", "sb3-contrib", "tpm_gym"),
)


def origin() -> dict[str, Any]:
    """Return versions, commit, computer and command as plain data."""
    return {
        "versions": versions(),
        "git_commit": git_commit(),
        "machine": machine(),
        "command": command_line(),
    }


def versions() -> dict[str, str | None]:
    """Return the versions of Python, of tpm_gym and of the main packages that tpm_gym uses.

    The version of a package that is not installed is None.
    """
    return {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES}


def version(package: str) -> str | None:
    """Return the version of an installed package; None if it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def git_commit() -> str | None:
    """Return the commit of the checkout that holds this file, or None.

    ``+modified`` is appended if tracked files differ from the commit.
    """
    here = Path(__file__)
    git = ["git", "-C", str(here.parent)]
    words = ["describe", "--always", "--abbrev=40", "--match=", "--dirty=+modified"]
    try:
        # An installed package may lie in a checkout of the user's, which does not track its files.
        tracked = [*git, "ls-files", "--error-unmatch", here.name]
        subprocess.run(tracked, capture_output=True, check=True)
        found = subprocess.run([*git, *words], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return found.stdout.strip()


def machine() -> dict[str, Any]:
    """Return the properties of the computer that decide its speed, and none that identify it."""
    processor = platform.processor()
    with suppress(OSError, IndexError):  # on most Linux systems the above is empty
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
        processor = text.split("model name", 1)[1].splitlines()[0].lstrip("\t: ")
    return {
        "system": platform.system(),
        "architecture": platform.machine(),
        "processor": processor,
        "cpu_count": os.cpu_count(),
    }


def command_line(arguments: Sequence[str] | None = None) -> str:
    """Return a command that repeats this process; see :func:`_portable` for the paths in it."""
    program, *words = sys.argv if arguments is None else arguments
    # ``python -m tpm_gym.learning`` is the same command.
    ours = Path(program).name == "tpm-gym" or Path(program) == Path(__file__).parent / "__main__.py"
    first = ["tpm-gym"] if ours else ["python", _portable(program)]
    return shlex.join([*first, *map(_portable, words)])


def _portable(word: str) -> str:
    """Return a word of a command, in which an absolute path is shortened.

    An absolute path inside the working directory becomes relative to this directory. Of another
    absolute path, only the last part is kept.
    """
    option, equals, value = word.rpartition("=")
    path = Path(value)
    if not path.is_absolute():
        return word
    inside = path.is_relative_to(Path.cwd())
    return f"{option}{equals}{path.relative_to(Path.cwd()) if inside else path.name}"


def require_packages(extras: Mapping[str, str]) -> None:
    """Raise MissingPackageError if a package is missing.

    ``extras`` names, for each required package, the extra of tpm_gym that installs it.
    """
    for package, extra in extras.items():
        if find_spec(package) is None:
            raise MissingPackageError(package, extra)


def require_writable(option: str, path: Path) -> None:
    """Make the folder of a file that will be written later; check that the file can be written."""
    problem = None
    try:
        if path.is_dir():
            problem = "is a folder"
        elif path.exists() and not path.is_file():  # renaming would replace it
            problem = "is a device or a pipe"
        else:
            folder = _target(path).parent
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
    except OSError as error:
        problem = f"cannot be written: {error.strerror}"
    if problem:
        raise ConfigError(f"{option} {path}: {problem}; choose another name")


def _target(path: Path) -> Path:
    """Follow links; unlike ``Path.resolve``, accept links in a circle."""
    return Path(os.path.realpath(path))


def read_json(path: Path) -> Any:
    """Read a JSON file; raise a ValueError if it is damaged."""
    try:
        return json.loads(path.read_bytes())
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write strictly valid JSON with :func:`write_whole`."""
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    write_whole(path, lambda part: part.write_text(text, encoding="utf-8"))


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file under a temporary name and rename it, so that no reader sees an incomplete file.

    Missing parent folders are made. If ``path`` is a link, the link stays, and its target is
    replaced. ``write`` is called with the temporary path, which has the same suffix.
    """
    target = _target(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f".{uuid.uuid4().hex}{path.suffix}")
    try:
        write(part)
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)
