"""The robot in MuJoCo: motors, the cup's spring, encoders and true positions.

Ideal motors reach their references exactly, as far as their largest torque allows. So an ideal
motor is a constraint on the velocity at the end of the time step, with a limited force. Dry
friction in MuJoCo is a constraint of this kind, with the target velocity zero. So this module uses
dry friction with another target velocity as ideal motor, and also as the cup's spring. The first
half of a time step (``mj_step1``) creates the friction constraints. Then this module sets their
target velocities. The second half (``mj_step2``) computes the forces.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from tpm_gym.arrays import Quaternion, Vector, rotate
from tpm_gym.mechanism.machine import Machine
from tpm_gym.mechanism.mjcf import STIFF, site_names
from tpm_gym.mechanism.mount import Mount
from tpm_gym.simulation.engine import SPRING_GAIN, transform
from tpm_gym.simulation.randomisation import NOMINAL, Plant

_LEAST_EFFORT = 1e-9  # N m; with zero torque, a motor would have no row in the solver


class Robot:
    """Robot in a MuJoCo model.

    Args:
        machine: Machine with the true lengths of the robot.
        ideal: Whether the motors have ideal drives; else they apply given torques.

    Attributes:
        torque: Torques of the motors in the last time step, N m; zero after :meth:`place`.
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, machine: Machine, ideal: bool
    ) -> None:
        """Look up the addresses of joints, bodies and sites in the model."""
        self._model, self._data, self._ideal = model, data, ideal
        mechanism = machine.mechanism
        self._point_p, self._lip = mechanism.point_p, mechanism.lip
        joints = [link.joint for link in mechanism.links if link.joint]
        self._at = {joint.name: model.joint(joint.name).qposadr.item() for joint in joints}
        self._dof = {joint.name: model.joint(joint.name).dofadr.item() for joint in joints}
        self._platform = model.body(mechanism.platform).id
        self._tool = model.body(mechanism.tool).id
        moving = [model.body(link.name).id for link in mechanism.links[1:]]
        self._inertias = {
            body: (model.body_mass[body].item(), model.body_inertia[body].copy()) for body in moving
        }
        slide = mechanism.link(mechanism.tool).joint
        assert slide is not None
        self._motors = [(self._at[name], self._dof[name]) for name in mechanism.actuated]
        self._efforts = [motor.effort for motor in mechanism.motors]
        self._slide = self._at[slide.name], self._dof[slide.name]
        self._spring = slide.effort
        pairs = [site_names(closure.name) for closure in mechanism.closures]
        self._sides = [[model.site(pair[side]).id for pair in pairs] for side in (0, 1)]
        # The friction rows are as stiff as possible: they reach their velocity in one time step.
        step = model.opt.timestep
        self._rate = 1 / step
        model.dof_solimp[:] = [float(number) for number in STIFF.split()]
        model.dof_solref[:] = -1 / step**2, -1 / step
        self._position, self._speed, self._height = data.qpos.item, data.qvel.item, data.xpos.item
        self.torque: Vector = (0.0, 0.0, 0.0)
        self.alter(NOMINAL)

    def alter(self, plant: Plant) -> None:
        """Apply the link masses, motor strengths and joint friction of ``plant``."""
        model, rate = self._model, self._rate
        factors = plant.link_masses or [1.0] * len(self._inertias)
        for (body, (mass, moments)), factor in zip(self._inertias.items(), factors, strict=True):
            model.body_mass[body] = factor * mass
            model.body_inertia[body] = factor * moments
        pairs = zip(self._efforts, plant.motor_strength, strict=True)
        limits = [max(effort * strength, _LEAST_EFFORT) for effort, strength in pairs]
        losses = limits if self._ideal else plant.joint_friction
        joints = (*self._motors, self._slide)
        for (_, dof), loss in zip(joints, (*losses, self._spring), strict=True):
            model.dof_frictionloss[dof] = loss
        driven = [(*motor, rate) for motor in self._motors] if self._ideal else []
        driven.append((*self._slide, SPRING_GAIN * rate))
        rough = np.flatnonzero(model.dof_frictionloss).tolist()  # order of the friction rows
        self._rows = [(rough.index(dof), at, dof, gain) for at, dof, gain in driven]

    def place(self, joints: Mapping[str, float]) -> None:
        """Set the joint positions (rad, m for slides), by joint name."""
        for name, position in joints.items():
            self._data.qpos[self._at[name]] = position
        self.torque = (0.0, 0.0, 0.0)

    def drive(self, theta: Vector) -> None:
        """Set the joint positions (rad) that ideal motors reach in this time step.

        Call this method or :meth:`apply` between the two halves of a time step.
        """
        self._set_targets((*theta, 0.0))

    def apply(self, torque: Vector) -> None:
        """Set the torques (N m) that the motors apply in this time step."""
        self.torque = torque
        for (_, dof), one in zip(self._motors, torque, strict=True):
            self._data.qfrc_applied[dof] = one
        self._set_targets((0.0,))

    def _set_targets(self, targets: Sequence[float]) -> None:
        """Set the joint positions that the constraints shall reach.

        Args:
            targets: First the joint positions of the ideal motors (rad), if the motors are ideal;
                then the position of the cup's slide (m).
        """
        data, rate, position, speed = self._data, self._rate, self._position, self._speed
        wanted, first = data.efc_aref, data.ne
        for (row, at, dof, gain), target in zip(self._rows, targets, strict=True):
            wanted[first + row] = ((target - position(at)) * gain - speed(dof)) * rate

    def note_torque(self) -> None:
        """Store the torques of ideal motors; call after the second half of a time step."""
        if not self._ideal:
            return  # apply() has stored the torques
        force, first = self._data.efc_force.item, self._data.ne
        (a, *_), (b, *_), (c, *_), _ = self._rows
        self.torque = force(first + a), force(first + b), force(first + c)

    def motors(self) -> tuple[Vector, Vector, Vector]:
        """Return joint positions (rad), velocities (rad/s) and stored torques (N m)."""
        position, speed = self._position, self._speed
        (a, i), (b, j), (c, k) = self._motors
        theta = position(a), position(b), position(c)
        return theta, (speed(i), speed(j), speed(k)), self.torque

    def truth(self) -> tuple[float, Vector, float]:
        """Compute the largest loop gap (m), point P (m, world) and the platform's tilt (rad)."""
        data, (side, other) = self._data, self._sides
        gaps = data.site_xpos[side] - data.site_xpos[other]
        origin, turn = self._frame(self._platform)
        gap = math.sqrt((gaps * gaps).sum(axis=1).max(initial=0.0))
        return gap, transform(origin, turn, self._point_p), Mount.tilt(turn)

    def cup(self) -> tuple[Vector, Vector]:
        """Return the centre of the cup's lip (m) and the cup's outward axis; world frame."""
        origin, turn = self._frame(self._tool)
        return transform(origin, turn, self._lip), rotate(turn, (0.0, 0.0, 1.0))

    def tool_height(self) -> float:
        """Return the height of the cup's link above the table, m."""
        height: float = self._height(self._tool, 2)
        return height

    def tool(self) -> tuple[Vector, Quaternion]:
        """Return origin (m) and orientation of the cup's link; world frame."""
        return self._frame(self._tool)

    def _frame(self, body: int) -> tuple[Vector, Quaternion]:
        x, y, z = self._data.xpos[body].tolist()
        qw, qx, qy, qz = self._data.xquat[body].tolist()
        return (x, y, z), (qx, qy, qz, qw)
