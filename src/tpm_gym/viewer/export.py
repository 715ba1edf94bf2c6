"""A page that shows one episode without a server."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Final

from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism import Machine
from tpm_gym.viewer import server
from tpm_gym.viewer.kinds import Kind, find_kind
from tpm_gym.viewer.player import Player
from tpm_gym.viewer.scene import RobotScene, set_camera

if TYPE_CHECKING:
    from viser import ViserServer

_ENV: Final = "TPMPickAndPlace-v0"
_SEED: Final = 2
_HOLD: Final = 0.8
"""Time for which the first and the last posture stay, s."""
_OURS: Final = "__VISER_EMBED_DATA__="
"""Text in every page that viser wrote; a page without this text is not replaced."""


def export(folder: str | Path, machine: str | Machine) -> Path:
    """Write ``index.html`` and return its path; the page repeats one episode of pick-and-place.

    The expert performs the task in the analytic engine. The page holds everything it needs. The
    folder is made if it is missing. An earlier page is replaced.

    Raises:
        ConfigurationError: If no machine has this name, the machine cannot do the task, the folder
            cannot be written, or it has an ``index.html`` of another program.
    """
    kind = find_kind(machine)
    player = Player(_ENV, "analytic", kind.machine, "expert")
    try:
        page = _page(Path(folder))
        running = server.start("127.0.0.1", 0)
        try:
            page.write_text(_recording(running, kind, player), "utf-8", newline="\n")
        finally:
            server.stop(running)
    finally:
        player.close()
    return page


def _recording(running: ViserServer, kind: Kind, player: Player) -> str:
    """Return the page of an episode."""
    set_camera(running, kind.machine)
    robot = RobotScene(running.scene, kind.machine)
    robot.set_objects(player.task.scene, player.task.tolerance)

    def draw() -> None:
        robot.draw(kind.of_state(player.state).places)
        robot.draw_objects(player.state, player.markers)

    player.reset(_SEED)
    draw()
    recording = running.get_scene_serializer()
    recording.insert_sleep(_HOLD)
    while not player.ended:
        player.step()
        draw()
        recording.insert_sleep(player.task.control_period)
    recording.insert_sleep(_HOLD)
    return recording.as_html()


def _page(folder: Path) -> Path:
    """Make the folder, and return the path of its page; replace only pages of this package."""
    page = folder / "index.html"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        theirs = page.exists() and _OURS not in page.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise ConfigurationError("export", str(folder), f"a folder ({error.strerror})") from error
    if theirs:
        valid = "another folder: this index.html is of another program, and would be replaced"
        raise ConfigurationError("export", str(page), valid)
    if not os.access(page if page.exists() else folder, os.W_OK):
        raise ConfigurationError("export", str(folder), "a folder that you may write to")
    return page
