"""The mechanism in the physics engine: one robot over one table.

The legs are loaded from generated URDF; the loops are closed by point-to-point constraints. A reset
sets every joint, passive ones too, to the closed-form angles, so an episode starts with the loops
closed to better than a micrometre.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.errors import (
    ClosureError,
    InputError,
    ModeChangeError,
    SingularityError,
    UnreachableError,
)
from tpm_gym.kinematics import equations
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.kinematics.modes import DEFAULT_ASSEMBLY, ELBOWS_OUT
from tpm_gym.mechanism.bodies import Vector
from tpm_gym.mechanism.tree import DEFAULT_MOUNT, Mount, build, joint_angles
from tpm_gym.simulation.bullet.client import Client
from tpm_gym.simulation.bullet.cup import Cup, Pose
from tpm_gym.simulation.bullet.robot import Robot
from tpm_gym.simulation.bullet.scenery import AT_REST, UPRIGHT, Scenery
from tpm_gym.simulation.physics import (
    ASSEMBLY_LIMIT,
    CLOSURE_LIMIT,
    Physics,
    rotate,
    spline_weights,
)
from tpm_gym.simulation.randomisation import NOMINAL, Plant
from tpm_gym.simulation.state import Scene, State

__all__ = ["Simulation", "Snapshot"]

Reading = tuple[equations.Assembly, tuple[Vector, Vector, Vector], float]
"""What follows from the encoders: the assembly, the rows of J, the conditioning."""
_ZERO: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Snapshot:
    """Everything that the next steps of a :class:`Simulation` depend on."""

    plant: Plant
    joints: tuple[tuple[float, float], ...]
    torque: Vector
    commands: tuple[Vector, Vector]
    noise: tuple[Vector, Vector]
    reading: Reading
    mode_change: str | None
    object_pose: Pose | None
    object_velocity: Pose | None
    grip: Pose | None


class Simulation:
    """One robot over one table in one private physics client.

    The lengths that control and encoders believe in are ``geometry``; the true ones are those of
    the :class:`~tpm_gym.simulation.randomisation.Plant` of the episode.

    Args:
        scene: What stands on the table besides the robot.
        geometry: Nominal link lengths.
        mount: Where the base hangs.
        physics: Numerical settings.
        gui: Whether to open PyBullet's window.
        renderer: ``"tiny"`` draws on the CPU anywhere; ``"egl"`` on a GPU, where the driver has it.

    Raises:
        ConfigurationError: If an option is out of range, or EGL was asked for and is not there.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        geometry: Geometry = PAPER,
        mount: Mount = DEFAULT_MOUNT,
        physics: Physics | None = None,
        gui: bool = False,
        renderer: str = "tiny",
    ) -> None:
        """Connect, load and close the loops."""
        self.scene, self.geometry, self.mount = scene, geometry, mount
        self.physics = Physics() if physics is None else physics
        self._gui, self._renderer = gui, renderer
        self._client = Client(self.physics, gui, renderer)
        try:
            self._load(NOMINAL)
        except BaseException:
            self.close()
            raise
        self._torque = _ZERO  # of the motors in the last time step, N m
        self._commands = (_ZERO, _ZERO)  # the last two, paper frame, m
        self._noise = (_ZERO, _ZERO)  # of the last two readings of the encoders, rad
        self._reading: Reading  # the last one that made sense
        self._mode_change: str | None = None
        self._spline: list[list[float]] = spline_weights(self.physics.substeps).tolist()

    # -- building ---------------------------------------------------------------------------

    def _load(self, plant: Plant) -> None:
        """Fill the empty client with the robot of that plant and all that stands around it."""
        self._true_geometry = plant.geometry(self.geometry)
        self.mechanism = build(self._true_geometry)
        self._robot = Robot(self._client, self.mechanism, self.mount)
        self._scenery = Scenery(self._client, self.scene)
        if self._gui:
            self._scenery.aim_window()
        if self._gui or self._renderer == "egl":
            self._robot.paint()
        self._cup: Cup | None = None
        if self.scene.puck is not None and self._scenery.puck is not None:
            self._cup = Cup(self._client, self._robot, self._scenery.puck, self.scene.puck)
        self._plant = Plant(length_errors=plant.length_errors)

    def _empty(self) -> None:
        """Take everything out of the client; a window stays, else a new client leaks least."""
        if self._gui:
            self._client.resetSimulation()
            self._client.configure(self.physics)
        else:
            self._client.close()
            self._client = Client(self.physics, renderer=self._renderer)

    def _become(self, plant: Plant) -> None:
        """Make the simulated machine that of ``plant``."""
        if plant == self._plant:
            return
        if plant.geometry(self.geometry) != self._true_geometry:
            self._empty()
            self._load(plant)
        self._robot.alter(plant.link_masses, plant.motor_strength)
        self._scenery.alter_puck(plant.puck_mass, plant.friction)
        self._plant = plant

    # -- running ----------------------------------------------------------------------------

    def reset(
        self,
        theta: ArrayLike,
        object_position: ArrayLike | None = None,
        goal: ArrayLike | None = None,
        plant: Plant = NOMINAL,
        noise: Vector = _ZERO,
    ) -> State:
        """Put everything at rest: the arms at ``theta``, the loops closed, the object upright.

        Args:
            theta: (3,) rad, by the encoders.
            object_position: (3,) m, world; centre of the object. Ignored without an object.
            goal: (3,) m, world; where the goal marker stands.
            plant: The true machine.
            noise: Of the first reading of the encoders, rad.

        Raises:
            InputError: If theta has the wrong shape or is not finite.
            UnreachableError: If the mechanism cannot be assembled at theta.
        """
        angles = _vector("theta", theta)
        start = equations.assemble(angles, DEFAULT_ASSEMBLY, self.geometry)
        true_angles = joint_angles(
            np.subtract(angles, plant.encoder_bias), geometry=plant.geometry(self.geometry)
        )
        self._let_go()
        self._become(plant)
        self._robot.place(true_angles)
        self._torque = _ZERO
        # What is true of the nominal machine, in case the encoders' errors make no sense.
        self._reading = equations.evaluate(angles, DEFAULT_ASSEMBLY, self.geometry)
        self._mode_change, self._noise = None, (noise, noise)
        self._commands = ((start.x, start.y, start.z),) * 2
        if object_position is not None:
            position = np.asarray(object_position, dtype=np.float64).tolist()
            self._scenery.place_puck((position, UPRIGHT), AT_REST)
        if goal is not None:
            self.show_goal(goal)
        return self.read()

    def show_goal(self, goal: ArrayLike) -> None:
        """Move the goal marker to ``goal`` (3,) m, world."""
        self._scenery.move_marker(np.asarray(goal, dtype=np.float64).tolist())

    def move(self, command: ArrayLike, vacuum: bool = False, noise: Vector = _ZERO) -> State:
        """Command point P to ``command`` and run one control period.

        The motors follow a quadratic B-spline through the commands: it lags the commands by half a
        period, stays in their convex hull, and keeps the accelerations finite. It is a curve of
        point P, not of the joints: near a singularity, a straight line between two postures would
        wander by centimetres.

        Args:
            command: (3,) m, paper frame; inside the region (the caller projects).
            vacuum: Whether the cup sucks.
            noise: Of the encoders' reading at the end, rad.

        Raises:
            InputError: If the command has the wrong shape or is not finite.
            UnreachableError: If the command is out of reach; nothing has moved then.
            ModeChangeError: If the mechanism has left its assembly or working mode before.
            ClosureError: If a loop opened.
        """
        if self._mode_change is not None:
            raise ModeChangeError(self._mode_change)
        before, last = self._commands
        new = _vector("command", command)
        # the spline may end before the command does
        equations.posture(new, ELBOWS_OUT, self.geometry)
        references = [
            equations.posture(_blend(weights, before, last, new), ELBOWS_OUT, self.geometry)
            for weights in self._spline
        ]
        self._commands = (last, new)
        if not vacuum:
            self._let_go()
        b1, b2, b3 = self._plant.encoder_bias
        drive, advance = self._robot.drive, self._client.stepSimulation
        for theta_1, theta_2, theta_3 in references:
            drive((theta_1 - b1, theta_2 - b2, theta_3 - b3))
            advance()
        if vacuum and self._cup is not None:
            self._cup.suck()
        self._torque = self._robot.torques()
        self._noise = (self._noise[1], noise)
        return self.read()

    # -- reading ----------------------------------------------------------------------------

    def read(self) -> State:
        """Read the encoders, what follows from them, and the truth.

        Raises:
            ClosureError: If a loop is open.
        """
        true_theta, true_rates = self._robot.encoders()
        gap, platform, tilt = self._robot.truth()
        if not gap <= CLOSURE_LIMIT:  # so that a NaN fails too
            raise ClosureError(gap, CLOSURE_LIMIT)
        theta, rates = self._disturb(true_theta, true_rates)
        assembly, rows, conditioning = self._evaluate(theta)
        self._watch_mode(true_theta, platform)
        x, y, z, *_ = assembly
        position, quaternion, velocity, spin = self._scenery.puck_state()
        r1, r2, r3 = rates
        return State(
            theta=np.array(theta),
            theta_dot=np.array(rates),
            torque=np.array(self._torque),
            fk_position=np.array(self.mount.swap((x, y, z))),
            fk_velocity=self.mount.rotate([a * r1 + b * r2 + c * r3 for a, b, c in rows]),
            conditioning=conditioning,
            platform_position=np.array(platform),
            platform_tilt=tilt,
            closure_error=gap,
            mode_change=self._mode_change,
            command=np.array(self.mount.swap(self._commands[1])),
            holding=self._cup is not None and self._cup.grip is not None,
            object_position=np.array(position),
            object_quaternion=np.array(quaternion),
            object_axis=np.array(rotate(quaternion, (0.0, 0.0, 1.0))),
            object_velocity=np.array(velocity),
            object_angular_velocity=np.array(spin),
        )

    def _disturb(self, theta: Vector, rates: Vector) -> tuple[Vector, Vector]:
        """What the encoders report: with their bias and noise, and rates by differences."""
        bias, (before, now) = self._plant.encoder_bias, self._noise
        if bias == before == now == _ZERO:
            return theta, rates
        period = self.physics.control_period
        return (
            _vector("theta", np.array(theta) + bias + now),
            _vector("theta_dot", rates + np.subtract(now, before) / period),
        )

    def _evaluate(self, theta: Vector) -> Reading:
        """What follows from the encoders; the last reading that made sense where this one does not.

        That is what a controller can do whose disturbed encoders report angles at which no assembly
        exists, as happens near the edges of the workspace.
        """
        with suppress(UnreachableError, SingularityError):
            self._reading = equations.evaluate(theta, DEFAULT_ASSEMBLY, self.geometry)
        return self._reading

    def _watch_mode(self, theta: Vector, platform: Vector) -> None:
        """Note when the mechanism has passed a singularity.

        Passing a parallel one changes the assembly mode, and the forward kinematics no longer say
        where the platform is; passing a serial one changes the working mode, and the inverse
        kinematics no longer say how to get where.
        """
        try:
            true = equations.assemble(theta, DEFAULT_ASSEMBLY, self._true_geometry)
        except UnreachableError:
            self._mode_change = "assembly"
            return
        y = self.mount.swap(platform)[1]
        apart = math.dist(self.mount.swap((true.x, true.y, true.z)), platform)
        if y * DEFAULT_ASSEMBLY.sin_beta <= 0 or not apart <= ASSEMBLY_LIMIT:
            self._mode_change = "assembly"
        elif true.cos_beta * ELBOWS_OUT.cos_beta <= 0:
            self._mode_change = "working"

    def _let_go(self) -> None:
        if self._cup is not None:
            self._cup.let_go()

    # -- state, pictures, end -----------------------------------------------------------------

    def save(self) -> Snapshot:
        """Take down everything that the physics depend on, and go on from exactly that.

        The engine keeps memories that cannot be read out, such as the impulses of old contacts. So
        that what follows here and what follows a :meth:`restore` are equal to the last bit, they
        are dropped here too.
        """
        pose, velocity = self._scenery.puck_pose()
        snapshot = Snapshot(
            plant=self._plant,
            joints=self._robot.joint_states(),
            torque=self._torque,
            commands=self._commands,
            noise=self._noise,
            reading=self._reading,
            mode_change=self._mode_change,
            object_pose=pose,
            object_velocity=velocity,
            grip=self._cup.grip if self._cup is not None else None,
        )
        self.restore(snapshot)
        return snapshot

    def restore(self, snapshot: Snapshot) -> State:
        """Go back to a moment that :meth:`save` took down, of this or an equal simulation."""
        self._let_go()
        self._become(snapshot.plant)
        self._robot.set_joint_states(snapshot.joints)
        self._torque = snapshot.torque
        self._commands, self._noise = snapshot.commands, snapshot.noise
        self._reading, self._mode_change = snapshot.reading, snapshot.mode_change
        if snapshot.object_pose is not None and snapshot.object_velocity is not None:
            self._scenery.place_puck(snapshot.object_pose, snapshot.object_velocity)
        if snapshot.grip is not None and self._cup is not None:
            self._cup.take(snapshot.grip)
        return self.read()

    def render(self, width: int, height: int) -> NDArray[np.uint8]:
        """Draw the scene as (height, width, 3) RGB."""
        return self._scenery.picture(width, height, self._client.renderer)

    def close(self) -> None:
        """Disconnect the client; harmless the second time."""
        self._client.close()


def _vector(name: str, value: ArrayLike) -> Vector:
    """Three finite floats."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(name, value, "three finite numbers") from error
    if array.shape != (3,):
        raise InputError(name, array.shape, "of shape (3,), by shape")
    a, b, c = array.tolist()
    if not (math.isfinite(a) and math.isfinite(b) and math.isfinite(c)):
        raise InputError(name, [a, b, c], "finite")
    return a, b, c


def _blend(weights: list[float], a: Vector, b: Vector, c: Vector) -> Vector:
    """A point of the spline through three commands."""
    u, v, w = weights
    return (
        u * a[0] + v * b[0] + w * c[0],
        u * a[1] + v * b[1] + w * c[1],
        u * a[2] + v * b[2] + w * c[2],
    )
