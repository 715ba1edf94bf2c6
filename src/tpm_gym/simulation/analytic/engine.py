"""Analytic engine: simulates many robots with closed-form kinematics and dynamics.

The mechanism has coupling degree zero, so every quantity is a closed-form function of point P. With
ideal drives, P follows its spline. Then one evaluation of inverse kinematics, Jacobian and dynamics
computes the whole control period, whatever the length of a time step. Joint velocities and
accelerations are differences over time steps, as in the other engines. Servo drives, and ideal
drives that would exceed a motor's largest torque, are simulated by forward dynamics, one time step
after another.

The readings ``gap`` and ``tilt`` are always 0; use another engine to measure them.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any, Final

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray, IntArray
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.analytic.contact import Contact, Route
from tpm_gym.simulation.analytic.forward_dynamics import Course, IdealSteps, ServoSteps, march
from tpm_gym.simulation.analytic.passage import pass_through
from tpm_gym.simulation.analytic.physics import Physics
from tpm_gym.simulation.drives import Servo, ServoDrives
from tpm_gym.simulation.engine import Engine, Path, Readout, loops, make_engine
from tpm_gym.simulation.imaging import Camera, Picture, View
from tpm_gym.simulation.randomisation import Plant
from tpm_gym.simulation.settings import settings_of
from tpm_gym.simulation.state import Scene

_CHECK_ABOVE = 0.5
"""Fraction of a motor's largest torque.

If a torque in the last time step of a control period is above this fraction, the torques in all
time steps of the period are computed.
"""
_NEAR_PLANE = 1.2
"""Largest distance from the plane of symmetry at which P is near the plane.

The plane is normal to ``mirror_axis``. The distance is given as a multiple of the machine's
``step_limit`` (m) along this axis. If P is farther from the plane, torques are computed from
differences of joint positions. At this distance and at full speed, the differences give P's
acceleration normal to the plane with an error of 0.2 m/s^2.
"""
_COURSE = tuple(f"_{name}" for name in Course._fields)
_COLUMNS = (*_COURSE, "_behind")


class AnalyticEngine:
    """Engine that simulates any number of robots.

    Another engine draws the pictures: PyBullet, or MuJoCo if PyBullet is not installed. It is
    created for the first picture.

    Args:
        gui: Whether to open a window of the engine that draws.
        renderer: Renderer of the engine that draws the pictures.
        physics: A :class:`Physics` or a mapping of its attributes.
        drive: Servo drives of the motors; None for ideal drives.

    Attributes:
        least_steps: Smallest allowed number of time steps in a control period: 3. Accelerations
            are computed from the positions at the ends of the last three time steps.
        torques: (K, n, 3) N m, torques in all time steps of the last control period; None unless
            ``physics.torques`` is ``"every"``.

    Raises:
        ConfigurationError: If an option is out of range.
    """

    least_steps: Final = 3

    def __init__(
        self,
        *,
        gui: bool = False,
        renderer: str | None = None,
        physics: Any = None,
        drive: Servo | None = None,
    ) -> None:
        """Check the options."""
        self.physics = settings_of(Physics, "physics", physics)
        self.time_step = self.physics.time_step
        self._servo, self._renderer, self._gui = drive, renderer, gui
        # Number of time steps at the end of a control period whose joint positions are needed;
        # 0 for all
        self._tail = {"none": 2, "last": 3, "every": 0}[self.physics.torques]
        self._draws = "pybullet" if find_spec("pybullet") else "mujoco"
        self._artist: Engine | None = None
        self._mirrored: Engine | None = None  # poses a robot beyond the plane
        self.torques: FloatArray | None = None

    def load(self, machine: Machine, scene: Scene, count: int) -> None:
        """Implement :meth:`Engine.load`."""
        self._machine, self._scene, self._count = machine, scene, count
        self._rows = np.arange(count)
        # Arrays of equal shapes are faster than a broadcast over three columns
        self._turn, self._origin = (np.tile(part, (count, 1)) for part in machine.mount.frame)
        self._built: FloatArray | None = None
        self._exact = True  # whether bias and length errors are 0, so that P is on its spline
        self._nominal_effort = np.array([motor.effort for motor in machine.mechanism.motors])
        self._effort = np.tile(self._nominal_effort, (count, 1))
        servo, step = self._servo, self.time_step
        self._contact = Contact(
            scene.objects, count, step, machine.table, machine.mount.plain_frame, scene.belt
        )
        self._drives = None if servo is None else ServoDrives(servo, machine, count, step)
        home = machine.require_inverse(np.array(machine.home))
        self._theta = np.tile(home, (count, 1))
        self._position = np.tile(machine.home, (count, 1))
        self._before = self._position.copy()
        self._rates, self._torque, self._force = np.zeros((3, count, 3))
        self._carried, self._no_push = np.zeros(count), np.zeros((count, 1, 3))  # kg, N
        self._mode_left = np.zeros(count, dtype=np.int8)
        self._behind = np.zeros(count, dtype=np.bool_)  # whether an ideal motor was at its limit
        if self._gui:
            self._artist = self._new_artist()

    def alter(self, rows: IntArray, plants: Sequence[Plant]) -> None:
        """Implement :meth:`Engine.alter`."""
        machine = self._machine
        if self._built is None and any(p.length_errors or p.link_masses for p in plants):
            self._built = np.tile(machine.built(), (self._count, 1))
        if self._built is not None:
            self._built[rows] = [
                machine.built(plant.lengths_of(machine), plant.link_masses) for plant in plants
            ]
        self._effort[rows] = self._nominal_effort * np.array([p.motor_strength for p in plants])
        biases = np.array([plant.encoder_bias for plant in plants])
        self._exact &= not (biases.any() or any(plant.length_errors for plant in plants))
        if self._drives is not None:
            self._drives.alter(rows, plants)
        masses, friction = ([getattr(p, k) for p in plants] for k in ("block_mass", "friction"))
        self._contact.alter(rows, np.array(masses), np.array(friction))

    def place(self, rows: IntArray, theta: FloatArray, objects: FloatArray) -> None:
        """Implement :meth:`Engine.place`."""
        built = None if self._built is None else self._built[rows]
        self._theta[rows] = theta
        self._position[rows] = self._machine.evaluate(theta, built).position
        self._before[rows] = self._position[rows]
        self._rates[rows] = self._torque[rows] = self._force[rows] = 0.0
        self._carried[rows] = 0.0
        self._mode_left[rows], self._behind[rows] = 0, False
        if self._drives is not None:
            self._drives.rest(rows, theta)
        self._contact.place(rows, objects)

    def set_belt(self, rows: IntArray, speed: FloatArray) -> None:
        """Implement :meth:`Engine.set_belt`."""
        self._contact.set_belt(rows, speed)

    def advance(self, path: Path, vacuum: BoolArray) -> None:
        """Implement :meth:`Engine.advance`."""
        self.torques = None
        if self._drives is None:
            self._follow(path, vacuum)
            return
        steps = ServoSteps(self._drives, self._drives.references(path), self.time_step)
        self._integrate(self._rows, steps, len(path.weights), vacuum)

    def _follow(self, path: Path, vacuum: BoolArray) -> None:
        """Move all robots with ideal motors along their paths.

        All robots are first computed without torque limits. The robots that would exceed a limit
        are then computed again by forward dynamics.
        """
        late = self._behind | (self._mode_left != 0)
        if self._machine.mirror_axis is not None:
            late |= self._near_plane(self._machine.mirror_axis, path)
        if self._exact:
            theta, points = path.joints(self._tail), path.points(3)
            controls, weights = path.commands, path.weights
        else:
            joints = path.joints()
            controls = points = self._machine.forward(joints, self._built)
            theta, weights = joints[:, -self._tail :], np.eye(len(path.weights))
            late |= ~self._machine.same_side(points).all(axis=1)
        start = {name: getattr(self, name) for name in _COURSE}
        push = self._no_push
        if self._scene.objects:
            route = Route(self._before, self._position, controls, weights)
            last = 1 if self.physics.torques == "none" else len(path.weights)
            push, self._carried = self._contact.advance(self._rows, route, vacuum, last)
        self._before, self._position, self._theta, self._rates, self._force = loops().arrived(
            theta, points, push, self._carried, self.time_step
        )
        late |= self._find_torques(start["_theta"], start["_rates"], theta, path, push)
        rows = np.flatnonzero(late)
        if len(rows):
            self._repeat(rows, start, path, vacuum)

    def _near_plane(self, axis: int, path: Path) -> BoolArray:
        """Return whether P or its path is near the plane of symmetry, or the path crosses it, (n,).

        The plane is normal to ``mirror_axis``. Near the plane, torques cannot be computed from
        differences of the joint positions. The result is True for all robots if any robot has had
        encoder bias or length errors since :meth:`load`.
        """
        if not self._exact:
            return np.ones(self._count, dtype=np.bool_)
        along, now = path.commands[:, :, axis], self._position[:, axis, None]
        near = self._machine.step_limit[axis] * _NEAR_PLANE
        clear: BoolArray = np.minimum(along * np.sign(now), np.abs(now)) > near
        return np.logical_not(clear.all(axis=1))

    def _repeat(self, rows: IntArray, start: Any, path: Path, vacuum: BoolArray) -> None:
        """Compute the control period of some robots again, by forward dynamics."""
        for name, values in start.items():
            getattr(self, name)[rows] = values[rows]
        self._contact.undo(rows)
        joints = np.ascontiguousarray(path.take(rows).joints().swapaxes(0, 1))
        steps = IdealSteps(joints, self._effort[rows], self.time_step)
        self._integrate(rows, steps, len(path.weights), vacuum)
        self._behind[rows] = steps.behind

    def _integrate(
        self, rows: IntArray, steps: IdealSteps | ServoSteps, count: int, vacuum: BoolArray
    ) -> None:
        """Simulate a control period of ``count`` time steps of some robots by forward dynamics."""
        on, whole = vacuum[rows], np.ones((1, 1))

        def touch(
            before: FloatArray, now: FloatArray, then: FloatArray
        ) -> tuple[FloatArray, FloatArray]:
            route = Route(before, now, then[:, None], whole)
            push, carried = self._contact.advance(rows, route, on)
            return push[:, 0], carried

        course = Course(*(getattr(self, name)[rows] for name in _COURSE))
        built = None if self._built is None else self._built[rows]
        # pass_through() needs ideal drives; ServoDrives rejects machines with a mirror_axis.
        go: Any = march if self._machine.mirror_axis is None else pass_through
        course, torques = go(self._machine, built, steps, count, course, touch)
        for name, values in zip(_COURSE, course, strict=True):
            getattr(self, name)[rows] = values
        if self.physics.torques == "every":
            if self.torques is None:
                self.torques = np.zeros((count, self._count, 3))
            self.torques[:, rows] = torques

    def _find_torques(
        self,
        start: FloatArray,
        rates: FloatArray,
        theta: FloatArray,
        path: Path,
        push: FloatArray,
    ) -> BoolArray:
        """Compute the torques, and return whether each robot would exceed a motor's limit, (n,).

        Args:
            start: (n, 3) rad, joint positions at the beginning of the control period.
            rates: (n, 3) rad/s, joint velocities at the beginning of the control period.
            theta: (n, k, 3) rad, joint positions at the ends of the last k of the K time steps of
                the control period.
            path: Path of the control period.
            push: (n, K, 3) N, force of cup and objects on P in each of the K time steps of the
                control period. If the scene has no objects, this is an array (n, 1, 3) of zeros.
        """
        if self.physics.torques == "none":
            self._torque = np.full_like(self._torque, np.nan)
            return np.zeros(self._count, dtype=np.bool_)
        lead = (start - self.time_step * rates)[:, None], start[:, None]
        if self.physics.torques == "every":
            torques = self._torques(self._rows, np.concatenate([*lead, theta], axis=1), push)
            self.torques, self._torque = torques.swapaxes(0, 1), torques[:, -1].copy()
            over: BoolArray = loops().beyond(torques, self._effort)
            return over
        last = self._torques(self._rows, theta, push)
        self._torque = last[:, 0].copy()
        over = loops().beyond(last, _CHECK_ABOVE * self._effort)
        rows = np.flatnonzero(over)
        if len(rows):
            before = [part[rows] for part in lead]
            whole = np.concatenate([*before, path.take(rows).joints()], axis=1)
            torques = self._torques(rows, whole, push[rows])
            over[rows] = loops().beyond(torques, self._effort[rows])
        return over

    def _torques(self, rows: IntArray, theta: FloatArray, push: FloatArray) -> FloatArray:
        """Compute the torques of r robots in the last k time steps, (r, k, 3) N m.

        Args:
            rows: (r,) indices of the robots.
            theta: (r, k + 2, 3) rad, joint positions at the ends of the last k + 2 time steps.
            push: (r, K, 3) N, force of cup and objects on P in each of K time steps; the forces in
                the last k time steps are used.
        """
        joints, rates, changes = loops().differences(theta, self.time_step)
        built = None if self._built is None else self._built[rows]
        against = push[:, -changes.shape[1] :] if self._scene.objects else None
        return self._machine.torque(joints, rates, changes, against, built)

    def read(self) -> Readout:
        """Implement :meth:`Engine.read`."""
        objects = self._contact.read()
        gap, tilt = np.zeros((2, self._count))
        return Readout(
            theta=self._theta.copy(),
            theta_dot=self._rates.copy(),
            torque=self._torque.copy(),
            position=self._position * self._turn + self._origin,
            tilt=tilt,
            gap=gap,
            mode_left=self._mode_left.copy(),
            held=objects.held,
            vacuum=objects.vacuum,
            object_position=objects.position,
            object_quaternion=objects.quaternion,
            object_velocity=objects.velocity,
            object_angular_velocity=objects.angular_velocity,
        )

    def save(self) -> Any:
        """Implement :meth:`Engine.save`; return a dictionary of arrays."""
        saved = {name.lstrip("_"): getattr(self, name).copy() for name in _COLUMNS}
        saved["objects"] = self._contact.save()
        if self._drives is not None:
            saved["drives"] = self._drives.memory.copy()
        return saved

    def restore(self, saved: Any) -> None:
        """Implement :meth:`Engine.restore`."""
        for name in _COLUMNS:
            setattr(self, name, saved[name.lstrip("_")].copy())
        self._contact.restore(saved["objects"])
        if self._drives is not None:
            self._drives.memory[:] = saved["drives"]

    def show(self, camera: Camera, markers: FloatArray) -> None:
        """Implement :meth:`Engine.show`."""
        self._pose_artist(0).show(camera, markers)

    def picture(self, row: int, view: View) -> Picture:
        """Implement :meth:`Engine.picture`."""
        return self._pose_artist(row).picture(0, view)

    def _pose_artist(self, row: int) -> Engine:
        """Return the engine that draws, with the robot of ``row`` and its objects placed."""
        if self._artist is None:
            self._artist = self._new_artist()
        machine, position = self._machine, self._position[[row]]
        now = self._contact.read()
        objects = np.concatenate([now.position[[row]], now.quaternion[[row]]], axis=2)
        axis = machine.mirror_axis
        beyond = axis is not None and position[0, axis] * machine.home[axis] < 0
        if beyond and self._mirrored is None:
            self._mirrored = make_engine(self._draws)
            self._mirrored.load(machine.mirrored(), self._scene, 1)
        posed = self._mirrored if beyond and self._mirrored else self._artist
        posed.place(self._rows[:1], machine.require_inverse(position), objects)
        if posed is not self._artist:
            self._artist.restore(posed.save())
        return self._artist

    def _new_artist(self) -> Engine:
        artist = make_engine(self._draws, gui=self._gui, renderer=self._renderer)
        artist.load(self._machine, self._scene, 1)
        return artist

    def close(self) -> None:
        """Implement :meth:`Engine.close`."""
        for engine in (self._artist, self._mirrored):
            if engine is not None:
                engine.close()
        self._artist = self._mirrored = None
