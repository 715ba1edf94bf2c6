"""The robot inside a physics client: tree, loop closures, motors, encoders, and the truth.

The client is handed in (see :mod:`tpm_gym.simulation`), so this module does not import the engine.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tpm_gym import urdf
from tpm_gym.mechanism import ACTUATED_JOINTS, MOTOR_EFFORT, Mechanism, Mount
from tpm_gym.physics import MOTOR_GAIN, rotations

__all__ = ["Robot"]

FloatArray = NDArray[np.float64]


class Robot:
    """The mechanism as one multibody with closed loops.

    Args:
        client: The physics client.
        mechanism: What to load.
        mount: Where the base hangs.
    """

    def __init__(self, client: Any, mechanism: Mechanism, mount: Mount) -> None:
        """Load the tree, take out what the engine adds on its own, close the loops."""
        self._client, self._mechanism = client, mechanism
        with tempfile.TemporaryDirectory() as folder:
            path, _ = urdf.write(Path(folder), mechanism)
            self.body: int = client.loadURDF(
                str(path),
                basePosition=mount.to_world((0.0, 0.0, 0.0)).tolist(),
                baseOrientation=mount.quaternion,
                useFixedBase=True,
                flags=client.URDF_USE_INERTIA_FROM_FILE,
            )
        self._joints: dict[str, int] = {}
        self._links: dict[str, int] = {}
        for index in range(client.getNumJoints(self.body)):
            info = client.getJointInfo(self.body, index)
            self._joints[info[1].decode()] = index
            self._links[info[12].decode()] = index
            # PyBullet adds damping to everything and a motor to every joint; we want neither.
            client.changeDynamics(
                self.body, index, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0
            )
            client.setJointMotorControl2(self.body, index, client.VELOCITY_CONTROL, force=0.0)
        self._motors = [self._joints[name] for name in ACTUATED_JOINTS]
        self.platform = self._links[mechanism.platform]
        self._close_loops()

    def _close_loops(self) -> None:
        """Close the loops; the engine wants pivots relative to the centres of mass."""
        names: list[str] = []
        ends: list[tuple[int, tuple[float, float, float]]] = []
        for closure in self._mechanism.closures:
            pivots = []
            sides = ((closure.link_a, closure.point_a), (closure.link_b, closure.point_b))
            for name, point in sides:
                pivots.append(np.asarray(point) - self._mechanism.link(name).centre_of_mass)
                if name not in names:
                    names.append(name)
                ends.append((names.index(name), point))
            constraint = self._client.createConstraint(
                self.body,
                self._links[closure.link_a],
                self.body,
                self._links[closure.link_b],
                self._client.JOINT_POINT2POINT,
                (0.0, 0.0, 0.0),
                pivots[0].tolist(),
                pivots[1].tolist(),
            )
            self._client.changeConstraint(constraint, maxForce=1e6)
        names.append(self._mechanism.platform)
        ends.append((len(names) - 1, self._mechanism.point_p))
        self._watched = [self._links[name] for name in names]
        self._end_link = np.array([index for index, _ in ends])
        self._end_point = np.array([point for _, point in ends])

    def paint(self) -> None:
        """Give each link the colour of its largest solid.

        The engine's OpenGL pictures know one colour a link and take that of the last solid; the
        software renderer needs no help.
        """
        for link in self._mechanism.links:
            largest = max(link.solids, key=lambda solid: float(np.prod(np.abs(solid.size[:2]))))
            self._client.changeVisualShape(
                self.body, self._links.get(link.name, -1), rgbaColor=urdf.COLOURS[largest.colour]
            )

    def place(self, angles: Mapping[str, float]) -> None:
        """Put every joint at its angle (rad), at rest."""
        for name, angle in angles.items():
            self._client.resetJointState(self.body, self._joints[name], angle, 0.0)

    def drive(self, theta: list[float]) -> None:
        """Let the motors go to ``theta`` (3) rad within the next time step, effort permitting."""
        self._client.setJointMotorControlArray(
            self.body,
            self._motors,
            self._client.POSITION_CONTROL,
            targetPositions=theta,
            forces=(MOTOR_EFFORT,) * 3,
            positionGains=(MOTOR_GAIN,) * 3,
        )

    def encoders(self) -> tuple[FloatArray, FloatArray]:
        """Angles (3,) rad and rates (3,) rad/s of the motors."""
        states = self._client.getJointStates(self.body, self._motors)
        return np.array([state[0] for state in states]), np.array([state[1] for state in states])

    def joint_states(self) -> tuple[tuple[float, float], ...]:
        """Angle and rate of every joint, passive ones too."""
        states = self._client.getJointStates(self.body, range(len(self._joints)))
        return tuple((state[0], state[1]) for state in states)

    def set_joint_states(self, states: tuple[tuple[float, float], ...]) -> None:
        """Put every joint at an angle and rate that :meth:`joint_states` gave."""
        for index, (angle, rate) in enumerate(states):
            self._client.resetJointState(self.body, index, angle, rate)

    def truth(self) -> tuple[float, FloatArray, float]:
        """Largest loop gap (m), platform position (m, world) and platform tilt (rad)."""
        states = self._client.getLinkStates(self.body, self._watched, computeForwardKinematics=True)
        origins = np.array([state[4] for state in states])
        turns = rotations(np.array([state[5] for state in states]))
        points = origins[self._end_link] + np.einsum(
            "nij,nj->ni", turns[self._end_link], self._end_point
        )
        gaps = points[0:-1:2] - points[1:-1:2]
        # The platform should stand as the base does: a half turn about x.
        trace = float(turns[-1, 0, 0] - turns[-1, 1, 1] - turns[-1, 2, 2])
        tilt = float(np.arccos(np.clip((trace - 1) / 2, -1.0, 1.0)))
        return float(np.sqrt((gaps**2).sum(axis=1).max())), points[-1], tilt

    def cup(self) -> tuple[FloatArray, FloatArray]:
        """Centre of the cup's lip (m) and the cup's outward axis, world."""
        state = self._client.getLinkState(self.body, self.platform, computeForwardKinematics=True)
        turn = rotations(np.array([state[5]]))[0]
        return np.array(state[4]) + turn @ np.array(self._mechanism.cup), turn[:, 2]
