"""Robots in closed form: what :class:`~tpm_gym.simulation.simulation.Simulation` is, for many.

Coupling degree zero makes every quantity a formula of where point P is. With ideal drives P is on
its spline, so a control period is one evaluation of the inverse kinematics, the Jacobian and the
dynamics, whatever the time step. Angles and rates are differences over the time steps of the other
engines, as theirs are, and so are torques. Servo drives, and ideal ones whose effort would be
exceeded, go by forward dynamics instead, time step by time step.

Zero by construction, and said to be so in the State: the loops' gap and the platform's tilt.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray, IntArray
from tpm_gym.mechanism.batch import Readings
from tpm_gym.mechanism.machine import Machine
from tpm_gym.mechanism.tpm import PAPER_TPM
from tpm_gym.simulation.analytic.contact import Contact
from tpm_gym.simulation.analytic.drives import Drive, IdealDrives, ServoDrives
from tpm_gym.simulation.analytic.motion import Course, march
from tpm_gym.simulation.analytic.physics import Physics
from tpm_gym.simulation.drives import Reference, Servo, references
from tpm_gym.simulation.randomisation import NOMINAL, Plant
from tpm_gym.simulation.settings import settings_of
from tpm_gym.simulation.simulation import spline_weights
from tpm_gym.simulation.state import CONTROL_PERIOD, Scene, State

__all__ = ["AnalyticSimulation", "Moment"]

_WATCHFUL = 0.5
"""Share of a motor's torque from which on every time step is looked at."""
_COLUMNS = (
    "_bias", "_effort", "_theta", "_rates", "_torque", "_position", "_jacobian", "_conditioning",
    "_truth", "_before", "_commands", "_noise", "_left", "_behind", "_force", "_memory",
)  # fmt: skip
_TURNED = np.array([[1.0], [-1.0], [-1.0]])  # free vectors between machine's frame and world


@dataclass(frozen=True)
class Moment:
    """Everything that the next steps of some robots depend on."""

    plants: tuple[Plant, ...]
    columns: dict[str, FloatArray]
    pucks: FloatArray


class AnalyticSimulation:
    """So many robots, each over a table of its own, all at the same time step.

    Args:
        scene: What stands on each table besides the robot.
        count: How many.
        machine: The nominal machine, which has a :meth:`~tpm_gym.Machine.batch`.
        physics: A :class:`Physics`, or a mapping of its attributes.
        drive: The motors' servo drives; None for ideal ones.

    Attributes:
        torques: Of all time steps of the last control period, (K, 3, n) N m, where ``physics`` asks
            for ``"every"``; else None.

    Raises:
        ConfigurationError: If an option is out of range, or beyond what is in closed form.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        count: int = 1,
        machine: Machine = PAPER_TPM,
        physics: Any = None,
        drive: Servo | None = None,
    ) -> None:
        """Put all robots at rest at home."""
        self.physics = settings_of(Physics, "physics", physics)
        self.scene, self.machine, self.drive, self.count = scene, machine, drive, count
        self._step = self.physics.time_step
        steps = self.physics.substeps
        self._weights = spline_weights(steps).T[:, :, None, None]  # (3, K, 1, 1)
        # Of so many of the last time steps angles are wanted
        self._tail = {"none": 2, "last": 3, "every": steps}[self.physics.torques]
        # Made once: memory of this size would be fetched anew in every control period.
        self._ways = np.empty((2, steps + 2, 3, count))
        self._nominal, self._true = machine.batch(count), machine.batch(count)
        self._contact = Contact(scene.objects, count, self._step, machine.table)
        self._mount = np.array([[0.0], [0.0], [machine.mount.height]])
        motors = machine.mechanism.motors
        self._nominal_effort = np.array([[motor.effort] for motor in motors])
        self._set_up(machine.inverse(machine.home))

    def _set_up(self, home: tuple[float, float, float]) -> None:
        """All columns (..., n), at rest at home."""
        n = self.count
        self._plants = [NOMINAL] * n
        self._start: tuple[tuple[float, ...], Readings] = (
            (),
            self.machine.batch(0).evaluate(np.empty((3, 0))),
        )
        self._bias = np.zeros((3, n))
        self._effort = np.repeat(self._nominal_effort, n, axis=1)
        self._exact = True  # whether all machines are as drawn, so that P is where it shall be
        self._theta = np.repeat(np.array([home]).T, n, axis=1)  # true ones
        self._rates = np.zeros((3, n))
        self._torque = np.zeros((3, n))
        reading = self._nominal.evaluate(self._theta)
        self._position = reading.position.copy()  # of P by the encoders
        self._jacobian, self._conditioning = reading.jacobian, reading.conditioning
        self._truth = reading.position.copy()  # of P
        self._before = reading.position.copy()  # of P a time step ago
        self._commands = np.stack([reading.position] * 2)
        self._noise = np.zeros((2, 3, n))  # of the last two readings
        self._left = np.zeros((2, n), dtype=np.bool_)  # assembly mode, working mode
        self._behind = np.zeros(n, dtype=np.bool_)  # whether ideal motors lacked torque
        self._force = np.zeros((3, n))  # of objects on P in the last time step
        self._memory = np.zeros((2, 3, n))  # of servo drives
        self._servos = (
            None
            if self.drive is None
            else ServoDrives(self.drive, self.machine, self._memory, self._step)
        )
        self.torques: FloatArray | None = None

    # -- running ----------------------------------------------------------------------------

    def reset(
        self,
        rows: IntArray,
        theta: Sequence[float],
        objects: Mapping[str, FloatArray],
        plants: Sequence[Plant],
        noise: FloatArray | None = None,
    ) -> None:
        """Put some robots at rest: arms at ``theta``, objects upright.

        Args:
            rows: Which, (r,).
            theta: (3,) rad, by the encoders.
            objects: Centres (r, 3) m, world, of the scene's objects by name.
            plants: For each of them the true machine.
            noise: Of the first reading of the encoders, (3, n) rad.
        """
        self._become(rows, plants)
        angles = np.array(theta, dtype=np.float64)[:, None]
        self._theta[:, rows] = angles - self._bias[:, rows]
        self._rates[:, rows] = self._torque[:, rows] = self._force[:, rows] = 0.0
        self._left[:, rows] = self._behind[rows] = False
        if self._servos is not None:
            self._servos.rest(rows, np.ascontiguousarray(self._theta[:, rows]))
        at = self._reading_at(tuple(theta))
        self._commands[:, :, rows] = at.position
        self._position[:, rows], self._jacobian[:, :, rows] = at.position, at.jacobian
        self._conditioning[rows] = at.conditioning
        truth = at.position if self._exact else self._true_position(rows)
        self._truth[:, rows] = self._before[:, rows] = truth
        self._noise[:, :, rows] = 0.0
        if noise is not None:
            self._noise[:, :, rows] = noise[:, rows]
            self._read(rows)
        if self.scene.objects:
            places = [objects[block.name] for block in self.scene.objects]
            self._contact.place(rows, np.stack(places, axis=1))

    def _reading_at(self, theta: tuple[float, ...]) -> Readings:
        """What follows from angles at which episodes start: mostly the same ones."""
        if theta != self._start[0]:
            columns = np.array(theta, dtype=np.float64)[:, None]
            self._start = theta, self.machine.batch(1).evaluate(columns)
        return self._start[1]

    def _become(self, rows: IntArray, plants: Sequence[Plant]) -> None:
        """Make some machines those of their plants."""
        changed = [k for k, row in enumerate(rows.tolist()) if self._plants[row] != plants[k]]
        if not changed:
            return
        rows, plants = rows[changed], [plants[k] for k in changed]
        for row, plant in zip(rows.tolist(), plants, strict=True):
            self._plants[row] = plant
        lengths = [
            tuple(np.add(self.machine.lengths, plant.length_errors).tolist())
            if plant.length_errors
            else ()
            for plant in plants
        ]
        self._true.build(rows, lengths, [plant.link_masses for plant in plants])
        self._bias[:, rows] = np.array([plant.encoder_bias for plant in plants]).T
        strength = np.array([plant.motor_strength for plant in plants]).T
        self._effort[:, rows] = self._nominal_effort * strength
        if self._servos is not None:
            self._servos.alter(rows, lengths, plants)
        self._exact = self._exact and not any(lengths) and not self._bias[:, rows].any()
        masses, friction = (
            [getattr(p, name) for p in plants] for name in ("puck_mass", "friction")
        )
        self._contact.alter(rows, np.array(masses), np.array(friction))

    def _true_position(self, rows: IntArray) -> FloatArray:
        return self._true.take(rows).evaluate(self._theta[:, rows]).position

    def move(self, command: FloatArray, vacuum: BoolArray, noise: FloatArray | None = None) -> None:
        """Command point P and run one control period.

        Args:
            command: (n, 3) m, machine's frame; inside the region.
            vacuum: (n,) whether the cups suck.
            noise: Of the encoders' readings at the end, (3, n) rad.
        """
        new = np.ascontiguousarray(np.asarray(command, dtype=np.float64).T)
        commands = np.concatenate([self._commands, new[None]])
        self._commands = commands[1:]
        if self._servos is None:
            self._follow(commands, vacuum)
        else:
            self._serve(self._servos, commands, vacuum)
        self._noise[0] = self._noise[1]
        self._noise[1] = 0.0 if noise is None else noise
        self._read(slice(None))

    def _spline(self, commands: FloatArray) -> FloatArray:
        """The way of P along the last three commands (3, 3, r) m, (K, 3, r) m."""
        path, term = np.empty((2, self.physics.substeps, *commands.shape[1:]))
        return self._spline_into(path, commands, term)

    def _spline_into(self, path: FloatArray, commands: FloatArray, term: FloatArray) -> FloatArray:
        """The last time steps of it, as many as ``path`` and ``term`` have room for."""
        first, second, third = self._weights[:, -len(path) :]
        np.multiply(first, commands[0], out=path)
        path += np.multiply(second, commands[1], out=term)
        path += np.multiply(third, commands[2], out=term)
        return path

    def _follow(self, commands: FloatArray, vacuum: BoolArray) -> None:
        """Let ideal motors take P along the last three commands (3, 3, n) m.

        That is computed as if all of them could, and once more for machines of which one cannot.
        """
        start = self._course()
        objects = self._contact.save(slice(None)) if self.scene.objects else None
        last = self._exact and not self.scene.objects  # then no more of the way matters
        points, other = self._ways[:, : self._tail + 2] if last else self._ways
        theta = self._ideal(self._spline_into(points[2:], commands, other[2:]))
        points[0], points[1] = start.before, start.position
        push = self._touch(slice(None), points, vacuum, other)
        before, at, now = points[-3:]
        if self.scene.objects:
            change = (now - 2 * at + before) / self._step**2
            self._force = push[-1] + self._contact.carried(slice(None)) * change
        self._before, self._truth = at.copy(), now.copy()
        self._theta = theta[:, -1].copy()
        self._rates = (theta[:, -1] - theta[:, -2]) / self._step
        on_side = self._true.assembled_at(points[2:].swapaxes(0, 1)).all(axis=0)
        late = self._behind | start.left.any(axis=0) | ~on_side
        late |= self._find_torques(start, theta, commands, push)
        rows = np.flatnonzero(late)
        if len(rows):
            if objects is not None:
                self._contact.restore(rows, objects[rows])
            drive = IdealDrives(self._effort[:, rows], self._step)
            angles = self._angles(self._spline(commands[..., rows]), rows)
            followed = [Reference(one) for one in angles.transpose(1, 0, 2)]
            self._march(rows, start.take(rows), drive, followed, vacuum)
            self._behind[rows] = drive.behind.any(axis=0)

    def _ideal(self, path: FloatArray) -> FloatArray:
        """Where motors are for P to be on ``path`` (k, 3, n) m.

        Where machines are not as drawn, ``path`` becomes the true way of P, NaN where it leaves
        their modes.

        Returns:
            (3, ..., n) rad at the last time steps.
        """
        if self._exact:
            return self._nominal.inverse(path[-self._tail :].swapaxes(0, 1))
        theta = self._angles(path, slice(None))
        path[:] = self._true.forward(theta).swapaxes(0, 1)
        return theta[:, -self._tail :]

    def _angles(self, path: FloatArray, rows: IntArray | slice) -> FloatArray:
        """Where motors of some machines are for P to be on ``path`` (k, 3, r) m, (3, k, r) rad."""
        batch = self._nominal if isinstance(rows, slice) else self._nominal.take(rows)
        angles: FloatArray = batch.inverse(path.swapaxes(0, 1)) - self._bias[:, None, rows]
        return angles

    def _find_torques(
        self, start: Course, theta: FloatArray, commands: FloatArray, push: FloatArray
    ) -> BoolArray:
        """What motors apply at the angles (3, ..., n) rad; (n,) where one would need too much."""
        if self.physics.torques == "none":
            self._torque = np.full_like(self._torque, np.nan)
            return np.zeros(self.count, dtype=np.bool_)
        if self.physics.torques == "every":
            torques = self._torques(slice(None), start.lead(theta, self._step), push)
            self.torques, self._torque = torques, torques[-1].copy()
            return _beyond(torques, self._effort)
        self._torque = self._torques(slice(None), theta, push[-1:])[0]
        over = _beyond(self._torque[None], _WATCHFUL * self._effort)
        rows = np.flatnonzero(over)
        if len(rows):
            angles = self._angles(self._spline(commands[..., rows]), rows)
            every = start.take(rows).lead(angles, self._step)
            torques = self._torques(rows, every, push[:, :, rows])
            over[rows] = _beyond(torques, self._effort[:, rows])
        return over

    def _torques(self, rows: IntArray | slice, theta: FloatArray, push: FloatArray) -> FloatArray:
        """Torques (m, 3, r) N m that take motors through theta (3, m + 2, r) rad."""
        rates = (theta[:, 1:] - theta[:, :-1]) / self._step
        changes = (rates[:, 1:] - rates[:, :-1]) / self._step
        against = push.transpose(1, 0, 2) if self.scene.objects else None
        batch = self._true if isinstance(rows, slice) else self._true.take(rows)
        torques = batch.torque(theta[:, 1:-1], rates[:, :-1], changes, against)
        by_steps: FloatArray = torques.transpose(1, 0, 2)
        return by_steps

    def _serve(self, servos: ServoDrives, commands: FloatArray, vacuum: BoolArray) -> None:
        """Let servo drives take P along the last three commands (3, 3, n) m."""
        nominal, bias = self._nominal, self._bias
        start = nominal.inverse((commands[0] + commands[1]) / 2)
        angles = nominal.inverse(self._spline(commands).swapaxes(0, 1)).swapaxes(0, 1)
        followed = references(nominal, servos.law, start, angles, self._step)
        followed = [one._replace(theta=one.theta - bias) for one in followed]
        servos.begin(followed[0].theta)
        self._march(slice(None), self._course(), servos, followed, vacuum)

    def _course(self) -> Course:
        """Where the machines are."""
        return Course(
            self._theta, self._rates, self._torque, self._truth, self._before,
            self._force, self._contact.carried(slice(None)), self._left,
        )  # fmt: skip

    def _march(
        self,
        rows: IntArray | slice,
        start: Course,
        drive: Drive,
        followed: Sequence[Reference],
        vacuum: BoolArray,
    ) -> None:
        """Run a control period of some machines by forward dynamics."""

        def touch(points: FloatArray) -> tuple[FloatArray, FloatArray]:
            return self._touch(rows, points, vacuum[rows])[-1], self._contact.carried(rows)

        batch = self._true if isinstance(rows, slice) else self._true.take(rows)
        end, torques = march(batch, drive, followed, start, self._step, touch)
        self._theta[:, rows], self._rates[:, rows] = end.theta, end.rates
        self._truth[:, rows], self._before[:, rows] = end.position, end.before
        self._torque[:, rows], self._force[:, rows] = end.torque, end.force
        self._left[:, rows] = end.left
        if self.physics.torques == "every":
            if self.torques is None:
                self.torques = np.zeros((len(torques), 3, self.count))
            self.torques[:, :, rows] = torques

    def _touch(
        self,
        rows: IntArray | slice,
        points: FloatArray,
        vacuum: BoolArray,
        room: FloatArray | None = None,
    ) -> FloatArray:
        """Let objects and cups do what they do along the way of P; forces on P.

        Args:
            rows: Of which machines.
            points: P (K + 2, 3, r) m before the last time step, now, and after each to come.
            vacuum: (r,) whether the cups suck.
            room: An array like ``points``, to be overwritten.

        Returns:
            (K, 3, r) N.
        """
        if not self.scene.objects:
            return np.zeros((1, 3, points.shape[2]))
        world = np.multiply(points, _TURNED, out=room)
        world += self._mount
        path = np.ascontiguousarray(world.transpose(2, 0, 1))
        force = self._contact.advance(np.arange(self.count)[rows], path, vacuum)
        push = np.ascontiguousarray(force.transpose(1, 2, 0))
        push *= _TURNED
        return push

    @property
    def commands(self) -> FloatArray:
        """Where point P is commanded to go, (n, 3) m, machine's frame."""
        commands: FloatArray = self._commands[1].T
        return commands

    @property
    def left(self) -> BoolArray:
        """(2, n) whether the robots left their assembly mode, their working mode."""
        return self._left

    @property
    def bias(self) -> FloatArray:
        """(3, n) rad, what the encoders report minus what is true, without noise."""
        return self._bias

    # -- reading ----------------------------------------------------------------------------

    def _read(self, rows: IntArray | slice) -> None:
        """Read the encoders, and what follows; what makes no sense leaves the last that did."""
        theta = self._encoders(rows)
        batch = self._nominal if isinstance(rows, slice) else self._nominal.take(rows)
        self._write(rows, batch.evaluate(theta))

    def _write(self, rows: IntArray | slice, reading: Readings) -> None:
        position, jacobian, conditioning, _ = reading
        if np.isfinite(conditioning).all() and isinstance(rows, slice):
            self._position, self._jacobian, self._conditioning = position, jacobian, conditioning
            return
        known = np.isfinite(conditioning) & np.isfinite(position).all(axis=0)
        self._position[:, rows] = np.where(known, position, self._position[:, rows])
        self._jacobian[:, :, rows] = np.where(known, jacobian, self._jacobian[:, :, rows])
        self._conditioning[rows] = np.where(known, conditioning, self._conditioning[rows])

    def _encoders(self, rows: IntArray | slice) -> FloatArray:
        """Angles that the encoders report, (3, r) rad."""
        angles: FloatArray = self._theta[:, rows] + self._bias[:, rows] + self._noise[1][:, rows]
        return angles

    def state(self) -> State:
        """What is known of all robots, with a leading axis (n,)."""
        earlier, noise = self._noise
        rates = self._rates + (noise - earlier) / CONTROL_PERIOD
        j, (a, b, c) = self._jacobian, rates
        velocity = j[:, 0] * a + j[:, 1] * b + j[:, 2] * c
        tilt, gap = np.zeros((2, self.count))
        contact = self._contact.read()
        x, y, z, w = np.moveaxis(contact.quaternion, -1, 0)
        axis = 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)
        return State(
            theta=self._encoders(slice(None)).T,
            theta_dot=rates.T,
            torque=self._torque.copy().T,
            fk_position=self._to_world(self._position).T,
            fk_velocity=(velocity * _TURNED).T,
            conditioning=self._conditioning.copy(),
            platform_position=self._to_world(self._truth).T,
            platform_tilt=tilt,
            closure_error=gap,
            assembly_mode_changed=self._left[0].copy(),
            working_mode_changed=self._left[1].copy(),
            command=self._to_world(self._commands[1]).T,
            held=contact.held,
            vacuum=contact.vacuum,
            object_position=contact.position,
            object_quaternion=contact.quaternion,
            object_axis=np.stack(axis, axis=-1),
            object_velocity=contact.velocity,
            object_angular_velocity=contact.angular_velocity,
        )

    def save(self, rows: IntArray | slice = slice(None)) -> Moment:
        """Take down everything that the next steps of some robots depend on."""
        columns = {name: getattr(self, name)[..., rows].copy() for name in _COLUMNS}
        plants = tuple(self._plants[row] for row in np.arange(self.count)[rows].tolist())
        return Moment(plants, columns, self._contact.save(rows))

    def restore(self, moment: Moment, rows: IntArray | slice = slice(None)) -> None:
        """Go back to what ``save`` returned, for as many robots."""
        self._become(np.arange(self.count)[rows], moment.plants)
        for name, values in moment.columns.items():
            getattr(self, name)[..., rows] = values
        self._contact.restore(rows, moment.pucks)

    def _to_world(self, position: FloatArray) -> FloatArray:
        world: FloatArray = self._mount + position * _TURNED
        return world


def _beyond(torques: FloatArray, effort: FloatArray) -> BoolArray:
    """(r,) whether one of torques (m, 3, r) is more than a motor's effort (3, r)."""
    beyond: BoolArray = np.logical_or.reduce(np.abs(torques) > effort, axis=(0, 1))
    return beyond
