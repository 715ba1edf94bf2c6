"""Execution of studies by Ray: on this machine, or on the nodes of a cluster."""

import os
import secrets
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import Any, Final

from tpm_gym.errors import MissingPackageError
from tpm_gym.learning.errors import ConfigError, LearningError, RunError
from tpm_gym.learning.provenance import require_writable
from tpm_gym.learning.run_folder import claimed
from tpm_gym.learning.signals import SignalListener

from .plan import Bisection, Run, Study, plan_runs

_RETRIES: Final = 20  # of a run whose process or node died: the run itself may kill its process
_STORE: Final = 80 << 20  # bytes of Ray's object store, about the least that Ray accepts
_ANSWER: Final = 5.0  # s that a cluster has to answer
_POLL: Final = 1.0  # s between looks for a signal
_GRACE: Final = 30.0  # s for the end of a training whose node has just died
_STOPPED: Final = (128 + signal.SIGINT, 128 + signal.SIGTERM)

# A process of its own survives a killed driver. The end of its standard input is the end of the
# driver. Dying processes of Ray may still write, so that the first deletion can fail.
_CLEANER: Final = """
import os, shutil, sys, time
sys.stdin.read()
for _ in range(600):
    shutil.rmtree(sys.argv[1], ignore_errors=True)
    if not os.path.exists(sys.argv[1]):
        break
    time.sleep(0.1)
"""


def study(config: Study) -> None:
    """Run a study, or print the commands that are left.

    Raises:
        ConfigError: An option is not valid.
        LearningError: Some runs failed, or were stopped.
        MissingPackageError: Ray is not installed.
    """
    runs = plan_runs(config)
    if config.dry_run:
        left = [command for run in runs for command in run.left()]
        print(*map(shlex.join, left), sep="\n")
        return
    print(f"{len(runs)} runs; their output goes to {config.folder}/*.log")
    print("starting Ray, which takes some seconds ...", flush=True)
    if failures := run_all(runs, config):
        raise LearningError(f"{failures} runs failed or were stopped; start again to continue")


def run_all(runs: Sequence[Run | Bisection], config: Study) -> int:
    """Execute all that is left of some runs; return how many failed or were stopped.

    Raises:
        ConfigError: No cluster answers at the address, or the folder is not writable.
        MissingPackageError: Ray is not installed.
    """
    succeeded = 0
    require_writable("--folder", config.folder / "log")
    with (
        _connected(config.address, config.jobs),
        tempfile.NamedTemporaryFile(prefix=".", dir=config.folder) as seen,
    ):
        for run, problem in _each(runs, Path.cwd(), Path(seen.name)):
            print(f"{run.folder}: {problem or 'done'}", flush=True)
            succeeded += problem is None
    return len(runs) - succeeded


# -- Ray ------------------------------------------------------------------------------------------


@contextmanager
def _connected(address: str | None, cpus: int) -> Iterator[None]:
    """Connect to a Ray cluster; without an address, start one of this machine for this context.

    The cluster of this machine listens on the loopback interface alone. Its folder is open to this
    user alone, and is deleted even if this process is killed.
    """
    if address is None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        # Other users of this machine reach the loopback interface too. Without a token in the
        # environment, Ray would write one to the home folder.
        os.environ.setdefault("RAY_AUTH_MODE", "token")
        os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
        # Ray takes the loopback address only where it supports no clusters. It reads this
        # variable when it is imported.
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    try:
        import ray
    except ModuleNotFoundError as error:
        raise MissingPackageError("ray", "studies") from error
    # Other nodes, and Ray's workers, may not be able to import this package.
    pickle_by_value: Any = ray.cloudpickle.register_pickle_by_value
    pickle_by_value(sys.modules[__package__])
    quiet: dict[str, Any] = {"configure_logging": False, "log_to_driver": False}
    if address is not None:
        _require_answer(address)
        ray.init(address, **quiet)
        try:
            yield
        finally:
            ray.shutdown()
        return
    with _temporary_folder() as folder:
        ray.init(
            "local",
            num_cpus=cpus,
            object_store_memory=_STORE,
            include_dashboard=False,
            _temp_dir=str(folder / "ray"),  # Ray opens this folder to everyone
            **quiet,
        )
        try:
            yield
        finally:
            ray.shutdown()


@contextmanager
def _temporary_folder() -> Iterator[Path]:
    """Make a folder that only this user can open; another process deletes it after this one."""
    # Paths of sockets have at most about 100 characters. The default folder of macOS is too long.
    folder = tempfile.mkdtemp(prefix="tpm-", dir=None if sys.platform == "win32" else "/tmp")
    cleaner = subprocess.Popen(
        [sys.executable, "-c", _CLEANER, folder], stdin=subprocess.PIPE, start_new_session=True
    )
    try:
        yield Path(folder)
    finally:
        cleaner.communicate()


def _require_answer(address: str) -> None:
    """Refuse an address without an answer; Ray would try for minutes."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=_ANSWER).close()
    except (OSError, ValueError) as error:
        valid = "must be HOST:PORT, as ray start --head prints it"
        raise ConfigError(f"--address {address}: no cluster answers ({error}); {valid}") from error


def _each(
    runs: Sequence[Run | Bisection], here: Path, seen: Path
) -> Iterator[tuple[Run | Bisection, str | None]]:
    """Execute each run in a process of its own on one CPU; yield runs and problems as they end.

    A run whose process or node dies is started again elsewhere. Ctrl-C or SIGTERM interrupts the
    running ones, as Ctrl-C would, and drops the waiting ones. A second signal ends this process.

    Yields:
        A run, and None or its problem. Dropped runs are left out.
    """
    import ray

    alone: Any = ray.remote(num_cpus=1, max_calls=1, max_retries=_RETRIES)
    task = alone(execute_there)
    found = {task.remote(run, here, seen): run for run in runs}
    waiting, interrupted, listener = list(found), False, SignalListener()
    with listener.listening():
        while waiting:
            done, waiting = ray.wait(waiting, timeout=_POLL)
            if listener.received and not interrupted:
                interrupted = True
                for reference in waiting:
                    ray.cancel(reference)
            for reference in done:
                try:
                    problem = ray.get(reference)
                except ray.exceptions.TaskCancelledError:
                    continue
                except ray.exceptions.RayError as error:
                    problem = f"failed: {error}"
                yield found[reference], problem


# -- one run --------------------------------------------------------------------------------------


def execute_there(run: Run | Bisection, here: Path, seen: Path) -> str | None:
    """Execute a run on a node of a cluster.

    Args:
        here: Working folder of the study.
        seen: File in --folder. Both must exist on the node.

    Returns:
        None, or the problem in a line.
    """
    try:
        os.chdir(here)
        is_shared = seen.is_file()
    except OSError:
        is_shared = False
    if is_shared:
        return execute(run)
    return (
        f"failed: {socket.gethostname()} does not see {here} and {seen.parent} as they are here; "
        "choose a working folder and a --folder on a disk that all nodes share"
    )


def execute(run: Run | Bisection) -> str | None:
    """Run the commands that are left in this process, with their output in a log beside the run.

    Returns:
        None, or the problem in a line.
    """
    log = run.folder.with_suffix(".log")
    log.parent.mkdir(parents=True, exist_ok=True)
    _outlast(run.folder)
    while left := run.left():
        status = _run_command(left[0], log)
        if status != 0:
            how = "stopped" if status in _STOPPED else f"failed with status {status}, see {log}"
            return f"{how}: {shlex.join(left[0])}"
    return None


def _outlast(run: Path) -> None:
    """Wait while another process trains in a folder; one whose node has died ends in seconds."""
    latest = time.monotonic() + _GRACE
    while run.is_dir() and time.monotonic() < latest:
        with suppress(RunError), claimed(run):
            return
        time.sleep(1.0)


def _run_command(command: list[str], log: Path) -> int:
    """Run a command in this process, which dies with its node, and return its status."""
    from tpm_gym.learning.command_line import main

    before, sys.argv = sys.argv, command  # training records it as its command
    with log.open("a", encoding="utf-8") as file, redirect_stdout(file), redirect_stderr(file):
        print(f"$ {shlex.join(command)}", flush=True)
        try:
            main(command[1:])
        except KeyboardInterrupt:  # before the command could handle the signal
            return 128 + signal.SIGINT
        except SystemExit as left:
            if isinstance(left.code, str):
                print(left.code)
            return left.code if isinstance(left.code, int) else int(left.code is not None)
        except Exception:
            traceback.print_exc()
            return 1
        finally:
            sys.argv = before
    return 0
