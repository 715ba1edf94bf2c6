"""Commands in processes of their own: run to the end, or signalled on the way."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

PYTHON = sys.executable
TPM_GYM = (PYTHON, "-m", "tpm_gym.learning")


def printed_by(*command: str | Path, **options: Any) -> str:
    """What a command prints that has to succeed."""
    done = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def error_of(*command: str | Path, **options: Any) -> str:
    """What a command says that has to end with status 1."""
    done = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    assert done.returncode == 1, done.stdout + done.stderr
    return done.stderr


def signalled(
    command: list[str | Path], ready: Callable[[], object], number: signal.Signals, **options: Any
) -> tuple[int, str]:
    """Signal a command and its children, as a terminal does, once ready; status and output."""
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        **options,
    )
    deadline = time.monotonic() + 300
    while not ready() and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.killpg(process.pid, number)
    output, _ = process.communicate(timeout=60)
    return process.returncode, output
