"""Modes, postures and layers of a machine, as the viewer shows them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, vector
from tpm_gym.mechanism.bodies import Place
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.state import State

Found: TypeAlias = tuple[Any, Callable[[], Any]]
"""Layer of a posture: the values that it depends on, and a function that computes what to draw."""


@dataclass(frozen=True)
class Margin:
    """Nearest singular position of point P.

    Attributes:
        distance: Distance from P, m.
        point: The singular position (3,) m, machine's frame.
        factor: Name of the factor that is zero at ``point``, one of
            :data:`tpm_gym.analysis.singularity.FACTORS`. A position is singular where a factor is
            zero.
    """

    distance: float
    point: FloatArray
    factor: str


@dataclass(frozen=True)
class Posture:
    """Configuration of a machine in which the loops are closed; machine's frame.

    The modes are those of a :class:`Kind`.

    Attributes:
        machine: The machine.
        theta: (3,) rad (m for a slide), joint positions of the motors.
        position: (3,) m, point P.
        working: Working mode.
        assembly: Assembly mode.
        joints: Positions of all joints by name, rad or m.
        conditioning: 1/cond(J) of the motion of P, in [0, 1]; 0 at a singularity.
        operation: Operation mode.
        tilt: Turn of the platform about y, rad; 0 in translating operation.
    """

    machine: Machine
    theta: FloatArray
    position: FloatArray
    working: Any
    assembly: Any
    joints: Mapping[str, float]
    conditioning: float
    operation: str = "translating"
    tilt: float = 0.0

    @cached_property
    def places(self) -> dict[str, Place]:
        """Positions and orientations of all links in the base's frame, by name."""
        return self.machine.mechanism.places(self.joints)

    @property
    def gap(self) -> float:
        """Largest distance between the two points of a loop closure, m; 0 without loops."""
        ends = [
            self.places[closure.link_a].point(closure.point_a)
            - self.places[closure.link_b].point(closure.point_b)
            for closure in self.machine.mechanism.closures
        ]
        return float(np.linalg.norm(ends, axis=-1).max(initial=0.0))

    @property
    def stop_margins(self) -> FloatArray:
        """Distance of each motor to its nearest stop, (3,) rad or m; negative beyond the stop."""
        low, high = self.machine.stops
        margins: FloatArray = np.minimum(self.theta - low, high - self.theta)
        return margins


class Kind:
    """Machine with its modes, postures and layers, as the viewer shows them.

    This class is for any machine, but shows only the machine's own working mode and assembly mode,
    and no layers. A mechanism with more modes, or with layers, has a derived class.

    Attributes:
        machine: The machine.
        lists: Labels of the lists in the panel, with an explanation each. The first list chooses
            the operation mode, and the last one the assembly mode. The lists between them, at most
            two, choose the working mode.
        working: Working modes. A key is the tuple of the labels that the user chooses in the lists
            of the working mode.
        assembly: Assembly modes by operation mode and label.
        lows: Lower ends of the motors' sliders in the panel, degrees. The slider of a linear motor
            goes from stop to stop instead.
    """

    lists: Mapping[str, str] = {"Operation": "Operation mode", "Assembly": "Assembly mode"}
    working: Mapping[tuple[str, ...], Any] = {(): None}
    assembly: Mapping[str, Mapping[str, Any]] = {"translating": {"of the machine": None}}
    lows: Sequence[float] = (-180.0, -180.0, -180.0)

    def __init__(self, machine: Any) -> None:
        """Store the machine."""
        self.machine = machine

    def at_point(
        self, position: ArrayLike, operation: str, working: Any, tilt: float = 0.0
    ) -> Posture:
        """Solve the posture with P at ``position`` (3,) m, in a working mode.

        Args:
            position: Point P, machine's frame.
            operation: Operation mode.
            working: Working mode.
            tilt: Preferred tilt, rad. If several rotated postures exist, the posture whose tilt is
                nearest to this value is returned.

        Raises:
            InputError: If ``position`` is not three finite numbers, or ``operation`` is "rotated"
                and no rotated posture exists at ``position``.
            UnreachableError: If ``operation`` is "translating" and ``position`` is out of reach.
        """
        theta = self.machine.require_inverse(np.array(vector("position", position)))
        return self.at_joints(theta, None)

    def at_joints(self, theta: ArrayLike, assembly: Any) -> Posture:
        """Solve the posture with the motors at ``theta`` (3,) rad, in an assembly mode.

        Raises:
            InputError: If ``theta`` is not three finite numbers, or ``assembly`` belongs to the
                rotated operation mode and has no posture at ``theta``.
            UnreachableError: If ``assembly`` belongs to the translating operation mode and has no
                posture at ``theta``.
        """
        angles = vector("theta", theta)
        found = self.machine.require_evaluate(np.array(angles))
        joints = self.machine.joint_positions(angles)
        quality = float(found.conditioning)
        return Posture(
            self.machine, np.array(angles), found.position, None, assembly, joints, quality
        )

    def home(self) -> Posture:
        """Return the posture with P at home, in the machine's own modes."""
        working = getattr(self.machine, "working_mode", None)
        return self.at_point(self.machine.home, next(iter(self.assembly)), working)

    def of_state(self, state: State) -> Posture:
        """Return the posture of an episode's robot, at its encoders' joint positions."""
        return self.at_joints(state.theta, getattr(self.machine, "assembly_mode", None))

    def layers(self, posture: Posture) -> Mapping[str, Found]:
        """Return the available layers of a posture, by name.

        Names, and what each layer's function returns:

        - parallel, serial, constraint: meshes of singular surfaces, by name;
        - aspects: a sequence with one set of cells (``Cells``) for each aspect;
        - workspace: one set of cells (``Cells``);
        - conditioning: a mesh, and the conditionings at its vertices;
        - margin: a :class:`Margin`, or None.
        """
        return {}


def elbows(out: Sequence[float]) -> dict[str, tuple[Any, ...]]:
    """Return the working modes by label, such as ``"out / in / out"``.

    A working mode is given by three signs, one for each leg.

    Args:
        out: For each leg, the sign if its elbow is out. The sign is opposite if the elbow is in.
    """
    words = {"out": 1, "in": -1}
    return {
        " / ".join(bends): tuple(words[b] * o for b, o in zip(bends, out, strict=True))
        for bends in product(words, repeat=3)
    }
