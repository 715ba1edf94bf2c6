"""Engine that simulates one robot with PyBullet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pybullet
from numpy.typing import NDArray

from tpm_gym.arrays import BoolArray, FloatArray, IntArray, Vector
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.bullet.client import Client
from tpm_gym.simulation.bullet.cup import Cup
from tpm_gym.simulation.bullet.friction import Friction
from tpm_gym.simulation.bullet.physics import Physics
from tpm_gym.simulation.bullet.robot import Robot
from tpm_gym.simulation.bullet.scenery import Scenery
from tpm_gym.simulation.bullet.window import Window
from tpm_gym.simulation.drives import Servo, ServoDrives
from tpm_gym.simulation.engine import (
    Engine,
    Grip,
    Path,
    Pose,
    Readout,
    Twist,
    drives_of_one,
    steering,
)
from tpm_gym.simulation.imaging import Camera, Picture, View
from tpm_gym.simulation.randomisation import NOMINAL, Plant
from tpm_gym.simulation.settings import settings_of
from tpm_gym.simulation.state import Scene

_ZERO: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class _Saved:
    joints: tuple[tuple[float, float], ...]  # rad and rad/s, including passive joints
    torque: Vector
    drives: NDArray[Any] | None
    objects: list[tuple[Pose, Twist]]
    grip: Grip


class BulletEngine:
    """Engine that simulates one robot with PyBullet.

    Args:
        gui: Whether to open PyBullet's window.
        renderer: ``"tiny"`` or None draws on the CPU; ``"egl"`` draws on a GPU.
        physics: A :class:`Physics` or a mapping of its attributes.
        drive: Servo drives of the motors; None for ideal drives, which Bullet's solver computes.

    Raises:
        ConfigurationError: If an option is out of range, or window or renderer cannot open.
    """

    def __init__(
        self,
        *,
        gui: bool = False,
        renderer: str | None = None,
        physics: Any = None,
        drive: Servo | None = None,
    ) -> None:
        """Check the options and create the physics client."""
        self.physics = settings_of(Physics, "physics", physics)
        self.time_step = self.physics.time_step
        self._renderer, self._servo = renderer, drive
        self._drives: ServoDrives | None = None
        # Torques that read() returns, N m; None for the torques that Bullet reports. Bullet reports
        # zero after a restore, and the joint friction with servo drives.
        self._torque: Vector | None = _ZERO
        # Snapshot that was restored last; None as soon as the robot moves. save() returns it again,
        # because Bullet normalises quaternions, so that reading them could give other bits.
        self._restored: _Saved | None = None
        self.client = Client(self.physics, renderer=renderer)
        self._window: Window | None = None
        if gui:
            try:
                self._window = Window(self.physics)
            except BaseException:
                self.close()
                raise

    def load(self, machine: Machine, scene: Scene, count: int) -> None:
        """Implement :meth:`Engine.load`."""
        self._drives = drives_of_one(self._servo, machine, count, self.time_step)
        self._nominal, self._scene, self._plant = machine, scene, NOMINAL
        self._load(machine)

    def _load(self, machine: Machine) -> None:
        """Load robot and scene into an empty client."""
        self._machine = machine
        self.robot = Robot(self.client, machine.mechanism, machine.mount)
        scene = self._scene
        self._scenery = Scenery(self.client, scene, machine.table)
        if self._renderer == "egl":
            self.robot.paint()
        if self._window is not None:
            self._window.load(machine, scene)
        self.bodies = self._scenery.bodies
        self._cup = Cup(self.client, self.robot, self.bodies, scene.objects, self.time_step)
        tables, belts = self._scenery.tables, self._scenery.belts
        self._friction = Friction(
            self.client, self.robot, self.bodies, tables, belts, scene.objects, self.time_step
        )

    def alter(self, rows: IntArray, plants: Sequence[Plant]) -> None:
        """Implement :meth:`Engine.alter`."""
        (plant,) = plants
        if plant.length_errors != self._plant.length_errors:
            self.client.close()
            self.client = Client(self.physics, renderer=self._renderer)  # a reset leaks more
            self._load(plant.of(self._nominal))
        self._plant = plant
        self.robot.alter(plant.link_masses, plant.motor_strength)
        if self._drives is not None:
            self._drives.alter(rows, plants)
            self.robot.set_friction(plant.joint_friction)
        self._scenery.alter(plant.block_mass, plant.friction)
        self._friction.alter(plant.friction)

    def place(self, rows: IntArray, theta: FloatArray, objects: FloatArray) -> None:
        """Implement :meth:`Engine.place`."""
        self._restored = None
        self._cup.take(Grip())
        self.robot.place(self._machine.joint_positions(theta[0]))
        if self._drives is not None:
            self._drives.rest(rows, theta)
        self._scenery.place([(Pose.of(row), Twist()) for row in objects[0].tolist()])
        self._friction.reset()
        self._torque = _ZERO

    def set_belt(self, rows: IntArray, speed: FloatArray) -> None:
        """Implement :meth:`Engine.set_belt`."""
        self._scenery.belt_speed = float(speed[0])
        self._friction.set_belt(float(speed[0]))
        if not speed[0]:
            self._scenery.run_belts()  # stop them here: advance() skips belts at rest

    def advance(self, path: Path, vacuum: BoolArray) -> None:
        """Implement :meth:`Engine.advance`."""
        self._restored = None
        cup, friction, step, on = self._cup, self._friction, self.client.stepSimulation, vacuum[0]
        targets, drive = steering(self._drives, path, self.robot)
        near = cup.find_near(len(targets), on)
        scenery, running = self._scenery, self._scenery.belt_speed != 0
        first_scaled, first_update = friction.prepare(near, cup.first), cup.first_update
        for index, target in enumerate(targets):
            if index >= first_scaled:
                friction.scale(cup.grip.hold.which)
            drive(target)
            if running:
                scenery.run_belts()
            step()
            if index >= first_update:
                cup.update(on)
        if self._drives is None:
            self._torque = None
        else:
            a, b, c = self._drives.memory[0, 0].tolist()
            self._torque = a, b, c

    def read(self) -> Readout:
        """Implement :meth:`Engine.read`."""
        theta, rates, torque = self.robot.motors()
        motors, hold = (theta, rates, self._torque or torque), self._cup.grip.hold
        return Readout.of_one(self._machine, motors, self.robot.truth(), hold, self._objects())

    def _objects(self) -> list[tuple[Pose, Twist]]:
        pose, twist = pybullet.getBasePositionAndOrientation, pybullet.getBaseVelocity
        numbers = [self.client.number] * len(self.bodies)
        poses, twists = map(pose, self.bodies, numbers), map(twist, self.bodies, numbers)
        return list(zip(poses, twists, strict=True))

    def show(self, camera: Camera, markers: FloatArray) -> None:
        """Implement :meth:`Engine.show`."""
        if self._window is not None:
            joints, poses = self.robot.joint_states(), [pose for pose, _ in self._objects()]
            self._window.show([angle for angle, _ in joints], poses, camera, markers)

    def save(self) -> Any:
        """Implement :meth:`Engine.save`."""
        if self._restored is not None:
            return self._restored
        return _Saved(
            self.robot.joint_states(),
            self._torque or self.robot.motors()[2],
            None if self._drives is None else self._drives.memory.copy(),
            self._objects(),
            self._cup.grip,
        )

    def restore(self, saved: Any) -> None:
        """Implement :meth:`Engine.restore`."""
        self._cup.take(Grip())
        self.robot.set_joint_states(saved.joints)
        self._torque = saved.torque
        if self._drives is not None:
            self._drives.memory[:] = saved.drives
        self._scenery.place(saved.objects)
        self._friction.reset()
        self._cup.take(saved.grip)
        self._restored = saved

    def picture(self, row: int, view: View) -> Picture:
        """Implement :meth:`Engine.picture`."""
        return self._scenery.picture(view, self.robot.tool)

    def close(self) -> None:
        """Implement :meth:`Engine.close`."""
        self.client.close()
        if self._window is not None:
            self._window.close()


_: type[Engine] = BulletEngine  # mypy checks that the class has the methods of Engine
