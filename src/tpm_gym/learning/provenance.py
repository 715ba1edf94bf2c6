"""What a result needs to be repeated: versions, commit, machine, command; and how it is written."""

import json
import os
import platform
import shlex
import subprocess
import sys
import tempfile
import uuid
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, Final

from tpm_gym.learning.errors import ConfigError

_PACKAGES: Final = (
    "numpy",
    "numba",
    "torch",
    "gymnasium",
    "pybullet",
    "stable-baselines3",
    "sb3-contrib",
    "tpm_gym",
)


def origin() -> dict[str, Any]:
    """Return versions, commit, machine and command as plain data, by these names."""
    return {
        "versions": versions(),
        "git_commit": git_commit(),
        "machine": machine(),
        "command": command_line(),
    }


def versions() -> dict[str, str | None]:
    """Return the versions of Python, tpm_gym and the packages below it; None where absent."""
    return {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES}


def version(package: str) -> str | None:
    """Return the version of an installed package, None where it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def git_commit() -> str | None:
    """Return the commit of the checkout this file lies in, None outside one.

    ``+modified`` is appended where tracked files differ from the commit.
    """
    commit = _git("rev-parse", "HEAD")
    if commit is None:
        return None
    return f"{commit}+modified" if _git("status", "--porcelain", "--untracked-files=no") else commit


def _git(*arguments: str) -> str | None:
    """Return what a git command prints, None where it fails."""
    try:
        done = subprocess.run(
            ["git", "-C", str(Path(__file__).parent), *arguments],
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def machine() -> dict[str, Any]:
    """Return what the speed of a run depends on, and nothing that names the machine."""
    return {
        "system": platform.system(),
        "architecture": platform.machine(),
        "processor": _processor(),
        "cpu_count": os.cpu_count(),
    }


def _processor() -> str:
    try:
        # platform.processor() is empty or only the architecture on most Linux systems.
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def command_line(arguments: Sequence[str] | None = None) -> str:
    """Return a command that repeats this one, without folders outside the working directory."""
    program, *words = sys.argv if arguments is None else arguments
    # ``python -m tpm_gym.learning`` is the same command.
    ours = Path(program).name == "tpm-gym" or Path(program) == Path(__file__).with_name(
        "__main__.py"
    )
    first = ["tpm-gym"] if ours else ["python", _portable(program)]
    return shlex.join([*first, *map(_portable, words)])


def _portable(word: str) -> str:
    """Make an absolute path relative to the working directory, or keep only its last part."""
    option, equals, value = word.rpartition("=")
    path = Path(value)
    if not path.is_absolute():
        return word
    try:
        return f"{option}{equals}{path.relative_to(Path.cwd())}"
    except ValueError:
        return f"{option}{equals}{path.name}"


def require_writable(option: str, path: Path) -> None:
    """Make the folder of a file that is to be written at the end of long work.

    Raises:
        ConfigError: It cannot be made or written to, or there is a folder in the file's place.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            problem = "is a folder" if path.is_dir() else None
    except OSError as error:
        problem = f"cannot be written: {error.strerror}"
    if problem:
        raise ConfigError(f"{option} {path}: {problem}; choose another name")


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write strictly valid JSON as :func:`write_whole` does.

    Raises:
        ValueError: ``content`` holds NaN or an infinity, which JSON cannot express.
    """
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    write_whole(path, lambda part: part.write_text(text, encoding="utf-8"))


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file so that no reader ever sees half of it.

    Folders above it are made. ``write`` is given a path beside ``path`` that ends as it does.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{uuid.uuid4().hex}{path.suffix}")
    try:
        write(part)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
