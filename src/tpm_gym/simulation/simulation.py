"""Simulation of n robots with any engine.

The engine simulates the robots. This module adds encoder errors, records which robots have left
their assembly mode or working mode, and computes the State.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.arrays import BoolArray, FloatArray, IntArray, finite
from tpm_gym.errors import ClosureError, ConfigurationError, InputError
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.machine import Machine
from tpm_gym.mechanism.tpm import PAPER_TPM
from tpm_gym.simulation.drives import Servo, require_servo
from tpm_gym.simulation.engine import Engine, Path, loops, make_engine, spline_weights
from tpm_gym.simulation.imaging import Camera, Picture, View, paint_markers, paint_shadows
from tpm_gym.simulation.randomisation import NOMINAL, Plant
from tpm_gym.simulation.settings import count_steps
from tpm_gym.simulation.state import CONTROL_PERIOD, Scene, State

CLOSURE_LIMIT = 0.005
"""Largest allowed gap at a loop closure, m."""

_STEPS = 10  # time steps of a control period other than 40 ms, if the settings have no time step

_BLUR = 0.05
"""Distance of P from the mirror plane at which the observed velocity normal to it is halved.

The distance is a fraction of the machine's ``step_limit`` along ``mirror_axis``, which is normal to
the plane. If P is in the plane, encoders do not show its velocity normal to the plane. So this
component of J theta_dot is multiplied by d^2 / (d^2 + h^2), where d is the distance of P from the
plane, and h is the distance that this constant defines.
"""

_COLUMNS = (
    *("commands", "noise", "position", "jacobian", "conditioning", "mode_left", "bias"),
    "belt_speed",
)


@dataclass(frozen=True)
class Snapshot:
    """Saved state of a :class:`Simulation`; the state determines all later steps.

    Attributes:
        plants: Plant of each of the n robots.
        columns: Arrays (n, ...) that :class:`Simulation` keeps outside the engine, by name.
        engine: Saved state of the engine, from :meth:`Engine.save`.
    """

    plants: tuple[Plant, ...]
    columns: dict[str, NDArray[Any]]
    engine: Any


class Simulation:
    """n robots in one engine, each over its own table.

    Control and forward kinematics use the nominal ``machine``. The engine simulates the true
    machine of each robot, which its :class:`~tpm_gym.simulation.Plant` defines.

    Args:
        scene: Objects on each table.
        machine: Nominal machine.
        engine: Name of the engine.
        count: Number of robots, n.
        control_period: Time between two commands, s.
        physics: Numerical settings of the engine; None for the engine's defaults. If the settings
            have no time step, a control period of 40 ms has time steps of the engine's default
            length, and any other control period is divided into ten time steps.
        drive: Servo drives of the motors; None for ideal drives.
        gui: Whether to open a window.
        renderer: Renderer of the pictures; None for the engine's default.

    Attributes:
        loops: Compiled functions, :mod:`tpm_gym.simulation.compiled`.
        commands: (n, 3) m, commanded positions of point P, machine's frame.
        recent: (n, 2, 3) m, the last two commands, oldest first.

    Raises:
        ConfigurationError: If an option is out of range, or the engine does not support it.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        machine: Machine = PAPER_TPM,
        engine: str = "pybullet",
        count: int = 1,
        control_period: float = CONTROL_PERIOD,
        physics: Any = None,
        drive: Servo | None = None,
        gui: bool = False,
        renderer: str | None = None,
    ) -> None:
        """Create the engine and load the robots."""
        self.loops = loops()
        self.scene, self.machine, self.count, self.drive = scene, machine, count, drive
        self.control_period = control_period
        usual = control_period == CONTROL_PERIOD
        self.engine: Engine = make_engine(
            engine,
            gui=gui,
            renderer=renderer,
            physics=physics,
            drive=drive,
            time_step=None if usual else control_period / _STEPS,
        )
        try:
            least = getattr(self.engine, "least_steps", 1)
            steps = count_steps(control_period, self.engine.time_step, least)
            self.engine.load(machine, scene, count)
        except BaseException:
            self.close()
            raise
        self._plants = [NOMINAL] * count
        self._weights = spline_weights(steps)
        self._frame = machine.mount.frame
        self._region = np.array(machine.region.low), np.array(machine.region.high)
        # The last two commands and the next command, machine's frame, m
        self._commands = np.zeros((count, 3, 3))
        self.commands, self.recent = self._commands[:, 1], self._commands[:, :2]
        self._noise = np.zeros((count, 2, 3))  # noise of the last two encoder readings, rad
        self._bias = np.zeros((count, 3))  # encoder bias, rad
        self._disturbed = False  # whether any encoder has bias or noise
        self._position = np.zeros((count, 3))  # P by forward kinematics, machine's frame, m
        self._jacobian = np.zeros((count, 3, 3))
        self._conditioning = np.zeros(count)
        self._mode_left = np.zeros(count, dtype=np.int8)
        self._belt_speed = np.zeros(count)
        self._state: State | None = None  # None until the engine is read after a move or reset

    def reset(
        self,
        rows: IntArray,
        theta: ArrayLike,
        objects: Mapping[str, FloatArray] | None = None,
        plants: Sequence[Plant] | None = None,
        noise: FloatArray | None = None,
        belt_speed: FloatArray | None = None,
    ) -> None:
        """Place robots at rest at ``theta``, with closed loops and upright objects.

        Args:
            rows: (r,) robots to place.
            theta: (3,) or (r, 3) rad, joint positions as the encoders report them without noise.
            objects: Centres (r, 3) m, world, of objects by name. Objects without an entry are
                placed in the middle of the table.
            plants: Plant of each of the r robots; None for nominal robots.
            noise: (r, 3) rad, noise of the first encoder reading; None for zero.
            belt_speed: (r,) m/s, speeds of the belts' surfaces along x; None for zero.

        Raises:
            ConfigurationError: If a plant needs servo drives, but the drives are ideal, or a speed
                is given for a scene without a belt.
            InputError: If theta or a position is not three finite numbers, or the scene has no
                object with a name in ``objects``; no robot has moved then.
            UnreachableError: If a robot cannot be assembled at theta; no robot has moved then.
            JointLimitError: If a motor is beyond a stop at theta; no robot has moved then.
        """
        if belt_speed is not None and self.scene.belt is None:
            raise ConfigurationError("belt_speed", belt_speed, "None: the scene has no belt")
        plants = [NOMINAL] * len(rows) if plants is None else plants
        nominal = plants.count(NOMINAL) == len(plants)
        for plant in () if nominal else plants:
            require_servo(self.drive, plant.servo_stiffness, plant.joint_friction)
        angles = finite("theta", theta, (3,) if np.ndim(theta) < 2 else (len(rows), 3))
        reading = self.machine.require_evaluate(angles)
        bias = np.zeros((len(plants), 3))
        if not nominal:
            bias[:] = [plant.encoder_bias for plant in plants]
        true = angles - bias
        self.machine.require_within_stops(true)
        if not nominal and any(plant.length_errors for plant in plants):
            lengths = [plant.lengths_of(self.machine) for plant in plants]
            self.machine.require_evaluate(true, np.array([*map(self.machine.built, lengths)]))
        placed = self._places(len(rows), objects or {})
        if self.scene.belt is not None:
            speeds = np.zeros(len(rows)) if belt_speed is None else belt_speed
            self._belt_speed[rows] = self.scene.belt.require(speeds, len(rows), InputError)
        self._become(rows, plants)
        if self.scene.belt is not None:
            self.engine.set_belt(rows, self._belt_speed[rows])
        self.engine.place(rows, true, placed)
        self._commands[rows] = reading.position[..., None, :]
        self._bias[rows], self._mode_left[rows] = bias, 0
        self._noise[rows] = 0.0 if noise is None else noise[:, None]
        self._disturbed = bool(self._bias.any() or self._noise.any())
        if self._disturbed:
            # state() uses these values if no assembly exists at the first reading. The machine may
            # own the old arrays, so they are copied before they are changed.
            columns = self._position, self._jacobian, self._conditioning
            self._position, self._jacobian, self._conditioning = map(np.copy, columns)
            self._position[rows], self._jacobian[rows] = reading.position, reading.jacobian
            self._conditioning[rows] = reading.conditioning
        self._state = None

    def _places(self, count: int, objects: Mapping[str, ArrayLike]) -> FloatArray:
        """Return upright poses (r, k, 7) of the scene's k objects, for r = ``count`` robots.

        ``objects`` has centres (r, 3) m, world, by name. Objects without an entry are placed in the
        middle of the table.
        """
        places = np.zeros((count, len(self.scene.objects), 7))
        places[..., 6] = 1.0
        names = [block.name for block in self.scene.objects]
        if not set(names).issuperset(objects):
            raise InputError("objects", list(objects), f"of objects of the scene: {names}")
        for index, block in enumerate(self.scene.objects):
            places[:, index, 2] = block.height / 2
            if block.name in objects:
                places[:, index, :3] = finite(block.name, objects[block.name], (count, 3))
        return places

    def _become(self, rows: IntArray, plants: Sequence[Plant]) -> None:
        """Apply new plants to robots whose plants change."""
        before = [self._plants[row] for row in rows.tolist()]
        changed = [
            k
            for k, (old, new) in enumerate(zip(before, plants, strict=True))
            if old is not new and old != new
        ]
        if changed:
            self.engine.alter(rows[changed], [plants[k] for k in changed])
        for k in changed:
            self._plants[rows[k]] = plants[k]

    def move(
        self, commands: FloatArray, vacuum: BoolArray, noise: FloatArray | None = None
    ) -> None:
        """Command point P and simulate one control period.

        Args:
            commands: (n, 3) m, machine's frame; the caller projects them into the region.
            vacuum: (n,) whether the vacuum is on.
            noise: (n, 3) rad, noise of the encoder reading after this period; None for zero.

        Raises:
            UnreachableError: If a command is out of reach; no robot has moved then.
            JointLimitError: If a motor would be beyond a stop; no robot has moved then.
            ClosureError: If a loop had opened before; see :meth:`state`.
        """
        self.state()
        if not self.loops.all_within(commands, *self._region):
            # The path ends halfway between the last two commands, so the engine would accept some
            # commands that are out of reach.
            self.machine.reach(commands)
        self._commands[:, 2] = commands
        bias = self._bias if self._disturbed else None
        self.engine.advance(Path(self.machine, self._commands, self._weights, bias), vacuum)
        # Two assignments: numpy would copy overlapping slices, which takes longer.
        self._commands[:, 0] = self._commands[:, 1]
        self._commands[:, 1] = commands
        if self._disturbed or noise is not None:
            self._noise[:, 0] = self._noise[:, 1]
            self._noise[:, 1] = 0.0 if noise is None else noise
            self._disturbed = bool(self._bias.any() or self._noise.any())
        self._state = None

    @property
    def mode_left(self) -> NDArray[np.int8]:
        """First mode that each robot has left in this episode, (n,).

        0 stands for no mode, 1 for the assembly mode, 2 for the working mode.
        """
        self.state()
        return self._mode_left

    def state(self) -> State:
        """Return the state of all robots. The engine is read once after each move or reset.

        Raises:
            ClosureError: If a loop has opened.
        """
        if self._state is not None:
            return self._state
        now = self.engine.read()
        theta, rates = now.theta, now.theta_dot
        if self._disturbed:
            before, last = self._noise[:, 0], self._noise[:, 1]
            theta = theta + self._bias + last
            rates = rates + (last - before) / self.control_period
        position, jacobian, conditioning, _ = self.machine.evaluate(theta)
        if np.isnan(conditioning).any():
            # With bias and noise, the encoders may report joint positions at which no assembly
            # exists. Then the last valid result is kept, as a real controller would do.
            lost = np.isnan(conditioning)
            position, jacobian, conditioning = map(np.array, (position, jacobian, conditioning))
            position[lost], jacobian[lost] = self._position[lost], self._jacobian[lost]
            conditioning[lost] = self._conditioning[lost]
        self._position, self._jacobian, self._conditioning = position, jacobian, conditioning
        if self.machine.mirror_axis is not None:
            position, jacobian = self._mirrored(now.position, rates, position, jacobian)
        gap = now.gap
        place, velocity, command, axis, assembly, working, closed = self.loops.in_world(
            position, jacobian, rates, self._commands,
            np.ascontiguousarray(now.object_quaternion), now.mode_left, self._mode_left,
            gap, CLOSURE_LIMIT, *self._frame,
        )  # fmt: skip
        if not closed:
            raise ClosureError(float(gap.max()), CLOSURE_LIMIT)
        self._state = State(
            theta=theta,
            theta_dot=rates,
            torque=now.torque,
            fk_position=place,
            fk_velocity=velocity,
            conditioning=conditioning.copy(),
            platform_position=now.position,
            platform_tilt=now.tilt,
            closure_error=gap,
            assembly_mode_changed=assembly,
            working_mode_changed=working,
            command=command,
            held=now.held,
            vacuum=now.vacuum,
            object_position=now.object_position,
            object_quaternion=now.object_quaternion,
            object_axis=axis,
            object_velocity=now.object_velocity,
            object_angular_velocity=now.object_angular_velocity,
            belt_speed=self._belt_speed.copy(),
        )
        return self._state

    def _mirrored(
        self, truth: FloatArray, rates: FloatArray, position: FloatArray, jacobian: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Mirror P (n, 3) m and J (n, 3, 3) of robots whose P is not on home's side of a plane.

        This mirror plane is normal to ``mirror_axis``. A point P and its mirror image have the
        same joint positions, so encoders do not show on which side of the plane P is. The sign of a
        passive joint's position shows the side. A switch would measure this sign on a real robot.

        P may turn back at the plane although its commands lead through the plane. P is then on one
        side, and the path of the commands ends on the other side. If the end of this path is more
        than a step limit from the plane, the stored commands are mirrored too, to the side of P.
        This does not change the joint positions on the path.

        Args:
            truth: (n, 3) m, P of the platform, world.
            rates: (n, 3) rad/s, joint velocities as the encoders report them.
            position: P by forward kinematics in the machine's assembly mode.
            jacobian: J at ``position``.
        """
        machine = self.machine
        axis = machine.mirror_axis or 0
        there, limit = machine.mount.to_paper(truth)[:, axis], machine.step_limit[axis]
        sign = np.where(there * machine.home[axis] < 0, -1.0, 1.0)
        position, jacobian = position.copy(), jacobian.copy()
        position[:, axis] *= sign
        # In the plane, J is infinite, and encoders do not show the velocity normal to the plane. So
        # the observed velocity falls to zero there.
        distance, blur = position[:, axis], _BLUR * limit
        jacobian[:, axis] *= (sign * distance**2 / (distance**2 + blur**2))[:, None]
        # Next to the plane, J theta_dot has no bound. So clip it to twice the fastest command.
        speed, most = np.abs((jacobian[:, axis] * rates).sum(axis=1)), 2 * limit / CONTROL_PERIOD
        jacobian[:, axis] *= (most / np.maximum(speed, most))[:, None]
        reached = self.recent[:, :, axis].mean(axis=1)  # end of the path
        turned = (there * reached < 0) & (np.abs(reached) > limit)
        self._commands[turned, :, axis] *= -1.0
        return position, jacobian

    def save(self) -> Snapshot:
        """Return a snapshot, and restart from the snapshot.

        Engines have state that cannot be read, such as impulses of old contacts. The restart
        clears this state, so that continuing and :meth:`restore` give equal results.
        """
        self.state()
        columns = {name: getattr(self, f"_{name}").copy() for name in _COLUMNS}
        snapshot = Snapshot(tuple(self._plants), columns, self.engine.save())
        self.restore(snapshot)
        return snapshot

    def restore(self, snapshot: Snapshot) -> None:
        """Continue from a snapshot of this simulation, or of one with equal arguments."""
        self._become(np.arange(self.count), snapshot.plants)
        for name, values in snapshot.columns.items():
            setattr(self, f"_{name}", values.copy())
        if self.scene.belt is not None:
            self.engine.set_belt(np.arange(self.count), self._belt_speed)
        self.engine.restore(snapshot.engine)
        self.commands, self.recent = self._commands[:, 1], self._commands[:, :2]
        self._disturbed = bool(self._bias.any() or self._noise.any())
        self._state = None

    def picture(self, view: View, markers: ArrayLike = (), row: int = 0) -> Picture:
        """Draw a robot and its scene.

        Args:
            view: Camera, size, and whether the picture includes the ids of bodies.
            markers: (k, 3) m, world, goal markers. They change the colours, but not depth and ids.
            row: Robot.
        """
        camera = view.camera.following(self.state().platform_position[row])
        view = view._replace(camera=camera)
        picture = self.engine.picture(row, view)
        paint_shadows(picture, view, self._casters(row))
        paint_markers(picture, view, markers, self.scene.marker_radius)
        return picture

    def _casters(self, row: int) -> list[list[float]]:
        """Return position and radius, (k, 4) m, of the bodies with a shadow: cup and objects."""
        now = self.state()
        x, y, z = now.platform_position[row].tolist()
        widths = [block.width / 2 for block in self.scene.objects]
        places = now.object_position[row].tolist()
        objects = [[*place, half] for place, half in zip(places, widths, strict=True)]
        return [[x, y, z - CUP.length, CUP.radius], *objects]

    def show(self, camera: Camera, markers: FloatArray) -> None:
        """Update the window with the first robot and goal markers (k, 3) m, world."""
        self.engine.show(camera.following(self.state().platform_position[0]), markers)

    def close(self) -> None:
        """Close the engine; a second call does nothing."""
        self.engine.close()
