"""MuJoCo behind the seam of :class:`tpm_gym.simulation.engine.Engine`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import Vector
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.drives import Memory, Reference, Servo, Servos, follow
from tpm_gym.simulation.engine import Engine, Motors, Pose, Truth, Twist
from tpm_gym.simulation.mujoco.cup import Cup, Grip
from tpm_gym.simulation.mujoco.model import compiled
from tpm_gym.simulation.mujoco.physics import Physics
from tpm_gym.simulation.mujoco.pictures import Pictures
from tpm_gym.simulation.mujoco.robot import Robot
from tpm_gym.simulation.mujoco.scenery import Scenery
from tpm_gym.simulation.randomisation import Plant
from tpm_gym.simulation.settings import settings_of
from tpm_gym.simulation.state import Scene
from tpm_gym.simulation.vacuum import Hold

__all__ = ["MujocoEngine"]

_STATE = int(
    mujoco.mjtState.mjSTATE_FULLPHYSICS
    | mujoco.mjtState.mjSTATE_WARMSTART
    | mujoco.mjtState.mjSTATE_EQ_ACTIVE
)
"""What the next time steps depend on, besides the model."""


@dataclass(frozen=True)
class _Moment:
    numbers: tuple[float, ...]
    drives: Memory | None
    grip: Grip


class MujocoEngine:
    """See :class:`~tpm_gym.simulation.engine.Engine`.

    Between the calls, the first half of the next time step (positions, contacts, constraints) has
    been computed, so that all that can be read belongs together.

    Args:
        renderer: ``"egl"``, ``"osmesa"`` or ``"glfw"``; None for that of the environment variable
            ``MUJOCO_GL``, or else the first that works.
        physics: A :class:`Physics` or a mapping of its attributes.
        drive: The motors' servo drives; None for ideal ones.

    Raises:
        ConfigurationError: If an option is out of range.
    """

    def __init__(
        self, *, renderer: str | None = None, physics: Any = None, drive: Servo | None = None
    ) -> None:
        """Check the options."""
        self.physics = settings_of(Physics, "physics", physics)
        self.substeps = self.physics.substeps
        self._pictures = Pictures(renderer)
        self._servo = drive
        self._servos: Servos | None = None

    def load(self, machine: Machine, scene: Scene) -> None:
        """See the protocol."""
        self.model = compiled(machine, scene, self.physics)
        self.data = mujoco.MjData(self.model)
        self._reset()
        self.robot = Robot(self.model, self.data, machine, ideal=self._servo is None)
        if self._servo is not None:
            self._servos = Servos(self._servo, machine, self.physics.time_step)
        self._scenery = Scenery(self.model, self.data, scene)
        self._cup = Cup(self.model, self.data, self.robot, self._scenery, scene.objects)

    def alter(self, plant: Plant) -> None:
        """See the protocol."""
        self.robot.alter(plant)
        if self._servos is not None:
            self._servos.alter(plant)
        self._scenery.alter(plant.puck_mass, plant.friction)
        mujoco.mj_setConst(self.model, self.data)

    def place(self, joints: Mapping[str, float], objects: Sequence[Pose]) -> None:
        """See the protocol."""
        self._reset()
        self._cup.set(Grip())
        self.robot.place(joints)
        if self._servos is not None:
            self._servos.rest(self.robot.motors().theta)
        self._scenery.place(objects)
        mujoco.mj_step1(self.model, self.data)

    def _reset(self) -> None:
        """Forget all motion, and let no number that is too large be told but by a lost loop.

        The engine would write of each kind's first one to the console and into a file.
        """
        mujoco.mj_resetData(self.model, self.data)
        for warning in self.data.warning:
            warning.number = 1

    def show_goal(self, markers: Sequence[Vector]) -> None:
        """See the protocol."""
        self._scenery.move_markers(markers)

    def advance(self, references: Sequence[Reference], vacuum: bool) -> None:
        """See the protocol."""
        model, data, cup, scenery = self.model, self.data, self._cup, self._scenery
        first_half, second_half = mujoco.mj_step1, mujoco.mj_step2
        if self._servos is not None and references:
            self._servos.begin(references[0].theta)
        for left, reference in enumerate(references, 1 - len(references)):
            follow(self.robot, self._servos, reference)
            scenery.keep_sliding()
            second_half(model, data)
            if not left:
                self.robot.note_torque()
            load = cup.load()
            first_half(model, data)
            if cup.breathe(vacuum, load):
                first_half(model, data)  # with another constraint

    def motors(self) -> Motors:
        """See the protocol."""
        return self.robot.motors()

    def truth(self) -> Truth:
        """See the protocol."""
        return self.robot.truth()

    def objects(self) -> list[tuple[Pose, Twist]]:
        """See the protocol."""
        return self._scenery.read()

    def hold(self) -> Hold:
        """See the protocol."""
        return self._cup.grip.hold

    def save(self) -> Any:
        """See the protocol."""
        numbers = np.empty(mujoco.mj_stateSize(self.model, _STATE))
        mujoco.mj_getState(self.model, self.data, numbers, _STATE)
        memory = None if self._servos is None else self._servos.memory
        return _Moment(tuple(numbers.tolist()), memory, self._cup.grip)

    def restore(self, snapshot: Any) -> None:
        """See the protocol."""
        mujoco.mj_setState(self.model, self.data, np.array(snapshot.numbers), _STATE)
        self._cup.set(snapshot.grip)
        if self._servos is not None:
            self._servos.memory = snapshot.drives
        mujoco.mj_step1(self.model, self.data)

    def picture(self, width: int, height: int) -> NDArray[np.uint8]:
        """See the protocol."""
        return self._pictures.draw(self.model, self.data, width, height)

    def close(self) -> None:
        """See the protocol."""
        self._pictures.close()


_: type[Engine] = MujocoEngine  # so that mypy compares them
