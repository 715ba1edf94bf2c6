"""Viewer: server of a page that shows the robot and, beside the robot, a panel with controls."""

from __future__ import annotations

import math
import traceback
from html import escape
from typing import Any

from tpm_gym.errors import TPMError
from tpm_gym.mechanism.machine import Machine, machine_names, registered_name
from tpm_gym.viewer import server
from tpm_gym.viewer.explore import Explore, units
from tpm_gym.viewer.kinds import Kind, Posture, find_kind
from tpm_gym.viewer.layers import BEST, LAYERS, MAP, Layers
from tpm_gym.viewer.play import Play
from tpm_gym.viewer.player import Player
from tpm_gym.viewer.scene import RobotScene, set_camera
from tpm_gym.viewer.worker import Worker


class Viewer:
    """Page on which a user drags a robot and plays episodes.

    :func:`tpm_gym.viewer.open_viewer` explains the arguments.

    Attributes:
        explore: Controls of the posture.
        play: Controls of episodes.
        worker: Thread that runs all changes.
    """

    def __init__(self, machine: str | Machine, host: str, port: int) -> None:
        """Start the server, and show the machine at its home."""
        first, self._kinds = _named_kinds(machine)
        self.server = server.start(host, port)
        self.worker = Worker(self._report)
        gui = self.server.gui
        gui.configure_theme(
            control_width="large",
            show_logo=False,
            show_share_button=False,
            brand_color=(9, 105, 218),
        )
        gui.main_panel.dock_right()
        self.machine = gui.add_dropdown("Machine", tuple(self._kinds), initial_value=first)
        self._numbers: Any = gui.add_html("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Explore"):
            self.explore = Explore(self.server, self.worker, self._show)
        with tabs.add_tab("Show"):
            self.shown = {
                name: gui.add_checkbox(label, name == "region", hint=hint)
                for name, (label, hint, _) in LAYERS.items()
            }
            gui.add_html(_scale())
        with tabs.add_tab("Play"):
            self.play = Play(self.server, self.worker, self._show_episode)
        for box in self.shown.values():
            box.on_update(lambda _: self.worker.put("layers", self._show_layers))
        self.machine.on_update(lambda _: self.worker.put("machine", self._set_machine))
        self.worker.put("machine", self._set_machine)
        self.worker.wait()

    @property
    def address(self) -> str:
        """Address of the page."""
        host = self.server.get_host()
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}"

    def close(self) -> None:
        """Stop the server and the worker."""
        self.worker.put("end", self.play.discard)
        self.worker.wait(5.0)
        self.worker.close()
        server.stop(self.server)

    def _set_machine(self) -> None:
        kind = self.kind = self._kinds[self.machine.value]
        self.play.set_machine(kind.machine)
        set_camera(self.server, kind.machine)
        self.robot = RobotScene(self.server.scene, kind.machine)
        self.layers = Layers(self.server.scene, kind)
        self.explore.set_kind(kind)
        there = self.layers.around(self.explore.posture)
        for name, box in self.shown.items():
            box.visible = name in there

    # -- drawing ------------------------------------------------------------------------------

    def _show(self, posture: Posture) -> None:
        self.robot.draw(posture.places)
        self._numbers.content = numbers(posture)
        self.worker.put("layers", self._show_layers)

    def _show_layers(self) -> None:
        names = [name for name, box in self.shown.items() if box.value]
        self.layers.show(names, self.explore.posture)

    def _show_episode(self, player: Player) -> None:
        """Draw the robot at its encoders' joint positions, and the objects."""
        if not player.records:
            self.robot.set_objects(player.task.scene, player.task.tolerance)
        with self.server.atomic():
            self.robot.draw_objects(player.state, player.markers)
            self.explore.hide_gizmo(self.play.playing)
            self.explore.set(self.kind.of_state(player.state))

    def _report(self, error: Exception) -> None:
        """Show an error on all pages; print errors that are no TPMError."""
        self.play.pause()
        if not isinstance(error, TPMError):
            traceback.print_exception(error)
        self.play.tell(escape(str(error)))
        for client in self.server.get_clients().values():
            client.add_notification("That did not work", str(error), color="red")


def _named_kinds(machine: str | Machine) -> tuple[str, dict[str, Kind]]:
    """Return the name of ``machine``, and a dictionary of kinds by name.

    The dictionary has the kinds of ``machine`` and of all registered machines. Registered machines
    have their names in the registry, because several may have the same ``Machine.name``.
    """
    given = find_kind(machine)
    kinds = {name: find_kind(name) for name in machine_names()}
    if isinstance(machine, str):
        return machine, kinds
    if (name := registered_name(machine)) is not None:
        return name, kinds
    name = f"{machine.name} (own)" if machine.name in kinds else machine.name
    return name, {**kinds, name: given}


def numbers(posture: Posture) -> str:
    """Return the numbers of a posture as HTML."""
    x, y, z = 1000 * posture.position
    u, v, w = 1000 * posture.machine.mount.to_world(posture.position)
    scales, names = zip(*units(posture.machine), strict=True)
    stops = " / ".join(f"{value:.0f}" for value in scales * posture.stop_margins)
    rows = {
        "P, machine's frame": f"{x:.1f} / {y:.1f} / {z:.1f} mm",
        "P, world": f"{u:.1f} / {v:.1f} / {w:.1f} mm",
        "Conditioning": f"{posture.conditioning:.3f}",
        "Motors to their stops": f"{stops} {' / '.join(dict.fromkeys(names))}",
        "Platform tilted by": f"{math.degrees(posture.tilt):.1f} °",
        "Loops open by": f"{posture.gap:.1e} m",
    }
    cells = "".join(
        f'<tr><td style="color:#667">{name}</td><td style="text-align:right">{value}</td></tr>'
        for name, value in rows.items()
    )
    table = f'<table style="width:100%;font-size:0.85em">{cells}</table>'
    return f'<div style="padding:0 1em 0.5em">{table}</div>'


def _scale() -> str:
    """Return the colour map of the conditioning as HTML."""
    parts = ",".join(f"rgb({r:.0f},{g:.0f},{b:.0f})" for r, g, b in MAP)
    return (
        '<div style="padding:0 1em;font-size:0.8em">'
        f'<div style="height:0.7em;background:linear-gradient(to right,{parts})"></div>'
        f'<span>0</span><span style="float:right">conditioning {BEST}</span></div>'
    )
