"""An engine without physics, in one file outside the package: joints jump, blocks stay put."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tpm_gym import Machine, register_engine
from tpm_gym.arrays import Vector
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.cup import CUP, sealed
from tpm_gym.simulation import Plant, Scene
from tpm_gym.simulation.engine import Hold, Motors, Pose, Reference, Truth, Twist
from tpm_gym.simulation.randomisation import NOMINAL
from tpm_gym.simulation.state import CONTROL_PERIOD
from tpm_gym.simulation.vacuum import EMPTY, Load, hold_after

DOWN = (0.0, 0.0, -1.0)


class KinematicEngine:
    """Takes neither physics nor a window, so it names neither in its constructor."""

    substeps = 1

    def load(self, machine: Machine, scene: Scene) -> None:
        self._machine, self._blocks = machine, scene.objects

    def alter(self, plant: Plant) -> None:
        if (plant.link_masses, plant.motor_strength) != ((), NOMINAL.motor_strength):
            raise ConfigurationError("randomisation", plant, "one of lengths and encoders")

    def place(self, joints: Mapping[str, float], objects: Sequence[Pose]) -> None:
        a, b, c = (joints[name] for name in self._machine.mechanism.actuated)
        self._theta, self._rates, self._hold = (a, b, c), (0.0, 0.0, 0.0), EMPTY
        self._poses = list(objects)

    def show_goal(self, markers: Sequence[Vector]) -> None:
        pass

    def advance(self, references: Sequence[Reference], vacuum: bool) -> None:
        before, theta = self._position(), references[-1].theta
        a, b, c = np.subtract(theta, self._theta) / CONTROL_PERIOD
        self._theta, self._rates = theta, (a, b, c)
        now = self._position()
        held = self._hold.which
        if held >= 0:
            x, y, z = np.add(self._poses[held].position, np.subtract(now, before))
            self._poses[held] = Pose((x, y, z))
        x, y, z = now
        lip = (x, y, z - CUP.length)
        touched = [
            index
            for index, (block, pose) in enumerate(zip(self._blocks, self._poses, strict=True))
            if sealed(lip, DOWN, *pose, (block.width, block.height))
        ]
        first = touched[0] if touched else -1
        self._hold = hold_after(self._hold, CONTROL_PERIOD, vacuum, Load(), first)

    def motors(self) -> Motors:
        return Motors(self._theta, self._rates, (0.0, 0.0, 0.0))

    def truth(self) -> Truth:
        return Truth(0.0, self._position(), 0.0)

    def objects(self) -> list[tuple[Pose, Twist]]:
        return [(pose, Twist()) for pose in self._poses]

    def hold(self) -> Hold:
        return self._hold

    def save(self) -> Any:
        return self._theta, self._rates, self._hold, tuple(self._poses)

    def restore(self, snapshot: Any) -> None:
        self._theta, self._rates, self._hold, poses = snapshot
        self._poses = list(poses)

    def picture(self, width: int, height: int) -> NDArray[np.uint8]:
        """From above, a metre wide: the blocks."""
        image = np.full((height, width, 3), 255, np.uint8)
        for block, pose in zip(self._blocks, self._poses, strict=True):
            half = max(1, int(block.width * width / 2))
            column, row = (int(width * at) for at in np.array(pose.position)[:2] * (1, -1))
            row, column = max(0, height // 2 + row - half), max(0, width // 2 + column - half)
            image[row : row + 2 * half, column : column + 2 * half] = 255 * np.array(
                block.colour[:3]
            )
        return image

    def close(self) -> None:
        pass

    def _position(self) -> Vector:
        return self._machine.mount.swap(self._machine.evaluate(self._theta).position)


register_engine("kinematic", KinematicEngine)
