"""Viser server at a given address and port, without console output."""

from __future__ import annotations

import errno
import io
import socket
from contextlib import redirect_stdout

from tpm_gym.arrays import is_whole
from tpm_gym.errors import ConfigurationError, MissingPackageError

try:
    from viser import ViserServer
except ModuleNotFoundError as error:
    raise MissingPackageError(error.name or "viser", "view") from error

_TRIES = 100
_TAKEN = errno.EADDRINUSE, errno.EACCES


def start(host: str, port: int) -> ViserServer:
    """Start a server at the port or the next free port; for port 0, at any free port.

    Raises:
        ConfigurationError: If the address is not this computer's, or the port is not possible.
    """
    if not is_whole(port, 0) or port > 65535:
        raise ConfigurationError("port", port, "a whole number from 0 to 65535")
    if not isinstance(host, str):
        raise ConfigurationError("host", host, "an address of this computer")
    free = _free_port(host, port)
    with redirect_stdout(io.StringIO()):
        return ViserServer(host=host, port=free, label="tpm_gym", verbose=False)


def stop(server: ViserServer) -> None:
    """Stop a server."""
    with redirect_stdout(io.StringIO()):
        server.stop()


def _free_port(host: str, port: int) -> int:
    """Return the first free port from ``port`` on.

    Viser has its own search, but waits without end if the search finds no free port.
    """
    for candidate in range(port, min(port + _TRIES, 65536)):
        if (found := _bound(host, candidate)) is not None:
            return found
    raise ConfigurationError("port", port, f"a port with a free one among the {_TRIES} after it")


def _bound(host: str, port: int) -> int | None:
    """Return ``port``, or any free port if ``port`` is 0; None if the port is taken."""
    try:
        family = socket.getaddrinfo(host, port)[0][0]
        with socket.create_server((host, port), family=family) as found:
            return int(found.getsockname()[1])
    except (OSError, UnicodeError) as error:
        if isinstance(error, OSError) and error.errno in _TAKEN:
            return None
        raise ConfigurationError("host", host, f"an address of this computer ({error})") from error
