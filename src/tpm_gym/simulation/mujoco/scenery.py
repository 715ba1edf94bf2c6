"""Objects and goal markers in MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from tpm_gym.arrays import FloatArray, Vector, rotate
from tpm_gym.simulation.engine import Pose, Twist
from tpm_gym.simulation.mujoco.model import marker_name, object_name
from tpm_gym.simulation.state import Scene

__all__ = ["Scenery"]

_STILL = 1e-4  # m/s and rad/s
_LOOKS = 5  # iterations at most
_ALIKE = 1e-3  # m/s


class Scenery:
    """Everything in the model that moves and is not the robot.

    Args:
        model: The model.
        data: Its state.
        scene: The scene of the model.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, scene: Scene) -> None:
        """Look up the addresses of everything."""
        self._model, self._data, self._blocks = model, data, scene.objects
        self._position, self._speed = data.qpos.item, data.qvel.item
        self._resting = 4 * len(scene.objects)  # contacts of objects that lie flat
        names = [object_name(index) for index in range(len(scene.objects))]
        joints = [model.joint(name) for name in names]
        self._at = [joint.qposadr.item() for joint in joints]
        self._dof = [joint.dofadr.item() for joint in joints]
        self._bodies = [model.body(name).id for name in names]
        geoms = [model.geom(name).id for name in names]
        self._touching = [
            np.flatnonzero((model.pair_geom1 == geom) | (model.pair_geom2 == geom))
            for geom in geoms
        ]
        self._friction = model.pair_friction.copy()
        self._markers = [model.site(marker_name(index)).id for index in range(scene.markers)]

    def keep_sliding(self) -> None:
        """Keep sliding objects from hopping; call between the two halves of a time step.

        MuJoCo's contacts are convex: it drives two bodies that slide along each other apart, at the
        coefficient of friction times the speed of the slip. The wanted acceleration along the
        normal is lowered by as much.
        """
        data = self._data
        if not data.ncon or (data.ncon <= self._resting and not self._moves()):
            return
        wanted = data.efc_aref[self._rows()][::3]
        before = wanted.copy()
        slip = self._slip(data.efc_vel)
        wanted -= self._hop(slip)
        if not (self._model.geom_bodyid[data.contact.geom] > 0).all(axis=1).any():
            return
        for _ in range(_LOOKS):  # An object that is struck slides only at the end of the time step.
            slip, known = self._slip(self._velocity_to_come()), slip
            if np.abs(slip - known).max() < _ALIKE:
                break
            wanted[:] = before - self._hop(slip)

    def _rows(self) -> slice:
        """Return the rows of the contacts among the constraints: three each, at the end."""
        return slice(self._data.nefc - 3 * self._data.ncon, None)

    def _slip(self, velocity: FloatArray) -> FloatArray:
        """Return the speed of each contact's slip, m/s."""
        _, x, y = velocity[self._rows()].reshape(-1, 3).T
        speed: FloatArray = np.hypot(x, y)
        return speed

    def _hop(self, slip: FloatArray) -> FloatArray:
        """Return the acceleration with which MuJoCo drives sliding bodies apart, m/s^2."""
        hop: FloatArray = self._data.contact.friction[:, 0] * slip / self._model.opt.timestep
        return hop

    def _velocity_to_come(self) -> FloatArray:
        """Predict the velocities of the constraints after this time step."""
        model, data = self._model, self._data
        mujoco.mj_fwdActuation(model, data)
        mujoco.mj_fwdAcceleration(model, data)
        mujoco.mj_fwdConstraint(model, data)
        after = np.empty(data.nefc)
        mujoco.mj_mulJacVec(model, data, after, data.qvel + model.opt.timestep * data.qacc)
        return after

    def _moves(self) -> bool:
        """Return whether an object slides or spins faster than solver noise."""
        speed = self._speed
        return any(
            abs(speed(dof)) + abs(speed(dof + 1)) + abs(speed(dof + 2)) + abs(speed(dof + 5))
            > _STILL
            for dof in self._dof
        )

    def move_markers(self, positions: Sequence[Vector]) -> None:
        """Show the goal at these points, m, world."""
        for marker, position in zip(self._markers, positions, strict=True):
            self._model.site_pos[marker] = self._data.site_xpos[marker] = position

    def place(self, poses: Sequence[Pose]) -> None:
        """Put the objects down."""
        for at, (position, (x, y, z, w)) in zip(self._at, poses, strict=True):
            self._data.qpos[at : at + 7] = (*position, w, x, y, z)

    def read(self) -> list[tuple[Pose, Twist]]:
        """Return poses and velocities of the objects."""
        return [(self.pose(index), self._twist(index, dof)) for index, dof in enumerate(self._dof)]

    def height(self, index: int) -> float:
        """Return the height of an object's centre above the table, m."""
        height: float = self._position(self._at[index] + 2)
        return height

    def pose(self, index: int) -> Pose:
        """Return the pose of an object."""
        at = self._at[index]
        x, y, z, qw, qx, qy, qz = self._data.qpos[at : at + 7].tolist()
        return Pose((x, y, z), (qx, qy, qz, qw))

    def _twist(self, index: int, dof: int) -> Twist:
        """Return the velocities of an object; MuJoCo has its spin in the object's frame."""
        u, v, w, a, b, c = self._data.qvel[dof : dof + 6].tolist()
        return Twist((u, v, w), rotate(self.pose(index).quaternion, (a, b, c)))

    def alter(self, mass: float, friction: float) -> None:
        """Make the objects ``mass`` times as heavy and ``friction`` times as rough as nominal."""
        model = self._model
        model.pair_friction[:] = self._friction
        for body, nominal, pairs in zip(self._bodies, self._blocks, self._touching, strict=True):
            block = replace(nominal, mass=mass * nominal.mass)
            model.body_mass[body], model.body_inertia[body] = block.mass, block.inertia
            model.pair_friction[pairs] *= friction
