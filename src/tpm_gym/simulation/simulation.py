"""The simulated machine, whatever engine moves it.

References along a spline, the encoders' errors, what follows from the encoders, whether loops are
closed and modes kept, and the :class:`~tpm_gym.simulation.state.State` that tells it all.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from operator import sub
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.arrays import FloatArray, Vector, rotate, vector
from tpm_gym.errors import ClosureError, ModeChangeError
from tpm_gym.mechanism.machine import MODES, Machine, Reading
from tpm_gym.mechanism.tpm import PAPER_TPM
from tpm_gym.simulation.drives import Reference, Servo, references, require_servo
from tpm_gym.simulation.engine import SIMULATIONS, Engine, Pose, make_engine
from tpm_gym.simulation.randomisation import NOMINAL, Plant
from tpm_gym.simulation.state import CONTROL_PERIOD, Scene, State

__all__ = ["Simulation", "Snapshot", "make_simulation"]

CLOSURE_LIMIT = 0.005
"""A loop that is open by more than this is lost, m."""

_ZERO: Vector = (0.0, 0.0, 0.0)
_UP: Vector = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Snapshot:
    """Everything that the next steps of a :class:`Simulation` depend on."""

    plant: Plant
    engine: Any
    torque: Vector
    commands: tuple[Vector, Vector]
    noise: tuple[Vector, Vector]
    reading: Reading
    mode_left: str | None


def make_simulation(scene: Scene, *, engine: str, **options: Any) -> Simulation:
    """The simulation with that engine; the options are those of :class:`Simulation`.

    Raises:
        ConfigurationError: If an option is out of range, or the engine cannot do it.
    """
    if engine not in SIMULATIONS:
        return Simulation(scene, engine=engine, **options)
    module, _, name = SIMULATIONS[engine].partition(":")
    made: Simulation = getattr(importlib.import_module(module), name)(scene, **options)
    return made


class Simulation:
    """One robot over one table in one engine of its own.

    What control and encoders believe in is ``machine``; the true one is that of the
    :class:`~tpm_gym.simulation.randomisation.Plant` of the episode.

    Args:
        scene: What stands on the table besides the robot.
        machine: The nominal machine.
        engine: Name of the engine.
        physics: The engine's numerical settings; None for its own.
        drive: The motors' servo drives; None for ideal ones.
        gui: Whether to open a window.
        renderer: What draws pictures; None for the engine's own choice.

    Raises:
        ConfigurationError: If an option is out of range, or the engine cannot do it.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        machine: Machine = PAPER_TPM,
        engine: str = "pybullet",
        physics: Any = None,
        drive: Servo | None = None,
        gui: bool = False,
        renderer: str | None = None,
    ) -> None:
        """Start the engine and load."""
        self.scene, self.machine = scene, machine
        self.drive = drive
        self.engine: Engine = make_engine(
            engine, gui=gui, renderer=renderer, physics=physics, drive=drive
        )
        try:
            self._load(machine, NOMINAL.length_errors)
        except BaseException:
            self.close()
            raise
        self._torque = _ZERO  # of the motors in the last time step, N m
        self._commands = (_ZERO, _ZERO)  # the last two, machine's frame, m
        self._noise = (_ZERO, _ZERO)  # of the last two readings of the encoders, rad
        self._reading: Reading  # the last one that made sense
        self._mode_left: str | None = None
        self._spline: list[list[float]] = spline_weights(self.engine.substeps).tolist()

    def _load(self, machine: Machine, lengths: tuple[float, ...]) -> None:
        """Fill the engine with a machine off by ``lengths`` (m) and all that stands around it."""
        self._true_machine = machine
        self.engine.load(machine, self.scene)
        self.plant = Plant(length_errors=lengths)

    def _true(self, plant: Plant) -> Machine:
        """The machine of that plant."""
        same = plant.length_errors == self.plant.length_errors
        return self._true_machine if same else plant.of(self.machine)

    def _become(self, plant: Plant, machine: Machine) -> None:
        """Make the simulated machine that of ``plant``, whose lengths ``machine`` has."""
        if plant == self.plant:
            return
        if machine is not self._true_machine:
            self._load(machine, plant.length_errors)
        self.engine.alter(plant)
        self.plant = plant

    # -- running ----------------------------------------------------------------------------

    def reset(
        self,
        theta: ArrayLike,
        objects: Mapping[str, ArrayLike] | None = None,
        plant: Plant = NOMINAL,
        noise: Vector = _ZERO,
    ) -> State:
        """Put everything at rest: the arms at ``theta``, the loops closed, the objects upright.

        Args:
            theta: (3,) rad, by the encoders.
            objects: Centre (3,) m, world, of each of the scene's objects by name; where one is not
                named it stands on the table, in the middle.
            plant: The true machine.
            noise: Of the first reading of the encoders, rad.

        Raises:
            ConfigurationError: If the plant differs in what only a servo drive has.
            InputError: If theta or a position is not three finite numbers.
            UnreachableError: If the mechanism cannot be assembled at theta.
            JointLimitError: If a motor is beyond a stop there; nothing has moved then.
        """
        require_servo(self.drive, plant.servo_stiffness, plant.joint_friction)
        angles = vector("theta", theta)
        reading = self.machine.require_evaluate(angles)
        a, b, c = (angle - bias for angle, bias in zip(angles, plant.encoder_bias, strict=True))
        true_machine = self._true(plant)
        true_machine.require_within_stops((a, b, c))
        joints = true_machine.joint_positions((a, b, c))
        placed = self._poses(objects or {})
        self._become(plant, true_machine)
        self.engine.place(joints, placed)
        self._torque = _ZERO
        # What is true of the nominal machine, in case the encoders' errors make no sense.
        self._reading = reading
        self._mode_left, self._noise = None, (noise, noise)
        x, y, z = reading.position.tolist()
        self._commands = ((x, y, z),) * 2
        return self.read()

    def _poses(self, objects: Mapping[str, ArrayLike]) -> list[Pose]:
        """Upright poses of the scene's objects, in its order."""
        return [
            Pose(vector(block.name, objects.get(block.name, (0.0, 0.0, block.height / 2))))
            for block in self.scene.objects
        ]

    def show_goal(self, markers: FloatArray) -> None:
        """Move the goal markers to ``markers`` (k, 3) m, world."""
        self.engine.show_goal([(x, y, z) for x, y, z in markers.tolist()])

    def move(self, command: ArrayLike, vacuum: bool = False, noise: Vector = _ZERO) -> State:
        """Command point P to ``command`` and run one control period.

        The motors follow a quadratic B-spline through the commands: it lags the commands by half a
        period, stays in their convex hull, and keeps the accelerations finite. It is a curve of
        point P, not of the joints: near a singularity, a straight line between two postures would
        wander by centimetres.

        Args:
            command: (3,) m, machine's frame; inside the region (the caller projects).
            vacuum: Whether the cup sucks.
            noise: Of the encoders' reading at the end, rad.

        Raises:
            InputError: If the command has the wrong shape or is not finite.
            UnreachableError: If the command is out of reach; nothing has moved then.
            JointLimitError: If a motor would be beyond a stop there; nothing has moved then.
            ModeChangeError: If the mechanism has left its assembly or working mode before.
            ClosureError: If a loop opened.
        """
        if self._mode_left is not None:
            raise ModeChangeError(self._mode_left)
        before, last = self._commands
        new = vector("command", command)
        # The spline may end before the command does.
        a, b, c = map(sub, self.machine.require_inverse(new).tolist(), self.plant.encoder_bias)
        self.machine.require_within_stops((a, b, c))
        followed = self._references(before, last, new)
        self._commands = (last, new)
        self.engine.advance(followed, vacuum)
        self._noise = (self._noise[1], noise)
        return self.read(moved=True)

    def _references(self, before: Vector, last: Vector, new: Vector) -> list[Reference]:
        """Where the motors shall be along the spline through three commands (m)."""
        bias, commands = self.plant.encoder_bias, np.array([before, last, new])
        path = list(map(_triple, self.machine.require_inverse(np.array(self._spline) @ commands)))
        if self.drive is None:
            found = list(map(Reference, path))
        else:
            start = _triple(self.machine.require_inverse((commands[0] + commands[1]) / 2))
            found = references(self.machine, self.drive, start, path, CONTROL_PERIOD / len(path))
        if bias != _ZERO:
            b1, b2, b3 = bias
            found = [
                Reference((one - b1, two - b2, three - b3), rates, torque)
                for (one, two, three), rates, torque in found
            ]
        return found

    # -- reading ----------------------------------------------------------------------------

    def read(self, moved: bool = False) -> State:
        """Read the encoders, what follows from them, and the truth.

        Args:
            moved: Whether a time step has been run since everything was put in its place.

        Raises:
            ClosureError: If a loop is open.
        """
        true_theta, true_rates, torque = self.engine.motors()
        gap, platform, tilt = self.engine.truth()
        if not gap <= CLOSURE_LIMIT:  # so that a NaN fails too
            raise ClosureError(gap, CLOSURE_LIMIT)
        if moved:
            self._torque = torque
        theta, rates = self._disturb(true_theta, true_rates)
        position, jacobian, conditioning, _ = self._evaluate(theta)
        mount, hold = self.machine.mount, self.engine.hold()
        if self._mode_left is None:
            left = self._true_machine.mode_left(true_theta, mount.swap(platform))
            self._mode_left = MODES[int(left)]
        r1, r2, r3 = rates
        x, y, z = [a * r1 + b * r2 + c * r3 for a, b, c in jacobian.tolist()]
        swap = mount.swap
        place, speed = swap(_triple(position)), mount.turn((x, y, z))
        command = swap(self._commands[1])
        # All in one array cost half of what an array of each does.
        numbers = [*theta, *rates, *self._torque, *place, *speed, *platform, *command]
        for (where, turn), (velocity, spin) in self.engine.objects():
            numbers += (*where, *turn, *rotate(turn, _UP), *velocity, *spin)
        array = np.array(numbers)
        objects = array[21:].reshape(-1, 16)
        return State.of(
            {
                "theta": array[0:3],
                "theta_dot": array[3:6],
                "torque": array[6:9],
                "fk_position": array[9:12],
                "fk_velocity": array[12:15],
                "conditioning": float(conditioning),
                "platform_position": array[15:18],
                "platform_tilt": tilt,
                "closure_error": gap,
                "assembly_mode_changed": self._mode_left == "assembly",
                "working_mode_changed": self._mode_left == "working",
                "command": array[18:21],
                "held": hold.which,
                "vacuum": hold.vacuum,
                "object_position": objects[:, 0:3],
                "object_quaternion": objects[:, 3:7],
                "object_axis": objects[:, 7:10],
                "object_velocity": objects[:, 10:13],
                "object_angular_velocity": objects[:, 13:16],
            }
        )

    def _disturb(self, theta: Vector, rates: Vector) -> tuple[Vector, Vector]:
        """What the encoders report: with their bias and noise, and rates by differences."""
        bias, (before, now) = self.plant.encoder_bias, self._noise
        if bias == before == now == _ZERO:
            return theta, rates
        return (
            vector("theta", np.array(theta) + bias + now),
            vector("theta_dot", rates + np.subtract(now, before) / CONTROL_PERIOD),
        )

    def _evaluate(self, theta: Vector) -> Reading:
        """What follows from the encoders; the last reading that made sense where this one does not.

        That is what a controller can do whose disturbed encoders report angles at which no assembly
        exists, as happens near the edges of the workspace.
        """
        reading = self.machine.evaluate(theta)
        if np.isnan(reading.conditioning):
            reading = self._reading
        self._reading = reading
        return reading

    # -- state, pictures, end -----------------------------------------------------------------

    def save(self) -> Snapshot:
        """Take down everything that the physics depend on, and go on from exactly that.

        Engines keep memories that cannot be read out, such as the impulses of old contacts. So that
        what follows here and what follows a :meth:`restore` are equal to the last bit, they are
        dropped here too.
        """
        snapshot = Snapshot(
            plant=self.plant,
            engine=self.engine.save(),
            torque=self._torque,
            commands=self._commands,
            noise=self._noise,
            reading=self._reading,
            mode_left=self._mode_left,
        )
        self.restore(snapshot)
        return snapshot

    def restore(self, snapshot: Snapshot) -> State:
        """Go back to a moment that :meth:`save` took down, of this or an equal simulation."""
        self._become(snapshot.plant, self._true(snapshot.plant))
        self.engine.restore(snapshot.engine)
        self._torque = snapshot.torque
        self._commands, self._noise = snapshot.commands, snapshot.noise
        self._reading, self._mode_left = snapshot.reading, snapshot.mode_left
        return self.read()

    def render(self, width: int, height: int) -> NDArray[np.uint8]:
        """Draw the scene as (height, width, 3) RGB."""
        return self.engine.picture(width, height)

    def close(self) -> None:
        """Close the engine; harmless the second time."""
        self.engine.close()


def spline_weights(substeps: int) -> FloatArray:
    """(substeps, 3) weights of the last three commands along the quadratic B-spline."""
    s = np.arange(1, substeps + 1) / substeps
    return np.stack([(1 - s) ** 2, 1 + 2 * s - 2 * s**2, s**2], axis=1) / 2


def _triple(array: FloatArray) -> Vector:
    a, b, c = array.tolist()
    return a, b, c
