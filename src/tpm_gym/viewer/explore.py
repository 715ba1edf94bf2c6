"""Tab "Explore": the user chooses a posture by point P, motors and modes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from html import escape
from typing import Any, TypeVar

from viser import GuiApi, TransformControlsHandle, ViserServer

from tpm_gym.errors import TPMError
from tpm_gym.mechanism import Machine
from tpm_gym.viewer.kinds import Kind, Posture
from tpm_gym.viewer.scene import ROBOT
from tpm_gym.viewer.worker import Worker

_Label = TypeVar("_Label")


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
        refusal: Element of the panel that shows this reason.
    """

    def __init__(
        self, server: ViserServer, worker: Worker, show: Callable[[Posture], object]
    ) -> None:
        """Add the controls."""
        self._server, self._worker, self._show = server, worker, show
        self.posture: Posture
        self.gizmo: TransformControlsHandle
        self._add_modes(server.gui)
        self._add_motors(server.gui)
        # Last in the panel, so that a message that appears moves no control.
        self.refusal: Any = server.gui.add_html("")

    def _add_modes(self, gui: GuiApi) -> None:
        self.operation: Any = gui.add_dropdown("Operation", ("",))
        self.working_lists: list[Any] = [gui.add_dropdown("Working", ("",)) for _ in range(2)]
        self.assembly: Any = gui.add_dropdown("Assembly", ("",))
        for handle in (self.operation, *self.working_lists):
            handle.on_update(lambda _: self._worker.ask("modes", self._point_again))
        self.assembly.on_update(lambda _: self._worker.ask("modes", self._joints_again))

    def _add_motors(self, gui: GuiApi) -> None:
        self.motors: list[Any] = [
            gui.add_slider(f"Motor {k + 1}", -180.0, 180.0, 0.1, 0.0) for k in range(3)
        ]
        for motor in self.motors:
            motor.on_update(lambda _: self._worker.ask("motors", self._joints_again))
        home = gui.add_button("Back to the machine's home")
        home.on_click(lambda _: self._worker.put("home", self.go_home))

    # -- machine ------------------------------------------------------------------------------

    def set_kind(self, kind: Kind) -> None:
        """Show another machine, at its home and in its modes."""
        self._kind = kind
        operation, *parts, assembly = kind.lists.items()
        _fill(self.operation, operation, kind.assembly)
        for index, handle in enumerate(self.working_lists):
            handle.visible = index < len(parts)
            if handle.visible:
                _fill(handle, parts[index], (words[index] for words in kind.working))
        _fill(self.assembly, assembly, kind.assembly[self.operation.value])
        for k, (motor, (scale, unit)) in enumerate(
            zip(self.motors, units(kind.machine), strict=True)
        ):
            turns, stops = unit == "°", scale * kind.machine.stops[:, k]
            motor.label = f"Motor {k + 1}, {unit}"
            motor.min, motor.max = (kind.lows[k], kind.lows[k] + 360.0) if turns else stops.tolist()
        self.gizmo = self._server.scene.add_transform_controls(
            f"{ROBOT}/P", 0.16, disable_rotations=True, depth_test=False, line_width=3.0
        )
        self.gizmo.on_update(self._dragged)
        self.go_home()

    async def _dragged(self, event: Any) -> None:
        # Coroutines run in viser's event loop, in order. Viser's threads may run out of order.
        position = event.target.position
        self._worker.put("drag", lambda: self.drag(position))

    # -- postures -----------------------------------------------------------------------------

    @property
    def working(self) -> Any:
        """Working mode that is chosen in the panel."""
        words = (handle.value for handle in self.working_lists if handle.visible)
        return self._kind.working[tuple(words)]

    def drag(self, position: Any) -> None:
        """Move P to ``position`` (3,) m, machine's frame, in the modes of the panel."""
        modes = self.operation.value, self.working
        self._attempt(lambda: self._kind.at_point(position, *modes, self.posture.tilt))

    def turn(self, theta: Any) -> None:
        """Turn the motors to ``theta`` (3,) rad, in the assembly mode of the panel."""
        mode = self._kind.assembly[self.operation.value][self.assembly.value]
        self._attempt(lambda: self._kind.at_joints(theta, mode))

    def hide_gizmo(self, hidden: bool) -> None:
        """Hide the gizmo, which covers the cup, or show it again."""
        if self.gizmo.visible == hidden:
            self.gizmo.visible = not hidden

    def go_home(self) -> None:
        """Move to the machine's home, in the machine's own modes."""
        self.set(self._kind.home())

    def set(self, posture: Posture) -> None:
        """Show a posture, and its modes and motors in the panel."""
        self.posture = posture
        # All messages are sent together, since each message wakes the thread that sends them.
        with self._server.atomic():
            self._set_panel(posture)
            self.gizmo.position = posture.position
            self._show(posture)

    def _set_panel(self, posture: Posture) -> None:
        self._refuse("")
        self.operation.value = posture.operation
        self._set_assemblies()
        words = _label(self._kind.working, posture.working)
        for handle, word in zip(self.working_lists, words, strict=False):
            handle.value = word
        self.assembly.value = _label(self._kind.assembly[posture.operation], posture.assembly)
        shown = zip(self.motors, units(posture.machine), posture.theta, strict=True)
        for motor, (scale, unit), theta in shown:
            beyond = scale * theta - motor.min
            motor.value = float(motor.min + (beyond % 360.0 if unit == "°" else beyond))

    def _refuse(self, problem: str) -> None:
        self.problem = problem
        style = "color:#c0392b;padding:0.5em 1em;font-size:0.85em"
        said = f'<div style="{style}"><b>No such posture.</b> {escape(problem)}</div>'
        if self.refusal.content != (text := said if problem else ""):
            self.refusal.content = text

    def _attempt(self, solve: Callable[[], Posture]) -> None:
        try:
            posture = solve()
        except TPMError as error:
            self._refuse(str(error))
            self._set_assemblies()
            return
        self.set(posture)

    def _set_assemblies(self) -> None:
        """Offer the assembly modes of the operation mode."""
        labels = tuple(self._kind.assembly[self.operation.value])
        if self.assembly.options != labels:
            self.assembly.options = labels

    def _point_again(self) -> None:
        self.drag(self.gizmo.position)

    def _joints_again(self) -> None:
        scales = [scale for scale, _ in units(self._kind.machine)]
        self.turn([motor.value / scale for motor, scale in zip(self.motors, scales, strict=True)])


def units(machine: Machine) -> list[tuple[float, str]]:
    """Return the factor from rad or m to the panel's unit, and the unit, for each motor."""
    of_motor = {"rad": (math.degrees(1.0), "°"), "m": (1000.0, "mm")}
    return [of_motor[motor.unit] for motor in machine.mechanism.motors]


def _fill(handle: Any, label: tuple[str, str], options: Iterable[str]) -> None:
    """Change label, explanation and options of a drop-down list."""
    (handle.label, handle.hint), handle.options = label, tuple(dict.fromkeys(options))


def _label(modes: Mapping[_Label, Any], mode: Any) -> _Label:
    return next(label for label, one in modes.items() if one == mode)
