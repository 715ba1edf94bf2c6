"""One robot in closed form, for an environment of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.arrays import FloatArray, Vector, vector
from tpm_gym.errors import ConfigurationError, ModeChangeError
from tpm_gym.mechanism.machine import Machine
from tpm_gym.mechanism.tpm import PAPER_TPM
from tpm_gym.simulation.analytic.simulation import AnalyticSimulation, Moment
from tpm_gym.simulation.drives import Servo, require_servo
from tpm_gym.simulation.engine import Engine, Pose, make_engine
from tpm_gym.simulation.randomisation import NOMINAL, Plant
from tpm_gym.simulation.state import Scene, State

__all__ = ["SingleSimulation"]

_ROW = np.array([0])


class SingleSimulation:
    """What :class:`~tpm_gym.simulation.simulation.Simulation` is, as one of a batch of one.

    Pictures are drawn by PyBullet, which is started for the first one.

    Args:
        scene: See :class:`~tpm_gym.simulation.simulation.Simulation`, for the others too.
        machine: See there.
        physics: See :class:`~tpm_gym.simulation.analytic.simulation.AnalyticSimulation`.
        drive: See there.
        gui: There is no window.
        renderer: PyBullet's.

    Raises:
        ConfigurationError: If an option is out of range, or beyond what is in closed form.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        machine: Machine = PAPER_TPM,
        physics: Any = None,
        drive: Servo | None = None,
        gui: bool = False,
        renderer: str | None = None,
    ) -> None:
        """Put the robot at rest at home."""
        if gui:
            valid = "None or 'rgb_array': the closed form has no window"
            raise ConfigurationError("render_mode", "human", valid)
        self.scene, self.machine, self.drive = scene, machine, drive
        self.batch = AnalyticSimulation(
            scene, machine=machine, physics=physics, drive=drive, count=1
        )
        self._renderer = renderer
        self._artist: Engine | None = None
        self._markers: list[Vector] = []

    def reset(
        self,
        theta: ArrayLike,
        objects: Mapping[str, ArrayLike] | None = None,
        plant: Plant = NOMINAL,
        noise: Vector = (0.0, 0.0, 0.0),
    ) -> State:
        """See :meth:`Simulation.reset`."""
        require_servo(self.drive, plant.servo_stiffness, plant.joint_friction)
        angles = vector("theta", theta)
        self.machine.require_evaluate(angles)
        a, b, c = (angle - bias for angle, bias in zip(angles, plant.encoder_bias, strict=True))
        machine = plant.of(self.machine)
        machine.require_within_stops((a, b, c))
        machine.require_evaluate((a, b, c))
        start = {
            block.name: np.array([[0.0, 0.0, block.height / 2]]) for block in self.scene.objects
        }
        for name, place in (objects or {}).items():
            start[name] = np.array([vector(name, place)])
        errors = None if noise == (0.0, 0.0, 0.0) else np.array([noise]).T
        self.batch.reset(_ROW, angles, start, [plant], errors)
        return self.read()

    def move(
        self, command: ArrayLike, vacuum: bool = False, noise: Vector = (0.0, 0.0, 0.0)
    ) -> State:
        """See :meth:`Simulation.move`."""
        for mode, left in zip(("assembly", "working"), self.batch.left[:, 0], strict=True):
            if left:
                raise ModeChangeError(mode)
        new = vector("command", command)
        a, b, c = (self.machine.require_inverse(new) - self.batch.bias[:, 0]).tolist()
        self.machine.require_within_stops((a, b, c))
        errors = None if noise == (0.0, 0.0, 0.0) else np.array([noise]).T
        self.batch.move(np.array([new]), np.array([vacuum]), errors)
        return self.read()

    def read(self) -> State:
        """What is known of the robot."""
        state = self.batch.state()
        return State(**{field.name: _only(getattr(state, field.name)) for field in fields(State)})

    def show_goal(self, markers: FloatArray) -> None:
        """See :meth:`Simulation.show_goal`."""
        self._markers = [(x, y, z) for x, y, z in markers.tolist()]

    def save(self) -> Moment:
        """See :meth:`Simulation.save`."""
        return self.batch.save()

    def restore(self, moment: Moment) -> State:
        """See :meth:`Simulation.restore`."""
        self.batch.restore(moment)
        return self.read()

    def render(self, width: int, height: int) -> NDArray[np.uint8]:
        """Draw the scene as (height, width, 3) RGB."""
        if self._artist is None:
            self._artist = make_engine("pybullet", renderer=self._renderer)
            self._artist.load(self.machine, self.scene)
        state = self.read()
        point = self.machine.mount.to_paper(state.platform_position)
        a, b, c = self.machine.require_inverse(point).tolist()
        joints = self.machine.joint_positions((a, b, c))
        poses = zip(state.object_position.tolist(), state.object_quaternion.tolist(), strict=True)
        self._artist.place(joints, [Pose(tuple(at), tuple(turn)) for at, turn in poses])
        self._artist.show_goal(self._markers)
        return self._artist.picture(width, height)

    def close(self) -> None:
        """Close what draws pictures; harmless the second time."""
        if self._artist is not None:
            self._artist.close()
            self._artist = None


def _only(values: Any) -> Any:
    """The one row of an array: an array, or a plain number."""
    row = values[0]
    return row if isinstance(row, np.ndarray) else row.item()
