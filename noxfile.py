"""Tests with all supported versions of Python and of the dependencies.

``nox`` runs all sessions, ``nox -s newest-3.12`` one of them, and
``nox -s newest-3.12 -- tests/kinematics`` a part of its tests. Set ``UV_TORCH_BACKEND=cpu`` to
install a CPU build of PyTorch: pip's default on Linux includes CUDA.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import nox

nox.needs_version = ">=2024.4"
nox.options.default_venv_backend = "uv"
nox.options.error_on_missing_interpreters = False

PYTHONS = ["3.10", "3.11", "3.12", "3.13", "3.14"]


@nox.session(python=PYTHONS)
def newest(session: nox.Session) -> None:
    """Run the fast tests with the newest versions that pyproject.toml admits."""
    _test(session, "--upgrade")


@nox.session(python=PYTHONS[0])
def lowest(session: nox.Session) -> None:
    """Run the fast tests with the lowest versions that pyproject.toml admits."""
    old = ("-W", "default::DeprecationWarning")  # what old packages use of newer ones
    _test(session, "--resolution", "lowest-direct", options=old)


@nox.session(python="3.11")
def pinned(session: nox.Session) -> None:
    """Install what constraints.txt pins, and check that it pins everything."""
    extras = ".[train,test,policy,bench,studies,docs,view]"
    session.install("-c", "constraints.txt", extras, "build")
    installed = str(session.run("uv", "pip", "freeze", silent=True, external=True))
    if loose := _pinned(installed) - _pinned(Path("constraints.txt").read_text()):
        session.error(f"constraints.txt does not pin {', '.join(sorted(loose))}")


@nox.session(python="3.11")
def package(session: nox.Session) -> None:
    """Build wheel and sdist, and check their metadata and contents."""
    session.install("build", "twine", "check-wheel-contents")
    folder = session.create_tmp()
    session.run("python", "-m", "build", "--outdir", folder, ".")
    session.run("bash", "-c", f"twine check --strict {folder}/*", external=True)
    session.run("bash", "-c", f"check-wheel-contents {folder}/*.whl", external=True)


def _test(session: nox.Session, *versions: str, options: Sequence[str] = ()) -> None:
    # uv keeps the wheel of a folder until its pyproject.toml changes.
    session.install("--reinstall-package", "tpm-gym", *versions, ".[test]")
    session.run("uv", "pip", "freeze", external=True)
    session.run("python", "tests/support/compile_all.py")
    session.run("pytest", "-q", "-n", "logical", "--maxprocesses", "8", *options, *session.posargs)


def _pinned(text: str) -> set[str]:
    return {line.split("==")[0].lower() for line in text.splitlines() if "==" in line}
