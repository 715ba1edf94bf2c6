"""Tab "Explore": point P, motors and modes choose the posture."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from typing import Any, Final

import numpy as np
from viser import GuiApi, TransformControlsHandle, ViserServer

from tpm_gym.errors import TPMError
from tpm_gym.kinematics import (
    ASSEMBLY_MODES,
    ROTATED_MODES,
    AssemblyMode,
    RotatedMode,
    WorkingMode,
)
from tpm_gym.mechanism import Delta
from tpm_gym.mechanism.delta import geometry as delta
from tpm_gym.mechanism.tpm import TPM
from tpm_gym.viewer.posture import OPERATIONS, Operation, Posture, at_joints, at_point
from tpm_gym.viewer.scene import ROBOT
from tpm_gym.viewer.worker import Worker

__all__ = ["Explore"]

_BENDS: Final = {1: "out", -1: "in"}
_LINK_7: Final = {"towards +x": 1, "towards -x": -1}


class Explore:
    """Controls of the posture, and the gizmo at point P.

    Dragging P keeps the working mode; turning a motor keeps the assembly mode. If the requested
    posture does not exist, the last posture stays and :attr:`problem` says why.

    Args:
        server: The viser server; the controls are added to its present container.
        worker: Thread that computes and draws postures.
        show: Called with each new posture.

    Attributes:
        posture: The posture that is shown.
        problem: Reason why the requested posture does not exist; empty if it exists.
    """

    def __init__(
        self, server: ViserServer, worker: Worker, show: Callable[[Posture], object]
    ) -> None:
        """Add the controls."""
        self._server, self._worker, self._show = server, worker, show
        self.posture: Posture
        self._out = np.ones(3, dtype=int)
        self.gizmo: TransformControlsHandle | None = None
        self._add_modes(server.gui)
        self._add_motors(server.gui)
        # Last in the panel, so that a message that appears moves no control.
        self._refusal: Any = server.gui.add_html("")

    def _add_modes(self, gui: GuiApi) -> None:
        bends = [
            f"{one} / {two} / {three}"
            for one in _BENDS.values()
            for two in _BENDS.values()
            for three in _BENDS.values()
        ]
        self.operation: Any = gui.add_dropdown(
            "Operation", OPERATIONS, hint="Link 3' only translates, or is turned about y"
        )
        self.bends: Any = gui.add_dropdown(
            "Elbows 1 / 2 / 3", bends, hint="Working mode: how the three arms are bent"
        )
        self.link_7: Any = gui.add_dropdown(
            "Link 7", tuple(_LINK_7), hint="Working mode: sign of cos(beta)"
        )
        self.assembly: Any = gui.add_dropdown(
            "Assembly",
            tuple(_label(mode) for mode in ASSEMBLY_MODES),
            hint="Assembly mode: signs of the planar factor and of sin(beta), which is that of y",
        )
        for handle, job in (
            (self.operation, self._point_again),
            (self.bends, self._point_again),
            (self.link_7, self._point_again),
            (self.assembly, self._joints_again),
        ):
            self._on(handle, "modes", job)

    def _add_motors(self, gui: GuiApi) -> None:
        self.motors: list[Any] = [
            gui.add_slider(f"Motor {k + 1}, °", low, low + 360.0, 0.1, low + 180.0)
            for k, low in enumerate((-180.0, 0.0, -180.0))
        ]
        for motor in self.motors:
            self._on(motor, "motors", self._joints_again)
        home = gui.add_button("Back to the machine's home")
        home.on_click(lambda _: self._worker.put("home", self.go_home))

    def _on(self, handle: Any, name: str, job: Callable[[], object]) -> None:
        """Run a job when a user changes a value; values that a job itself sets do not count."""

        def changed(event: object) -> None:
            if not self._worker.here:
                self._worker.put(name, job)

        handle.on_update(changed)

    # -- machine ------------------------------------------------------------------------------

    def set_machine(self, machine: TPM | Delta) -> None:
        """Show another machine, at its home and in its modes."""
        self._machine = machine
        # Motors whose arms point level outwards, in the machine's own modes: elbows are out.
        tpm = isinstance(machine, TPM)
        self._out = np.array(
            machine.working_mode.signs[1:] if isinstance(machine, TPM) else delta.ELBOWS_OUT
        )
        self.operation.options = OPERATIONS if tpm else OPERATIONS[:1]
        self.link_7.visible = tpm
        self.gizmo = self._server.scene.add_transform_controls(
            f"{ROBOT}/P", 0.16, disable_rotations=True, depth_test=False, line_width=3.0
        )
        self.gizmo.on_update(self._dragged)
        self.go_home()

    async def _dragged(self, event: Any) -> None:
        # Not a thread of viser's: those may run out of order.
        position = event.target.position
        self._worker.put("drag", lambda: self.drag(position))

    # -- postures -----------------------------------------------------------------------------

    @property
    def working(self) -> Any:
        """Working mode that the panel asks for."""
        bends = [1 if word == "out" else -1 for word in self.bends.value.split(" / ")]
        signs = tuple(np.array(bends) * self._out)
        if isinstance(self._machine, Delta):
            return signs
        return WorkingMode(_LINK_7[self.link_7.value], *signs)

    def drag(self, position: Any) -> None:
        """Move P to ``position`` (3,) m, machine's frame, in the modes of the panel."""
        operation: Operation = self.operation.value
        self._attempt(
            lambda: at_point(self._machine, position, operation, self.working, self.posture.tilt)
        )

    def turn(self, theta: Any) -> None:
        """Turn the motors to ``theta`` (3,) rad, in the assembly mode of the panel."""
        modes = self._assemblies
        mode = modes[self.assembly.options.index(self.assembly.value)]
        self._attempt(lambda: at_joints(self._machine, theta, mode))

    def hide_gizmo(self, hidden: bool) -> None:
        """Hide the gizmo, which covers the cup, or show it again."""
        if self.gizmo is not None and self.gizmo.visible == hidden:
            self.gizmo.visible = not hidden

    def go_home(self) -> None:
        """Move to the machine's home, in its own modes."""
        machine = self._machine
        self.set(at_point(machine, machine.home, "translating", machine.working_mode))

    def set(self, posture: Posture) -> None:
        """Show a posture, and its modes and motors in the panel."""
        self.posture = posture
        # All messages at once: each wakes the thread that sends them.
        with self._server.atomic():
            self._set_panel(posture)
            if self.gizmo is not None:
                self.gizmo.position = posture.position
            self._show(posture)

    def _set_panel(self, posture: Posture) -> None:
        self._refuse("")
        working = posture.working
        bends = working.signs[1:] if isinstance(working, WorkingMode) else working
        self.operation.value = posture.operation
        self._set_assemblies()
        self.bends.value = " / ".join(_BENDS[int(b)] for b in np.array(bends) * self._out)
        if isinstance(working, WorkingMode):
            self.link_7.value = next(k for k, v in _LINK_7.items() if v == working.cos_beta)
        self.assembly.value = _label(posture.assembly)
        for motor, angle in zip(self.motors, np.degrees(posture.theta), strict=True):
            motor.value = float(motor.min + (angle - motor.min) % 360.0)

    def _refuse(self, problem: str) -> None:
        self.problem = problem
        style = "color:#c0392b;padding:0.5em 1em;font-size:0.85em"
        said = f'<div style="{style}"><b>No such posture.</b> {escape(problem)}</div>'
        if self.text != (text := said if problem else ""):
            self._refusal.content = text

    @property
    def text(self) -> str:
        """The reason in the panel, as HTML."""
        return str(self._refusal.content)

    def _attempt(self, solve: Callable[[], Posture]) -> None:
        try:
            posture = solve()
        except TPMError as error:
            self._refuse(str(error))
            self._set_assemblies()
            return
        self.set(posture)

    @property
    def _assemblies(self) -> tuple[Any, ...]:
        if isinstance(self._machine, Delta):
            return delta.ASSEMBLY_MODES
        return ASSEMBLY_MODES if self.operation.value == "translating" else ROTATED_MODES

    def _set_assemblies(self) -> None:
        """Offer the assembly modes of the operation mode."""
        labels = tuple(_label(mode) for mode in self._assemblies)
        if self.assembly.options != labels:
            self.assembly.options = labels

    def _point_again(self) -> None:
        assert self.gizmo is not None
        self.drag(self.gizmo.position)

    def _joints_again(self) -> None:
        self.turn(np.radians([motor.value for motor in self.motors]))


def _label(mode: AssemblyMode | RotatedMode | float) -> str:
    if isinstance(mode, float):
        return f"det A {'>' if mode > 0 else '<'} 0"
    parts = [f"planar {'+' if mode.planar > 0 else '-'}"]
    if isinstance(mode, RotatedMode):
        parts.append("larger tilt" if mode.further > 0 else "smaller tilt")
    parts.append(f"y {'>' if mode.sin_beta > 0 else '<'} 0")
    return ", ".join(parts)
