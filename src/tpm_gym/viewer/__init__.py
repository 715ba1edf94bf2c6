"""Viewer in the browser: postures, modes, singular surfaces, and episodes of any task.

The viewer needs the extra ``view``. Importing this package does not import viser.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tpm_gym.mechanism import Machine
    from tpm_gym.viewer.viewer import Viewer

__all__ = ["ViewConfig", "open_viewer", "run"]


@dataclass(frozen=True)
class ViewConfig:
    """Show the robot in the browser: drag it, see its singularities, and play episodes."""

    machine: str = "paper"
    """Machine that is shown first: paper, wide or delta. For a machine of your own, use
    tpm_gym.viewer.open_viewer in Python."""

    host: str = "127.0.0.1"
    """Address to listen on. With the default, only this computer can open the page."""

    port: int = 8080
    """Port to listen on; if it is taken, the next free one."""

    export: Path | None = None
    """Folder for index.html. The page shows one episode of pick-and-place, and needs no server. The
    program writes the page and exits."""


def open_viewer(
    machine: str | Machine = "paper", *, host: str = "127.0.0.1", port: int = 8080
) -> Viewer:
    """Start a viewer in the background; ``.address`` is its page and ``.close()`` ends it.

    Args:
        machine: Name of a machine, or a machine.
        host: Address to listen on.
        port: Port to listen on; if it is taken, the next free one.

    Raises:
        MissingPackageError: If viser is not installed.
        ConfigurationError: If no machine has this name, or an option is not possible.
    """
    from tpm_gym.viewer.viewer import Viewer

    return Viewer(machine, host, port)


def run(config: ViewConfig) -> None:
    """Run ``tpm-gym view``: serve until Ctrl-C, or export a page.

    Raises:
        MissingPackageError: If viser is not installed.
        ConfigurationError: If no machine has this name, or an option is not possible.
    """
    if config.export is not None:
        print("playing an episode for the page ...", file=sys.stderr, flush=True)
        from tpm_gym.viewer.export import export

        print(export(config.export, config.machine))
        return
    viewer = open_viewer(config.machine, host=config.host, port=config.port)
    print(f"tpm_gym is at {viewer.address} (Ctrl-C ends it)", flush=True)
    try:
        viewer.server.sleep_forever()
    except KeyboardInterrupt:
        viewer.close()
