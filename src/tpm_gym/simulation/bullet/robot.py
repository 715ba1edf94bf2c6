"""The robot in PyBullet: legs, loop closures, motors, encoders and true positions.

Each leg of the spanning tree is loaded as a separate multibody, so that every loop closure joins
two multibodies. With a closure inside one multibody, Bullet's direct solvers compute wrong forces
and the loop opens at once. With closures between multibodies, the forces are exact
(docs/loops.md). The Jacobian of each constraint is also smaller, because it has only the joints of
the legs on which the constraint acts.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import numpy as np
import pybullet
from numpy.typing import NDArray

from tpm_gym.arrays import Vector, rotate
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism import urdf
from tpm_gym.mechanism.bodies import Mechanism
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.mount import Mount
from tpm_gym.simulation.bullet.client import Client
from tpm_gym.simulation.bullet.physics import MOTOR_GAIN
from tpm_gym.simulation.engine import SPRING_GAIN, loops, transform

Address = tuple[int, int]
"""Body id in the client, and index of a link (PyBullet gives a joint the index of its child)."""

_CLOSURE_FORCE = 1e6  # N; so large that no load opens a loop


# The text is kept, because writing it takes a quarter of the time of loading a robot.
_urdf_text = lru_cache(maxsize=16)(urdf.urdf_text)


class Robot:
    """Robot that consists of one multibody for each leg; constraints close its loops.

    Attributes:
        bodies: Body ids of the legs.
        joints: Address of each joint, by name.
        links: Address of each link except the base, by name.
        tool: Address of the link with the vacuum cup.
    """

    def __init__(self, client: Client, mechanism: Mechanism, mount: Mount) -> None:
        """Load the legs, remove PyBullet's default damping and motors, and close the loops."""
        self._truth = loops().truth
        self._client, self._mechanism = client, mechanism
        self.joints: dict[str, Address] = {}
        self.links: dict[str, Address] = {}
        self.bodies = [self._load(leg, mount) for leg in mechanism.legs()]
        self._motors = [self.joints[name] for name in mechanism.actuated]
        self._inertias = {link: self._inertia(link) for link in self.links.values()}
        self._nominal_effort = [motor.effort for motor in mechanism.motors]
        self._effort = self._nominal_effort
        slide = mechanism.link(mechanism.tool).joint
        assert slide is not None
        self.tool = self.links[mechanism.tool]
        client.changeDynamics(*self.tool, lateralFriction=CUP.friction)
        spring = {"targetPosition": 0.0, "force": slide.effort, "positionGain": SPRING_GAIN}
        client.setJointMotorControl2(*self.tool, client.POSITION_CONTROL, **spring)
        self._close_loops()

    def _load(self, leg: Mechanism, mount: Mount) -> int:
        client = self._client
        with _on_disk(_urdf_text(leg)) as path:
            body: int = client.loadURDF(
                path,
                basePosition=mount.to_world((0.0, 0.0, 0.0)).tolist(),
                baseOrientation=mount.quaternion,
                useFixedBase=True,
                flags=client.URDF_USE_INERTIA_FROM_FILE | client.URDF_USE_IMPLICIT_CYLINDER,
            )
        for index in range(client.getNumJoints(body)):
            info = client.getJointInfo(body, index)
            self.joints[info[1].decode()] = self.links[info[12].decode()] = (body, index)
            # PyBullet adds damping to every link and a motor to every joint. Both are removed.
            client.changeDynamics(
                body, index, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0
            )
            client.setJointMotorControl2(body, index, client.VELOCITY_CONTROL, force=0.0)
        return body

    def _inertia(self, link: Address) -> tuple[float, Vector]:
        """Return mass (kg) and principal moments of inertia (kg m^2) of a link."""
        info = self._client.getDynamicsInfo(*link)
        return info[0], info[2]

    def _close_loops(self) -> None:
        """Create the loop closures. PyBullet requires pivots relative to the centres of mass."""
        client = self._client
        watched = {self.links[self._mechanism.platform]}
        for closure in self._mechanism.closures:
            sides = ((closure.link_a, closure.point_a), (closure.link_b, closure.point_b))
            link_a, link_b = (self.links[name] for name, _ in sides)
            pivots = [self._pivot(name, point) for name, point in sides]
            ends = (*link_a, *link_b, client.JOINT_POINT2POINT, (0.0, 0.0, 0.0))
            constraint = client.createConstraint(*ends, *(pivot.tolist() for pivot in pivots))
            client.changeConstraint(constraint, maxForce=_CLOSURE_FORCE)
            watched |= {link_a, link_b}
        # One call of getLinkStates per leg is cheaper than one call per link.
        order = sorted(watched)
        self._watched = {body: [link for of, link in order if of == body] for body, _ in order}
        at = {name: order.index(link) for name, link in self.links.items() if link in watched}
        self._platform = at[self._mechanism.platform]
        closures = self._mechanism.closures
        self._sides = np.array([(at[c.link_a], at[c.link_b]) for c in closures]).reshape(-1, 2)
        self._point_p = np.array(self._mechanism.point_p)
        self._pivots = np.array([(c.point_a, c.point_b) for c in closures]).reshape(-1, 2, 3)

    def _pivot(self, name: str, point: Vector) -> NDArray[np.float64]:
        """Convert a point of a link's frame to a point relative to the link's centre of mass, m."""
        link = self._mechanism.link(name)
        # With products of inertia, PyBullet would rotate the inertial frame to the principal axes,
        # and the closure would be at a wrong point.
        if not np.allclose(link.inertia, np.diag(np.diag(link.inertia)), rtol=0.0, atol=1e-12):
            valid = "links whose principal axes of inertia are the axes of their frame"
            raise ConfigurationError("mechanism", name, valid)
        return np.asarray(point) - link.centre_of_mass

    def paint(self) -> None:
        """Set the colour of each link to the colour of its largest solid.

        PyBullet's OpenGL renderer draws a whole link in the colour of its last solid. The software
        renderer draws each solid in its own colour, and does not need this method.
        """
        base = [(body, -1) for body in self.bodies]
        for link in self._mechanism.links:
            largest = max(link.solids, key=lambda solid: float(np.prod(np.abs(solid.size[:2]))))
            for place in base if link.joint is None else [self.links[link.name]]:
                self._client.changeVisualShape(*place, rgbaColor=urdf.COLOURS[largest.colour])

    def place(self, angles: Mapping[str, float]) -> None:
        """Set joint positions (rad), by joint name, and set the joint velocities to zero."""
        for name, angle in angles.items():
            self._client.resetJointState(*self.joints[name], angle, 0.0)

    def alter(self, mass_factors: Sequence[float], motor_strength: Sequence[float]) -> None:
        """Scale the nominal masses of the moving links, and the motors' largest torques.

        If ``mass_factors`` is empty, all masses are nominal.
        """
        factors = mass_factors or [1.0] * len(self._inertias)
        for (link, (mass, moments)), factor in zip(self._inertias.items(), factors, strict=True):
            inertia = [factor * moment for moment in moments]
            self._client.changeDynamics(*link, mass=factor * mass, localInertiaDiagonal=inertia)
        pairs = zip(self._nominal_effort, motor_strength, strict=True)
        self._effort = [effort * strength for effort, strength in pairs]

    def drive(self, theta: Vector) -> None:
        """Set the joint positions (rad) that ideal motors reach in the next time step."""
        # Arguments: target position and velocity, largest torque, gains, velocity limit (none) and
        # client. Keywords would cost 50% more time, and a loop the time of one call.
        turn, mode = pybullet.setJointMotorControl2, pybullet.POSITION_CONTROL
        number = self._client.number
        (one, i), (two, j), (three, k) = self._motors
        (a, b, c), (x, y, z) = theta, self._effort
        turn(one, i, mode, a, 0.0, x, MOTOR_GAIN, 1.0, -1.0, number)
        turn(two, j, mode, b, 0.0, y, MOTOR_GAIN, 1.0, -1.0, number)
        turn(three, k, mode, c, 0.0, z, MOTOR_GAIN, 1.0, -1.0, number)

    def apply(self, torque: Vector) -> None:
        """Set the torques (N m) that the motors apply in the next time step."""
        turn, mode = pybullet.setJointMotorControl2, pybullet.TORQUE_CONTROL
        number = self._client.number
        for (body, joint), one in zip(self._motors, torque, strict=True):
            turn(body, joint, mode, 0.0, 0.0, one, 0.0, 0.0, -1.0, number)

    def set_friction(self, friction: Vector) -> None:
        """Set the Coulomb friction of the motors' axes, N m."""
        turn, mode = self._client.setJointMotorControl2, pybullet.VELOCITY_CONTROL
        for motor, one in zip(self._motors, friction, strict=True):
            turn(*motor, mode, targetVelocity=0.0, force=one)

    def motors(self) -> tuple[Vector, Vector, Vector]:
        """Return joint positions (rad), velocities (rad/s) and the last torques (N m)."""
        state, number = pybullet.getJointState, self._client.number
        (one, i), (two, j), (three, k) = self._motors
        a, b, c = state(one, i, number), state(two, j, number), state(three, k, number)
        return (a[0], b[0], c[0]), (a[1], b[1], c[1]), (a[3], b[3], c[3])

    def joint_states(self) -> tuple[tuple[float, float], ...]:
        """Return position and velocity of every joint, including passive joints."""
        states = (self._client.getJointState(*joint) for joint in self.joints.values())
        return tuple((state[0], state[1]) for state in states)

    def set_joint_states(self, states: tuple[tuple[float, float], ...]) -> None:
        """Restore positions and velocities from :meth:`joint_states`."""
        for joint, (angle, rate) in zip(self.joints.values(), states, strict=True):
            self._client.resetJointState(*joint, angle, rate)

    def truth(self) -> tuple[float, Vector, float]:
        """Compute the largest loop gap (m), point P (m, world) and the platform's tilt (rad)."""
        number = self._client.number
        frames: list[float] = []
        for body, links in self._watched.items():
            for state in pybullet.getLinkStates(body, links, 0, 1, number):
                frames += state[4] + state[5]
        arguments = self._sides, self._pivots, self._platform, self._point_p
        found: tuple[float, Vector, float] = self._truth(np.array(frames), *arguments)
        return found

    def lip(self) -> Vector:
        """Return the centre of the cup's lip (m, world)."""
        state = pybullet.getLinkState(*self.tool, 0, 1, self._client.number)
        return transform(state[4], state[5], self._mechanism.lip)

    def cup_axis(self) -> Vector:
        """Return the outward axis of the cup (unit vector, world)."""
        state = pybullet.getLinkState(*self.tool, 0, 1, self._client.number)
        return rotate(state[5], (0.0, 0.0, 1.0))


@contextmanager
def _on_disk(text: str) -> Iterator[str]:
    """Write a temporary file and yield its path. PyBullet loads robots only from files."""
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "robot.urdf")
            path.write_text(text, encoding="utf-8")
            yield str(path)
    except OSError as error:
        valid = f"a folder that can be written to, for the engine's robot file ({error})"
        raise ConfigurationError("TMPDIR", os.environ.get("TMPDIR"), valid) from error
