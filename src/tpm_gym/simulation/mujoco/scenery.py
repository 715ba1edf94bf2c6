"""Objects in MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from tpm_gym.arrays import FloatArray, rotate
from tpm_gym.simulation.engine import Pose, Twist
from tpm_gym.simulation.mujoco.model import object_name
from tpm_gym.simulation.state import Scene

_STILL = 1e-4  # m/s + rad/s; slower objects are at rest
_ITERATIONS = 5  # largest number of predictions of the slip
_CONVERGED = 1e-3  # m/s; largest change of the slip in the last prediction


class Scenery:
    """Objects of a MuJoCo model."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, scene: Scene) -> None:
        """Look up the addresses of the objects in the model."""
        self._model, self._data, self._blocks = model, data, scene.objects
        self._position, self._speed = data.qpos.item, data.qvel.item
        self._resting = 4 * len(scene.objects)  # number of contacts if all objects lie flat
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
        self._belt_speed = 0.0

    def keep_sliding(self) -> None:
        """Prevent sliding objects from hopping; call between the two halves of a time step.

        MuJoCo's contact model is convex. So two sliding bodies move apart along the normal; their
        speed along the normal is the friction coefficient times the slip speed. This method
        subtracts the corresponding acceleration from the reference acceleration along the normal.
        """
        data = self._data
        if not data.ncon:
            return
        if data.ncon <= self._resting and not (self._belt_speed or self._moves()):
            return
        wanted = data.efc_aref[self._rows()][::3]
        before = wanted.copy()
        slip = self._slip(data.efc_vel)
        wanted -= self._hop(slip)
        if not (self._model.geom_bodyid[data.contact.geom] > 0).all(axis=1).any():
            return
        # A collision changes the slip within the time step, so the slip at its end is predicted.
        for _ in range(_ITERATIONS):
            slip, known = self._slip(self._predicted_velocity()), slip
            if np.abs(slip - known).max() < _CONVERGED:
                break
            wanted[:] = before - self._hop(slip)

    def _rows(self) -> slice:
        """Return the slice of MuJoCo's ``efc_*`` arrays for contacts, three entries per contact."""
        return slice(self._data.nefc - 3 * self._data.ncon, None)

    def _slip(self, velocity: FloatArray) -> FloatArray:
        """Return the slip speed of each contact, m/s."""
        _, x, y = velocity[self._rows()].reshape(-1, 3).T
        speed: FloatArray = np.hypot(x, y)
        return speed

    def _hop(self, slip: FloatArray) -> FloatArray:
        """Return the acceleration with which MuJoCo separates sliding bodies, m/s^2."""
        hop: FloatArray = self._data.contact.friction[:, 0] * slip / self._model.opt.timestep
        return hop

    def _predicted_velocity(self) -> FloatArray:
        """Predict the velocity along each constraint (``efc_vel``) after this time step."""
        model, data = self._model, self._data
        mujoco.mj_fwdActuation(model, data)
        mujoco.mj_fwdAcceleration(model, data)
        mujoco.mj_fwdConstraint(model, data)
        after = np.empty(data.nefc)
        mujoco.mj_mulJacVec(model, data, after, data.qvel + model.opt.timestep * data.qacc)
        if self._belt_speed:  # efc_vel is relative to the belt's surface
            before = np.empty(data.nefc)
            mujoco.mj_mulJacVec(model, data, before, data.qvel)
            after += data.efc_vel - before
        return after

    def _moves(self) -> bool:
        """Return whether an object moves, or spins about its z axis, faster than solver noise."""
        speed = self._speed
        return any(
            abs(speed(dof)) + abs(speed(dof + 1)) + abs(speed(dof + 2)) + abs(speed(dof + 5))
            > _STILL
            for dof in self._dof
        )

    def set_belt(self, speed: float) -> None:
        """Set the velocity of the belt's surface along x, m/s."""
        self._belt_speed = speed
        self._model.geom_surfacevel[self._model.geom("belt").id, 0] = speed

    def place(self, poses: Sequence[Pose]) -> None:
        """Set the poses of the objects."""
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
        """Return the velocities of an object, world frame."""
        # MuJoCo stores the angular velocity in the object's frame.
        u, v, w, a, b, c = self._data.qvel[dof : dof + 6].tolist()
        return Twist((u, v, w), rotate(self.pose(index).quaternion, (a, b, c)))

    def alter(self, mass: float, friction: float) -> None:
        """Scale the nominal masses and friction coefficients of the objects by these factors."""
        model = self._model
        model.pair_friction[:] = self._friction
        for body, nominal, pairs in zip(self._bodies, self._blocks, self._touching, strict=True):
            block = replace(nominal, mass=mass * nominal.mass)
            model.body_mass[body], model.body_inertia[body] = block.mass, block.inertia
            model.pair_friction[pairs] *= friction
