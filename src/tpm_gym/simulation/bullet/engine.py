"""PyBullet behind the seam of :class:`tpm_gym.simulation.engine.Engine`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import Vector
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.bullet.client import Client
from tpm_gym.simulation.bullet.cup import Cup, Grip
from tpm_gym.simulation.bullet.friction import Friction
from tpm_gym.simulation.bullet.physics import Physics
from tpm_gym.simulation.bullet.robot import Robot
from tpm_gym.simulation.bullet.scenery import Scenery
from tpm_gym.simulation.drives import Memory, Reference, Servo, Servos, follow
from tpm_gym.simulation.engine import Engine, Motors, Pose, Truth, Twist
from tpm_gym.simulation.randomisation import Plant
from tpm_gym.simulation.settings import settings_of
from tpm_gym.simulation.state import Scene
from tpm_gym.simulation.vacuum import Hold

__all__ = ["BulletEngine"]


@dataclass(frozen=True)
class _Moment:
    joints: tuple[tuple[float, float], ...]  # rad and rad/s, passive ones too
    drives: Memory | None
    objects: list[tuple[Pose, Twist]]
    grip: Grip


class BulletEngine:
    """See :class:`~tpm_gym.simulation.engine.Engine`.

    Args:
        gui: Whether to open PyBullet's window.
        renderer: ``"tiny"`` (None too) draws on the CPU anywhere; ``"egl"`` on a GPU, where the
            driver has it.
        physics: A :class:`Physics` or a mapping of its attributes.
        drive: The motors' servo drives; None for ideal ones, of which Bullet's solver finds the
            torques.

    Raises:
        ConfigurationError: If an option is out of range, no window opened, or EGL is not there.
    """

    def __init__(
        self,
        *,
        gui: bool = False,
        renderer: str | None = None,
        physics: Any = None,
        drive: Servo | None = None,
    ) -> None:
        """Connect."""
        self.physics = settings_of(Physics, "physics", physics)
        self.substeps = self.physics.substeps
        self._gui, self._renderer, self._servo = gui, renderer, drive
        self._servos: Servos | None = None
        self.client = Client(self.physics, gui, renderer)
        self._loaded = False

    def load(self, machine: Machine, scene: Scene) -> None:
        """See the protocol."""
        if self._loaded:
            self._empty()
        self._loaded = True
        self.robot = Robot(self.client, machine.mechanism, machine.mount)
        if self._servo is not None:
            self._servos = Servos(self._servo, machine, self.physics.time_step)
        self._scenery = Scenery(self.client, scene, machine.table)
        if self._gui:
            self._scenery.aim_window()
        if self._gui or self._renderer == "egl":
            self.robot.paint()
        self.bodies = self._scenery.bodies
        self._cup = Cup(self.client, self.robot, self.bodies, scene.objects, self.physics.time_step)
        self._friction = Friction(
            self.client, self.robot, self.bodies, self._scenery.tables, scene.objects
        )

    def _empty(self) -> None:
        """Take everything out of the client; a window stays, else a new client leaks least."""
        if self._gui:
            self.client.resetSimulation()
            self.client.configure(self.physics)
        else:
            self.client.close()
            self.client = Client(self.physics, renderer=self._renderer)

    def alter(self, plant: Plant) -> None:
        """See the protocol."""
        self.robot.alter(plant.link_masses, plant.motor_strength)
        if self._servos is not None:
            self._servos.alter(plant)
            self.robot.rub(plant.joint_friction)
        self._scenery.alter(plant.puck_mass, plant.friction)
        self._friction.alter(plant.friction)

    def place(self, joints: Mapping[str, float], objects: Sequence[Pose]) -> None:
        """See the protocol."""
        self._cup.take(Grip())
        self.robot.place(joints)
        if self._servos is not None:
            self._servos.rest(self.robot.motors().theta)
        self._scenery.place([(pose, Twist()) for pose in objects])
        self._friction.reset()

    def show_goal(self, markers: Sequence[Vector]) -> None:
        """See the protocol."""
        self._scenery.move_markers(markers)

    def advance(self, references: Sequence[Reference], vacuum: bool) -> None:
        """See the protocol."""
        cup, friction, step = self._cup, self._friction, self.client.stepSimulation
        near = cup.look(len(references))
        turns, sucks = friction.look(near, cup.first), cup.wakes(vacuum)
        if self._servos is not None and references:
            self._servos.begin(references[0].theta)
        robot, servos = self.robot, self._servos
        for index, reference in enumerate(references):
            if index >= turns:
                friction.turn(cup.grip.hold.which)
            follow(robot, servos, reference)
            step()
            if index >= sucks:
                cup.suck(vacuum)

    def motors(self) -> Motors:
        """See the protocol."""
        motors = self.robot.motors()
        # The engine reports what its own motors apply, here friction.
        return (
            motors if self._servos is None else motors._replace(torque=self._servos.memory.torque)
        )

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
        return _Moment(
            self.robot.joint_states(),
            None if self._servos is None else self._servos.memory,
            self.objects(),
            self._cup.grip,
        )

    def restore(self, snapshot: Any) -> None:
        """See the protocol."""
        self._cup.take(Grip())
        self.robot.set_joint_states(snapshot.joints)
        if self._servos is not None:
            self._servos.memory = snapshot.drives
        self._scenery.place(snapshot.objects)
        self._friction.reset()
        self._cup.take(snapshot.grip)

    def picture(self, width: int, height: int) -> NDArray[np.uint8]:
        """See the protocol."""
        return self._scenery.picture(width, height, self.client.renderer)

    def close(self) -> None:
        """See the protocol."""
        self.client.close()


_: type[Engine] = BulletEngine  # so that mypy compares them
