"""Work shared out by Ray among processes: on this machine, or on the nodes of a cluster."""

import os
import secrets
import socket
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final, TypeVar

from tpm_gym.errors import MissingPackageError
from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.signals import SignalListener

_DEATHS: Final = 20  # of processes that one piece of work outlives; it may be what kills them
_STORE: Final = 80 << 20  # bytes for objects in transit, about the least that Ray takes
_ANSWER: Final = 5.0  # s that a cluster has to answer
_GLANCE: Final = 1.0  # s between looks for a signal

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


@contextmanager
def connected(address: str | None, cpus: int) -> Iterator[None]:
    """Connect to a Ray cluster; without an address, to one of this machine for this context alone.

    Args:
        cpus: Of the cluster of this machine: as many pieces of work are done at once.

    Raises:
        MissingPackageError: Ray is not installed.
        ConfigError: There is no cluster at the address.
    """
    if address is None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        # Whoever can reach it could run anything there; Ray's own token would stay in the home.
        os.environ.setdefault("RAY_AUTH_MODE", "token")
        os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
    try:
        import ray
    except ModuleNotFoundError as error:
        raise MissingPackageError("ray", "cluster") from error
    quiet: dict[str, Any] = {"configure_logging": False, "log_to_driver": False}
    # Sockets lie in it, whose paths may have some hundred characters; macOS's own would be longer.
    temporary = None if sys.platform == "win32" else "/tmp"
    with tempfile.TemporaryDirectory(prefix="tpm-", dir=temporary) as folder:
        if address is None:
            ray.init(
                "local",
                num_cpus=cpus,
                object_store_memory=_STORE,
                include_dashboard=False,
                _temp_dir=folder,
                **quiet,
            )
        else:
            _require_answer(address)
            ray.init(address, **quiet)
        try:
            yield
        finally:
            ray.shutdown()


def _require_answer(address: str) -> None:
    """Refuse an address at which nobody answers; Ray would try for minutes."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=_ANSWER).close()
    except (OSError, ValueError) as error:
        valid = "must be HOST:PORT, as ray start --head prints it"
        raise ConfigError(f"--address {address}: no cluster answers ({error}); {valid}") from error


def each(
    work: Callable[..., Outcome], items: Sequence[Item], *given: Any
) -> Iterator[tuple[Item, Outcome | str]]:
    """Do a piece of work for each item, in a process of its own on one CPU; yield what comes of it.

    Results come in the order of their ends. When a process or its node dies, its item is begun
    again elsewhere. Ctrl-C, or SIGTERM, interrupts what is at work, as Ctrl-C would there, and
    drops what waits; a second one leaves at once.

    Args:
        work: Called with an item and what is ``given``; a function of a module.

    Yields:
        An item, and what the work returned, or in words the error that ended it. Nothing of one
        that was dropped.
    """
    import ray

    alone: Any = ray.remote(num_cpus=1, max_calls=1, max_retries=_DEATHS)
    task = alone(work)
    found = {task.remote(item, *given): item for item in items}
    waiting, interrupted, listener = list(found), False, SignalListener()
    with listener.listening():
        while waiting:
            done, waiting = ray.wait(waiting, timeout=_GLANCE)
            if listener.received and not interrupted:
                interrupted = True
                for reference in waiting:
                    ray.cancel(reference)
            for reference in done:
                with suppress(ray.exceptions.TaskCancelledError):
                    yield found[reference], _outcome(reference)


def _outcome(reference: Any) -> Any:
    """What came of a piece of work, an error in words."""
    import ray

    try:
        return ray.get(reference)
    except ray.exceptions.TaskCancelledError:
        raise
    except ray.exceptions.RayError as error:
        return f"failed: {error}"
