"""Engine that simulates one robot with MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import BoolArray, FloatArray, IntArray, Vector
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.drives import Servo, ServoDrives
from tpm_gym.simulation.engine import Engine, Grip, Path, Pose, Readout, drives_of_one, steering
from tpm_gym.simulation.imaging import Camera, Picture, View
from tpm_gym.simulation.mujoco.cup import Cup
from tpm_gym.simulation.mujoco.model import compile_model, segmentation_ids
from tpm_gym.simulation.mujoco.physics import Physics
from tpm_gym.simulation.mujoco.pictures import Pictures
from tpm_gym.simulation.mujoco.robot import Robot
from tpm_gym.simulation.mujoco.scenery import Scenery
from tpm_gym.simulation.mujoco.window import Window
from tpm_gym.simulation.randomisation import NOMINAL, Plant
from tpm_gym.simulation.settings import settings_of
from tpm_gym.simulation.state import Scene

_STATE = int(
    mujoco.mjtState.mjSTATE_FULLPHYSICS
    | mujoco.mjtState.mjSTATE_WARMSTART
    | mujoco.mjtState.mjSTATE_EQ_ACTIVE
)
"""Parts of MuJoCo's state that determine the next time steps."""


@dataclass(frozen=True)
class _Saved:
    numbers: tuple[float, ...]
    torque: Vector
    drives: NDArray[Any] | None
    grip: Grip


class MujocoEngine:
    """Engine that simulates one robot with MuJoCo.

    ``place``, ``advance`` and ``restore`` end with the first half of the next time step, which
    computes positions, contacts and constraints. So all values that can be read belong to the same
    instant.

    Args:
        gui: Whether to open MuJoCo's viewer.
        renderer: ``"egl"``, ``"osmesa"`` or ``"glfw"``. If None, the environment variable
            ``MUJOCO_GL`` names the renderer. If the variable has none of these three names, the
            first renderer that works is used.
        physics: A :class:`Physics` or a mapping of its attributes.
        drive: Servo drives of the motors; None for ideal drives.

    Raises:
        ConfigurationError: If an option is out of range, or no window can open.
    """

    def __init__(
        self,
        *,
        gui: bool = False,
        renderer: str | None = None,
        physics: Any = None,
        drive: Servo | None = None,
    ) -> None:
        """Check the options."""
        self.physics = settings_of(Physics, "physics", physics)
        self.time_step = self.physics.time_step
        self._pictures = Pictures(renderer)
        self._window = Window() if gui else None
        self._servo = drive
        self._drives: ServoDrives | None = None

    def load(self, machine: Machine, scene: Scene, count: int) -> None:
        """Implement :meth:`Engine.load`."""
        self._drives = drives_of_one(self._servo, machine, count, self.time_step)
        self._nominal, self._scene, self._plant = machine, scene, NOMINAL
        self._load(machine)

    def _load(self, machine: Machine) -> None:
        self._machine = machine
        self.model = compile_model(machine, self._scene, self.physics)
        self._ids = segmentation_ids(self.model, machine.mechanism.tool, self._scene)
        self.data = mujoco.MjData(self.model)
        self._reset()
        self.robot = Robot(self.model, self.data, machine, ideal=self._servo is None)
        self._scenery = Scenery(self.model, self.data, self._scene)
        self._cup = Cup(self.model, self.data, self.robot, self._scenery, self._scene.objects)

    def alter(self, rows: IntArray, plants: Sequence[Plant]) -> None:
        """Implement :meth:`Engine.alter`."""
        (plant,) = plants
        if plant.length_errors != self._plant.length_errors:
            self._load(plant.of(self._nominal))
        self._plant = plant
        self.robot.alter(plant)
        if self._drives is not None:
            self._drives.alter(rows, plants)
        self._scenery.alter(plant.block_mass, plant.friction)
        mujoco.mj_setConst(self.model, self.data)

    def place(self, rows: IntArray, theta: FloatArray, objects: FloatArray) -> None:
        """Implement :meth:`Engine.place`."""
        self._reset()
        self._cup.set(Grip())
        self.robot.place(self._machine.joint_positions(theta[0]))
        if self._drives is not None:
            self._drives.rest(rows, theta)
        self._scenery.place([Pose.of(row) for row in objects[0].tolist()])
        mujoco.mj_step1(self.model, self.data)

    def set_belt(self, rows: IntArray, speed: FloatArray) -> None:
        """Implement :meth:`Engine.set_belt`."""
        self._scenery.set_belt(float(speed[0]))

    def _reset(self) -> None:
        """Reset the state, and suppress MuJoCo's warnings.

        MuJoCo writes the first warning of each kind to the console and into a file. The warnings
        are not needed, because a loop closure that opens raises ClosureError.
        """
        mujoco.mj_resetData(self.model, self.data)
        for warning in self.data.warning:
            warning.number = 1

    def advance(self, path: Path, vacuum: BoolArray) -> None:
        """Implement :meth:`Engine.advance`."""
        model, data, cup, scenery, on = self.model, self.data, self._cup, self._scenery, vacuum[0]
        first_half, second_half = mujoco.mj_step1, mujoco.mj_step2
        targets, drive = steering(self._drives, path, self.robot)
        for left, target in enumerate(targets, 1 - len(targets)):
            drive(target)
            scenery.keep_sliding()
            second_half(model, data)
            if not left:  # the last time step
                self.robot.note_torque()
            load = cup.load()
            first_half(model, data)
            if cup.breathe(on, load):
                first_half(model, data)  # again, because a weld was added or removed

    def read(self) -> Readout:
        """Implement :meth:`Engine.read`."""
        robot, objects = self.robot, self._scenery.read()
        hold = self._cup.grip.hold
        return Readout.of_one(self._machine, robot.motors(), robot.truth(), hold, objects)

    def show(self, camera: Camera, markers: FloatArray) -> None:
        """Implement :meth:`Engine.show`."""
        if self._window is not None:
            self._window.show(self.model, self.data, camera, markers, self._scene.marker_radius)

    def save(self) -> Any:
        """Implement :meth:`Engine.save`."""
        numbers = np.empty(mujoco.mj_stateSize(self.model, _STATE))
        mujoco.mj_getState(self.model, self.data, numbers, _STATE)
        memory = None if self._drives is None else self._drives.memory.copy()
        return _Saved(tuple(numbers.tolist()), self.robot.torque, memory, self._cup.grip)

    def restore(self, saved: Any) -> None:
        """Implement :meth:`Engine.restore`."""
        mujoco.mj_setState(self.model, self.data, np.array(saved.numbers), _STATE)
        self._cup.set(saved.grip)
        self.robot.torque = saved.torque
        if self._drives is not None:
            self._drives.memory[:] = saved.drives
        mujoco.mj_step1(self.model, self.data)

    def picture(self, row: int, view: View) -> Picture:
        """Implement :meth:`Engine.picture`."""
        return self._pictures.draw(self.model, self.data, view, self._ids)

    def close(self) -> None:
        """Implement :meth:`Engine.close`."""
        self._pictures.close()
        if self._window is not None:
            self._window.close()


_: type[Engine] = MujocoEngine  # mypy checks that the class has the methods of Engine
