"""An engine without physics, in one file outside the package: joints jump, blocks stay put."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from tpm_gym import Machine, register_engine
from tpm_gym.arrays import BoolArray, FloatArray, IntArray
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.cup import CUP, sealed
from tpm_gym.simulation import Plant, Scene
from tpm_gym.simulation.engine import Path, Pose, Readout, Twist
from tpm_gym.simulation.imaging import Camera, Picture, View
from tpm_gym.simulation.randomisation import NOMINAL
from tpm_gym.simulation.state import CONTROL_PERIOD
from tpm_gym.simulation.vacuum import EMPTY, Load, hold_after

DOWN = (0.0, 0.0, -1.0)


class KinematicEngine:
    """One robot. It takes neither physics nor a window, so its constructor names neither."""

    time_step = CONTROL_PERIOD

    def load(self, machine: Machine, scene: Scene, count: int) -> None:
        self._machine, self._blocks, self._count = machine, scene.objects, count

    def alter(self, rows: IntArray, plants: Sequence[Plant]) -> None:
        for plant in plants:
            if (plant.link_masses, plant.motor_strength) != ((), NOMINAL.motor_strength):
                raise ConfigurationError("randomisation", plant, "one of lengths and encoders")

    def place(self, rows: IntArray, theta: FloatArray, objects: FloatArray) -> None:
        self._theta, self._rates, self._hold = theta.copy(), np.zeros_like(theta), EMPTY
        self._objects = objects[0].copy()

    def set_belt(self, rows: IntArray, speed: FloatArray) -> None:
        raise ConfigurationError("engine", "kinematic", "an engine with friction, for a belt")

    def advance(self, path: Path, vacuum: BoolArray) -> None:
        before, theta = self._position(), path.joints(last=1)[:, -1]
        self._rates, self._theta = (theta - self._theta) / self.time_step, theta
        now = self._position()
        if self._hold.which >= 0:
            self._objects[self._hold.which, :3] += now - before
        x, y, z = now.tolist()
        touched = [
            index
            for index, (block, pose) in enumerate(zip(self._blocks, self._poses(), strict=True))
            if sealed((x, y, z - CUP.length), DOWN, *pose, (block.width, block.height))
        ]
        first, on = touched[0] if touched else -1, bool(vacuum[0])
        self._hold = hold_after(self._hold, self.time_step, on, Load(), first)

    def read(self) -> Readout:
        rows = (tuple(values[0].tolist()) for values in (self._theta, self._rates, 0 * self._rates))
        x, y, z = self._position().tolist()
        objects = [(pose, Twist()) for pose in self._poses()]
        motors: Any = tuple(rows)
        return Readout.of_one(self._machine, motors, (0.0, (x, y, z), 0.0), self._hold, objects)

    def save(self) -> Any:
        return self._theta, self._rates, self._hold, self._objects.copy()

    def restore(self, saved: Any) -> None:
        self._theta, self._rates, self._hold, objects = saved
        self._objects = objects.copy()

    def show(self, camera: Camera, markers: FloatArray) -> None:
        pass

    def picture(self, row: int, view: View) -> Picture:
        """From above, a metre wide: the blocks."""
        image = np.full((view.height, view.width, 3), 255, np.uint8)
        for block, (x, y, *_) in zip(self._blocks, self._objects.tolist(), strict=True):
            half = max(1, int(block.width * view.width / 2))
            top = max(0, view.height // 2 - int(view.width * y) - half)
            left = max(0, view.width // 2 + int(view.width * x) - half)
            colour = 255 * np.array(block.colour[:3])
            image[top : top + 2 * half, left : left + 2 * half] = colour
        return Picture(image)

    def close(self) -> None:
        pass

    def _poses(self) -> list[Pose]:
        return [Pose.of(row) for row in self._objects.tolist()]

    def _position(self) -> FloatArray:
        """Point P (3,) m, world."""
        return self._machine.mount.to_world(self._machine.evaluate(self._theta).position[0])


register_engine("kinematic", KinematicEngine)
