"""Interface of engines, and the registry of engines by name.

An engine simulates n robots, each over its own table. Engines know machine, scene and drive, but
no goals, rewards or Gymnasium. For all engines, :mod:`tpm_gym.simulation.simulation` adds encoder
errors to the readings, records the modes that robots leave, and computes the
:class:`~tpm_gym.simulation.state.State`.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from types import ModuleType
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import BoolArray, FloatArray, IntArray, Quaternion, Vector, is_whole
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.drives import Servo, ServoDrives
from tpm_gym.simulation.imaging import Camera, Picture, View
from tpm_gym.simulation.randomisation import Plant
from tpm_gym.simulation.state import Scene
from tpm_gym.simulation.vacuum import EMPTY, Hold

UPRIGHT: Quaternion = (0.0, 0.0, 0.0, 1.0)
SPRING_GAIN = 0.2
"""Fraction of the cup's displacement that its spring removes in one time step."""
_START = np.array([[0.5, 0.5, 0.0]])  # weights of the commands at the beginning of a period


def transform(origin: Vector, quaternion: Quaternion, point: Vector) -> Vector:
    """Convert a point (m) from a frame with this origin (m) and orientation to its parent frame."""
    # This equals origin + rotate(quaternion, point), written out for speed.
    u, v, w = origin
    x, y, z, r = quaternion
    a, b, c = point
    s, t, p = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return (
        u + (a + r * s + y * p - z * t),
        v + (b + r * t + z * s - x * p),
        w + (c + r * p + x * t - y * s),
    )


class Pose(NamedTuple):
    """Position (m) and orientation quaternion (x, y, z, w)."""

    position: Vector
    quaternion: Quaternion = UPRIGHT

    @classmethod
    def of(cls, numbers: Sequence[float]) -> Pose:
        """Create a pose from position (m) and quaternion (x, y, z, w) in one sequence."""
        x, y, z, a, b, c, d = numbers
        return cls((x, y, z), (a, b, c, d))


class Twist(NamedTuple):
    """Linear velocity (m/s) and angular velocity (rad/s)."""

    velocity: Vector = (0.0, 0.0, 0.0)
    angular_velocity: Vector = (0.0, 0.0, 0.0)


class Grip(NamedTuple):
    """Held object and vacuum, and the pose of the held object.

    The pose is None if no object is held. Each engine chooses the frame of the pose, which moves
    with the cup.
    """

    hold: Hold = EMPTY
    pose: Pose | None = None


class Readout(NamedTuple):
    """Readings of an engine for n robots with k objects on each table; world frame.

    Attributes:
        theta: (n, 3) rad (m for a slide), true joint positions.
        theta_dot: (n, 3) rad/s, true joint velocities.
        torque: (n, 3) N m, torques of the motors in the last time step.
        position: (n, 3) m, point P of the platform.
        tilt: (n,) rad, rotation angle of the platform.
        gap: (n,) m, largest gap at a loop closure.
        mode_left: (n,) mode that the robot left, coded as in :meth:`tpm_gym.Machine.mode_left`.
        held: (n,) index of the object in the cup; -1 for none.
        vacuum: (n,) Pa below the ambient pressure.
        object_position: (n, k, 3) m, centres of the objects.
        object_quaternion: (n, k, 4), orientations (x, y, z, w) of the objects.
        object_velocity: (n, k, 3) m/s.
        object_angular_velocity: (n, k, 3) rad/s.
    """

    theta: FloatArray
    theta_dot: FloatArray
    torque: FloatArray
    position: FloatArray
    tilt: FloatArray
    gap: FloatArray
    mode_left: NDArray[np.int8]
    held: IntArray
    vacuum: FloatArray
    object_position: FloatArray
    object_quaternion: FloatArray
    object_velocity: FloatArray
    object_angular_velocity: FloatArray

    @classmethod
    def of_one(
        cls,
        machine: Machine,
        motors: tuple[Vector, Vector, Vector],
        truth: tuple[float, Vector, float],
        hold: Hold,
        objects: Sequence[tuple[Pose, Twist]],
    ) -> Readout:
        """Create the readout of one robot from floats.

        Args:
            machine: True machine of the robot; it determines the mode that was left.
            motors: Joint positions (rad), velocities (rad/s) and torques (N m).
            truth: Largest loop gap (m), point P (m, world) and tilt (rad).
            hold: Held object and vacuum.
            objects: Pose and velocities of each object.
        """
        (theta, rates, torque), (gap, (x, y, z), tilt) = motors, truth
        (a, b, c), (u, v, w) = machine.mount.plain_frame
        own = a * (x - u), b * (y - v), c * (z - w)
        numbers = [*theta, *rates, *torque, x, y, z, tilt, gap, hold.vacuum, *own]
        for (where, orientation), (velocity, spin) in objects:
            numbers += (*where, *orientation, *velocity, *spin)
        # Slicing one array takes half the time of creating one array per attribute.
        row = np.array([numbers])
        table = row[:, 18:].reshape(1, -1, 13)
        left = machine.mode_left(row[:, 0:3], row[:, 15:18])
        return cls(
            row[:, 0:3], row[:, 3:6], row[:, 6:9], row[:, 9:12],
            row[:, 12], row[:, 13], left, np.array([hold.which]), row[:, 14],
            table[..., 0:3], table[..., 3:7], table[..., 7:10], table[..., 10:13],
        )  # fmt: skip


def spline_weights(steps: int) -> FloatArray:
    """Return the weights (steps, 3) that give the path's point at the end of each time step.

    This point is the sum of the last three commands, each multiplied by its weight. Each row
    is for one time step; its first weight is for the oldest command.
    """
    s = np.arange(1, steps + 1) / steps
    return np.stack([(1 - s) ** 2, 1 + 2 * s - 2 * s**2, s**2], axis=1) / 2


class Path:
    """Path of point P of n robots in a control period: a quadratic B-spline.

    Its control points are the last three commands. So the path lags the commands by half a period,
    stays in their convex hull, and has finite accelerations.

    Point P is interpolated, not the joint positions: near a singularity, interpolated joint
    positions would move P away from its path by centimetres.

    Args:
        machine: Nominal machine.
        commands: (n, 3, 3) m, machine's frame: the last three commands, oldest first.
        weights: (K, 3), from :func:`spline_weights`, for the K time steps of the control period.
        bias: (n, 3) rad, encoder reading minus true joint position; None for zero.

    Methods that return joint positions raise JointLimitError if a motor would be beyond a stop, and
    UnreachableError if a point is out of reach.
    """

    def __init__(
        self,
        machine: Machine,
        commands: FloatArray,
        weights: FloatArray,
        bias: FloatArray | None = None,
    ) -> None:
        """Store the arguments."""
        self.machine, self.commands, self.weights, self._bias = machine, commands, weights, bias

    def take(self, rows: IntArray) -> Path:
        """Return the paths of some robots."""
        bias = None if self._bias is None else self._bias[rows]
        return Path(self.machine, self.commands[rows], self.weights, bias)

    def points(self, last: int = 0) -> FloatArray:
        """Return point P at the ends of the last time steps, (n, number of time steps, 3) m.

        ``last`` is the number of time steps; 0 for all.
        """
        points: FloatArray = loops().spline_points(self.commands, self.weights[-last:])
        return points

    def joints(self, last: int = 0) -> FloatArray:
        """Return true joint positions (rad) at the ends of the last time steps.

        The shape and ``last`` are explained in :meth:`points`.
        """
        theta = self._readings(self.weights[-last:])
        return theta if self._bias is None else self.true(theta)

    def readings(self) -> FloatArray:
        """Return encoder readings (n, K + 1, 3) rad at the start and after each of K time steps."""
        return self._readings(np.concatenate([_START, self.weights]))

    def _readings(self, weights: FloatArray) -> FloatArray:
        points: FloatArray = loops().spline_points(self.commands, weights)
        theta = self.machine.inverse(points)
        # NaN means out of reach; all_within() is False for it. reach() raises the error.
        if not loops().all_within(theta.reshape(-1, 3), *self.machine.stops):
            theta = self.machine.reach(points)
        return theta

    def true(self, theta: FloatArray) -> FloatArray:
        """Convert encoder readings (n, ..., 3) rad into true joint positions."""
        if self._bias is None:
            return theta
        return theta - self._bias.reshape(-1, *(1,) * (theta.ndim - 2), 3)


@cache
def loops() -> ModuleType:
    """Import and return :mod:`tpm_gym.simulation.compiled`, a module of compiled functions.

    The module imports Numba, so it is imported only when its functions are needed.
    """
    from tpm_gym.simulation import compiled

    return compiled


def drives_of_one(
    servo: Servo | None, machine: Machine, count: int, time_step: float
) -> ServoDrives | None:
    """Return the drives of an engine that simulates one robot; None for ideal drives.

    Raises:
        ConfigurationError: If ``count`` is not 1, or a motor has no torque-speed line.
    """
    if count != 1:
        raise ConfigurationError("count", count, "1: this engine simulates one robot")
    return None if servo is None else ServoDrives(servo, machine, 1, time_step)


class Driven(Protocol):
    """Robot with three motors, in an engine that simulates one robot."""

    def motors(self) -> tuple[Vector, Vector, Vector]:
        """Return joint positions (rad), velocities (rad/s) and torques (N m)."""

    def drive(self, theta: Vector) -> None:
        """Set the joint positions (rad) that ideal motors reach in the next time step."""

    def apply(self, torque: Vector) -> None:
        """Set the torques (N m) that the motors apply in the next time step."""


def steering(
    drives: ServoDrives | None, path: Path, robot: Driven
) -> tuple[Sequence[Any], Callable[[Any], None]]:
    """Return an input for each time step, and the function that passes an input to the motors.

    For ideal drives, the inputs are the joint positions (rad) that the motors reach in the time
    steps. For servo drives, the inputs are the indices of the time steps.
    """
    if drives is None:
        return path.joints()[0].tolist(), robot.drive
    references = drives.references(path)
    drives.begin(references.theta[0])

    def drive(index: int) -> None:
        theta, rates, _ = robot.motors()
        torque = drives.torque(references, index, np.array([theta]), np.array([rates]))
        robot.apply(torque[0].tolist())

    return range(len(references.theta)), drive


class Engine(Protocol):
    """Simulator of n robots, each over its own table. SI units, world frame, rows first.

    Call ``load`` first, then ``place``. An engine raises
    :class:`~tpm_gym.errors.ConfigurationError` for every option that it does not support.

    Attributes:
        time_step: Time step, s; the control period must be an integer multiple of it.
    """

    time_step: float

    def load(self, machine: Machine, scene: Scene, count: int) -> None:
        """Load ``count`` nominal robots, each with a copy of the scene."""

    def alter(self, rows: IntArray, plants: Sequence[Plant]) -> None:
        """Apply plants (masses, motors, friction, lengths) to the robots of ``rows``."""

    def place(self, rows: IntArray, theta: FloatArray, objects: FloatArray) -> None:
        """Place robots and objects at rest, with nothing in the cups.

        Args:
            rows: (r,) robots to place.
            theta: (r, 3) rad (m for a slide), true joint positions.
            objects: (r, k, 7) centres (m) and orientations (x, y, z, w) of the objects.
        """

    def set_belt(self, rows: IntArray, speed: FloatArray) -> None:
        """Set the speeds (r,) m/s of the belts of ``rows``; called only for scenes with a belt.

        In contacts, the belt's surface moves at this speed along x. The belt stays in place.
        ``save`` does not include the speed.
        """

    def advance(self, path: Path, vacuum: BoolArray) -> None:
        """Simulate one control period along ``path``; ``vacuum`` (n,): whether the vacuum is on."""

    def read(self) -> Readout:
        """Return the readings of all robots; the caller may change the arrays."""

    def save(self) -> Any:
        """Return the state that the next time steps depend on, as plain data or arrays.

        The result does not include values that cannot be read from the engine, such as contact
        impulses of the last time step. ``restore`` resets these values.
        """

    def restore(self, saved: Any) -> None:
        """Continue from a result of ``save``.

        The engine has the same robots as at ``save``, and the caller has already applied their
        plants.
        """

    def show(self, camera: Camera, markers: FloatArray) -> None:
        """Update the window: its camera, the first robot, and the goal markers, (k, 3) m.

        This method is not called if the engine's constructor has no keyword ``gui``.
        """

    def picture(self, row: int, view: View) -> Picture:
        """Draw the robot of ``row`` and its scene, without goal markers."""

    def close(self) -> None:
        """Release all resources; a second call does nothing."""


Factory = Callable[..., Engine]

_ENGINES: dict[str, str | Factory] = {
    "pybullet": "tpm_gym.simulation.bullet.engine:BulletEngine",
    "mujoco": "tpm_gym.simulation.mujoco.engine:MujocoEngine",
    "analytic": "tpm_gym.simulation.analytic.engine:AnalyticEngine",
}
_MOST: dict[str, int | None] = {"analytic": None}


def register_engine(name: str, engine: str | Factory, *, robots: int | None = 1) -> None:
    """Register an engine, so that environments can be created with ``engine=name``.

    Args:
        name: Name of the engine.
        engine: Callable that creates the engine, or ``"module:attribute"``, which is imported at
            the first use. The callable may have the keywords ``gui`` (open a window),
            ``renderer``, ``physics`` (numerical settings) and ``drive`` (a
            :class:`~tpm_gym.simulation.Servo`). Leave out the keywords of options that
            the engine does not support.
        robots: Largest number of robots in one engine; None for no limit.

    Raises:
        ConfigurationError: If an argument is invalid, or another engine has this name.
    """
    if not isinstance(name, str) or not name:
        raise ConfigurationError("name", name, "a name")
    if not (isinstance(engine, str) and ":" in engine) and not callable(engine):
        raise ConfigurationError("engine", engine, "a callable, or 'module:attribute'")
    if robots is not None and not is_whole(robots, 1):
        raise ConfigurationError("robots", robots, "a whole number, 1 or more, or None")
    if _path(_ENGINES.get(name, engine)) != _path(engine):
        raise ConfigurationError("engine", name, f"a name other than {', '.join(_ENGINES)}")
    _ENGINES[name], _MOST[name] = engine, robots


def _path(engine: str | Factory) -> str:
    """Return "module:attribute" of an engine, to compare two registrations."""
    if isinstance(engine, str):
        return engine
    return f"{engine.__module__}:{getattr(engine, '__qualname__', engine)}"


def engine_names() -> tuple[str, ...]:
    """Return the names of all registered engines."""
    return tuple(_ENGINES)


def require_engine(name: Any) -> None:
    """Check the name of an engine.

    Raises:
        ConfigurationError: If no engine is registered with this name.
    """
    if not isinstance(name, str) or name not in _ENGINES:
        raise ConfigurationError("engine", name, ", ".join(map(repr, _ENGINES)))


def most_robots(name: str) -> int | None:
    """Return the largest number of robots in one engine; None for no limit."""
    require_engine(name)
    return _MOST.get(name, 1)


def make_engine(
    name: str,
    *,
    gui: bool = False,
    renderer: str | None = None,
    physics: Any = None,
    drive: Servo | None = None,
    time_step: float | None = None,
) -> Engine:
    """Create the engine with this name.

    Args:
        name: Name of the engine.
        gui: Whether to open a window.
        renderer: Renderer of the pictures; None for the engine's default.
        physics: Numerical settings of the engine; None for the engine's defaults.
        drive: Servo drives of the motors; None for ideal drives.
        time_step: Time step, s, if ``physics`` has none; None for the engine's default.

    Raises:
        ConfigurationError: If no engine has this name, or the engine does not support an option.
    """
    require_engine(name)
    factory = _ENGINES[name]
    if isinstance(factory, str):
        module, _, attribute = factory.partition(":")
        try:
            factory = getattr(importlib.import_module(module), attribute)
        except (ModuleNotFoundError, AttributeError) as error:
            valid = f"an engine that can be imported; for {factory!r} Python says: {error}"
            raise ConfigurationError("engine", name, valid) from error
    options = {"gui": gui or None, "renderer": renderer, "physics": physics, "drive": drive}
    asked = {option: value for option, value in options.items() if value is not None}
    known = inspect.signature(factory).parameters
    if time_step is not None and "physics" in known and isinstance(physics or {}, Mapping):
        asked["physics"] = {"time_step": time_step, **(physics or {})}
    if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in known.values()):
        for option in asked.keys() - known.keys():
            if option == "gui":  # The environment's option has another name: render_mode.
                valid = f"None or 'rgb_array': the engine {name!r} opens no window"
                raise ConfigurationError("render_mode", "human", valid)
            valid = f"left out: the engine {name!r} has no such option"
            raise ConfigurationError(option, asked[option], valid)
    engine: Engine = factory(**asked)
    if lacking := [part for part in _PARTS if not _has(engine, part)]:
        raise ConfigurationError("engine", name, f"an engine that has {', '.join(lacking)}")
    return engine


_PARTS = [name for name in (*Engine.__annotations__, *vars(Engine)) if not name.startswith("_")]


def _has(engine: Engine, part: str) -> bool:
    """Return whether ``engine`` has the attribute ``part`` without inheriting it from Engine."""
    own = getattr(engine, part, None)
    return own is not None and getattr(own, "__func__", None) is not vars(Engine).get(part, own)
