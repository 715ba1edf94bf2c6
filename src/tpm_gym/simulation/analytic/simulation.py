"""Robots in closed form: what :class:`~tpm_gym.simulation.simulation.Simulation` is, for many.

Coupling degree zero makes every quantity a formula of where point P is. With ideal drives P is on
its spline, so a control period is one evaluation of the inverse kinematics, the Jacobian and the
dynamics, whatever the time step. Angles and rates are differences over the time steps of the other
engines, as theirs are, and so are torques.

Zero by construction, and said to be so in the State: the loops' gap and the platform's tilt.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray, IntArray
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.batch import Readings
from tpm_gym.mechanism.machine import Machine
from tpm_gym.mechanism.tpm import PAPER_TPM
from tpm_gym.simulation.analytic.physics import Physics
from tpm_gym.simulation.analytic.pucks import Pucks
from tpm_gym.simulation.drives import Servo
from tpm_gym.simulation.randomisation import NOMINAL, Plant
from tpm_gym.simulation.settings import settings_of
from tpm_gym.simulation.simulation import spline_weights
from tpm_gym.simulation.state import CONTROL_PERIOD, Scene, State

__all__ = ["AnalyticSimulation", "Moment"]

_WATCHFUL = 0.5
"""Share of a motor's torque from which on every time step is looked at."""
_COLUMNS = (
    "_bias", "_effort", "_theta", "_rates", "_torque", "_position", "_jacobian", "_conditioning",
    "_truth", "_before", "_commands", "_noise", "_left",
)  # fmt: skip
_TURNED = np.array([[1.0], [-1.0], [-1.0]])  # free vectors between machine's frame and world


@dataclass(frozen=True)
class Moment:
    """Everything that the next steps of some robots depend on."""

    plants: tuple[Plant, ...]
    columns: dict[str, FloatArray]
    pucks: Any


class AnalyticSimulation:
    """So many robots, each over a table of its own, all at the same time step.

    Args:
        scene: What stands on each table besides the robot: one object at most.
        count: How many.
        machine: The nominal machine, which has a :meth:`~tpm_gym.Machine.batch`.
        physics: A :class:`Physics`, or a mapping of its attributes.
        drive: The motors' servo drives; None for ideal ones.

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
        if len(scene.objects) > 1:
            valid = f"another one: it knows one object, the scene has {len(scene.objects)}"
            raise ConfigurationError("engine", "analytic", valid)
        self.scene, self.machine, self.drive, self.count = scene, machine, drive, count
        self._step = self.physics.time_step
        self._weights = spline_weights(self.physics.substeps).T[:, :, None]  # (3, K, 1)
        self._nominal, self._true = machine.batch(count), machine.batch(count)
        block = scene.objects[0] if scene.objects else None
        self._pucks = Pucks(block, count, self._step, machine.table)
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

    # -- running ----------------------------------------------------------------------------

    def reset(
        self,
        rows: IntArray,
        theta: Sequence[float],
        objects: Sequence[Mapping[str, Any]],
        plants: Sequence[Plant],
        noise: FloatArray | None = None,
    ) -> None:
        """Put some robots at rest: arms at ``theta``, objects upright.

        Args:
            rows: Which, (r,).
            theta: (3,) rad, by the encoders.
            objects: For each of them centre (3,) m, world, of the scene's objects by name.
            plants: For each of them the true machine.
            noise: Of the first reading of the encoders, (3, n) rad.
        """
        self._become(rows, plants)
        angles = np.array(theta, dtype=np.float64)[:, None]
        self._theta[:, rows] = angles - self._bias[:, rows]
        self._rates[:, rows] = self._torque[:, rows] = 0.0
        self._left[:, rows] = False
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
            name = self.scene.objects[0].name
            self._pucks.place(rows, np.array([one[name] for one in objects]))

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
        self._exact = self._exact and not any(lengths) and not self._bias[:, rows].any()
        masses, friction = (
            [getattr(p, name) for p in plants] for name in ("puck_mass", "friction")
        )
        self._pucks.alter(rows, np.array(masses), np.array(friction))

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
        before, last = self._commands
        first, second, third = self._weights
        path = first * before[:, None] + second * last[:, None] + third * new[:, None]
        self._commands = np.stack([last, new])
        tail, path = self._follow(path)
        push = self._touch(path, vacuum)
        self._before, self._truth = path[:, -2].copy(), path[:, -1].copy()
        self._drive(tail, push)
        self._noise[0] = self._noise[1]
        self._noise[1] = 0.0 if noise is None else noise
        self._read(slice(None))

    def _follow(self, path: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where ideal motors go for P to be on ``path`` (3, K, n) m, and where it is then.

        Returns:
            theta (3, 3, n) rad at the last three time steps, and the true way of P (3, K, n) m.
        """
        if self._exact:
            return self._nominal.inverse(path[:, -3:]), path
        theta = self._nominal.inverse(path) - self._bias[:, None]
        reading = self._true.evaluate(theta)
        self._left[0] |= ~np.isfinite(reading.position).all(axis=(0, 1))
        self._left[1] |= ~reading.working.all(axis=0) & ~self._left[0]
        return theta[:, -3:], reading.position

    def _touch(self, path: FloatArray, vacuum: BoolArray) -> FloatArray | None:
        """Let the objects and cups do what they do along the way of P; the last force on P, N."""
        if not self.scene.objects:
            return None
        whole = np.concatenate([self._before[:, None], self._truth[:, None], path], axis=1)
        world = self._mount[:, None] + whole * _TURNED[:, None]
        push = self._pucks.advance(slice(None), world.transpose(1, 0, 2), vacuum)
        last: FloatArray = push[-1] * _TURNED
        return last

    def _drive(self, theta: FloatArray, push: FloatArray | None) -> None:
        """Torques that take the motors through their last three angles (3, 3, n) rad."""
        h = self._step
        before, at, now = theta[:, 0], theta[:, 1], theta[:, 2]
        rate, self._rates = (at - before) / h, (now - at) / h
        self._theta = now.copy()
        if self.physics.torques == "none":
            self._torque[:] = np.nan
            return
        change = (self._rates - rate) / h
        self._torque = self._true.torque(at, rate, change, push)

    @property
    def commands(self) -> FloatArray:
        """Where point P is commanded to go, (n, 3) m, machine's frame."""
        commands: FloatArray = self._commands[1].T
        return commands

    # -- reading ----------------------------------------------------------------------------

    def _read(self, rows: IntArray | slice) -> None:
        """Read the encoders, and what follows; what makes no sense leaves the last that did."""
        theta, _ = self._encoders(rows)
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

    def _encoders(self, rows: IntArray | slice) -> tuple[FloatArray, FloatArray]:
        """Angles (rad) and rates (rad/s) that the encoders report, (3, r) each."""
        earlier, noise = self._noise[:, :, rows]
        theta = self._theta[:, rows] + self._bias[:, rows] + noise
        return theta, self._rates[:, rows] + (noise - earlier) / CONTROL_PERIOD

    def state(self) -> State:
        """What is known of all robots, with a leading axis (n,)."""
        theta, rates = self._encoders(slice(None))
        j, (a, b, c) = self._jacobian, rates
        velocity = j[:, 0] * a + j[:, 1] * b + j[:, 2] * c
        zero = np.zeros(self.count)
        return State(
            theta=_rows(theta),
            theta_dot=_rows(rates),
            torque=_rows(self._torque),
            fk_position=_rows(self._to_world(self._position)),
            fk_velocity=_rows(velocity * _TURNED),
            conditioning=self._conditioning.copy(),
            platform_position=_rows(self._to_world(self._truth)),
            platform_tilt=zero,
            closure_error=zero,
            assembly_mode_changed=self._left[0].copy(),
            working_mode_changed=self._left[1].copy(),
            command=_rows(self._to_world(self._commands[1])),
            **self._pucks.report(),
        )

    def save(self, rows: IntArray | slice = slice(None)) -> Moment:
        """Take down everything that the next steps of some robots depend on."""
        columns = {name: getattr(self, name)[..., rows].copy() for name in _COLUMNS}
        plants = tuple(self._plants[row] for row in np.arange(self.count)[rows].tolist())
        return Moment(plants, columns, self._pucks.save(rows))

    def restore(self, moment: Moment, rows: IntArray | slice = slice(None)) -> None:
        """Go back to what ``save`` returned, for as many robots."""
        self._become(np.arange(self.count)[rows], moment.plants)
        for name, values in moment.columns.items():
            getattr(self, name)[..., rows] = values
        self._pucks.restore(rows, moment.pucks)

    def _to_world(self, position: FloatArray) -> FloatArray:
        world: FloatArray = self._mount + position * _TURNED
        return world


def _rows(columns: FloatArray) -> FloatArray:
    """Components (3, n) as (n, 3)."""
    return np.ascontiguousarray(columns.T)
