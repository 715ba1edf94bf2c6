"""Data classes that engines, simulation and tasks exchange."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from tpm_gym.arrays import BoolArray, FloatArray, IntArray, Vector, finite, is_whole
from tpm_gym.errors import ConfigurationError, InputError

CONTROL_PERIOD = 1 / 25
"""Control period of tasks that set no other: time between two commands, s."""

_LIGHTEST, _HEAVIEST, _ROUGHEST = 1e-6, 1e6, 1e6  # of blocks, kg, and their largest friction


@dataclass(frozen=True)
class Block:
    """Box with a square base, the object of a task.

    Objects are boxes because engines find all four contacts of a box with the table in one time
    step. For a cylinder, they find only one to three contacts, and the rim sinks into the table
    where it has no contact.

    Attributes:
        name: Key in ``reset(options=...)``; unique in its scene.
        width: Edge length of the base, m.
        height: Height, m.
        mass: Mass, 1e-6 to 1e6 kg.
        friction: Coulomb coefficient against the table, at most 1e6.
        colour: Red, green, blue and opacity, each from 0 to 1.

    Raises:
        ConfigurationError: If a value is out of range.
    """

    name: str = "object"
    width: float = 0.036
    height: float = 0.030
    mass: float = 0.050
    friction: float = 0.6
    colour: tuple[float, float, float, float] = (0.83, 0.18, 0.33, 1.0)

    def __post_init__(self) -> None:
        """Check the values."""
        if not isinstance(self.name, str) or not self.name:
            raise ConfigurationError("name", self.name, "a name")
        for name in ("width", "height", "mass", "friction"):
            _require_positive(name, getattr(self, name))
        # Engines compute no contacts of far lighter, heavier or rougher blocks.
        if not _LIGHTEST <= self.mass <= _HEAVIEST:
            valid = f"a number from {_LIGHTEST:g} to {_HEAVIEST:g} kg"
            raise ConfigurationError("mass", self.mass, valid)
        if self.friction > _ROUGHEST:
            raise ConfigurationError("friction", self.friction, f"at most {_ROUGHEST:g}")
        _require_colour(self.colour)

    @property
    def half(self) -> Vector:
        """Half edge lengths along x, y and z, m."""
        return self.width / 2, self.width / 2, self.height / 2

    @property
    def radius(self) -> float:
        """Distance from the centre to a corner, m."""
        return math.hypot(self.width, self.width, self.height) / 2

    @property
    def inertia(self) -> Vector:
        """Principal moments of inertia about the centre, kg m^2."""
        level = self.mass * (self.width**2 + self.height**2) / 12
        return level, level, self.mass * self.width**2 / 6


@dataclass(frozen=True)
class Belt:
    """Conveyor belt: a part of the table, as wide as the table, with a surface that moves along x.

    ``start`` is at or beyond the edge of the table on the side of -x. The rest of the table stands
    still. A positive speed moves objects towards +x.

    Attributes:
        start: Lowest x, m, world.
        end: Highest x, m, world.
        fastest: Largest speed in either direction, m/s.

    Raises:
        ConfigurationError: If a value is out of range.
    """

    start: float
    end: float
    fastest: float = 1.0

    def __post_init__(self) -> None:
        """Check the values."""
        _require_positive("fastest", self.fastest)
        start = finite("start", self.start, (), ConfigurationError)
        if not start < finite("end", self.end, (), ConfigurationError):
            raise ConfigurationError("end", self.end, f"a number above start, {self.start}")

    def require(
        self, speeds: Any, count: int, error: type[ConfigurationError | InputError]
    ) -> FloatArray:
        """Check and return speeds (count,) m/s of belts; raise ``error`` if one is invalid."""
        found = finite("belt_speed", speeds, (count,), error)
        if (abs(found) > self.fastest).any():
            raise error("belt_speed", found.tolist(), f"at most {self.fastest} m/s either way")
        return found


@dataclass(frozen=True)
class Patch:
    """Painted rectangle on the table. It is drawn, but has no contacts.

    Attributes:
        low: Lowest x and y, m, world.
        high: Highest x and y, m, world.
        colour: Red, green, blue and opacity, each from 0 to 1.

    Raises:
        ConfigurationError: If a value is out of range.
    """

    low: tuple[float, float]
    high: tuple[float, float]
    colour: tuple[float, float, float, float]

    def __post_init__(self) -> None:
        """Check the values."""
        low = finite("low", self.low, (2,), ConfigurationError)
        high = finite("high", self.high, (2,), ConfigurationError)
        if not (low < high).all():
            raise ConfigurationError("high", self.high, f"above low, {self.low}")
        _require_colour(self.colour)


@dataclass(frozen=True)
class Scene:
    """Objects, goal markers, belt and paint that a task adds to robot and table.

    Attributes:
        objects: The blocks, any number.
        markers: Number of goal markers, drawn as translucent spheres.
        marker_radius: Radius of the markers, m.
        belt: Conveyor belt; None for a table that stands still.
        patches: Painted rectangles.

    Raises:
        ConfigurationError: If a value is out of range, or two objects have equal names.
    """

    objects: tuple[Block, ...] = ()
    markers: int = 1
    marker_radius: float = 0.010
    belt: Belt | None = None
    patches: tuple[Patch, ...] = ()

    def __post_init__(self) -> None:
        """Check the values."""
        # The options of reset() use these names as keys, next to "goal" and "belt_speed".
        blocks = isinstance(self.objects, tuple) and all(isinstance(b, Block) for b in self.objects)
        if not blocks or len({"goal", "belt_speed", *(b.name for b in self.objects)}) < 2 + len(
            self.objects
        ):
            valid = "a tuple of blocks, each with a name of its own, other than goal, belt_speed"
            raise ConfigurationError("objects", self.objects, valid)
        if self.belt is not None and not isinstance(self.belt, Belt):
            raise ConfigurationError("belt", self.belt, "None or a Belt")
        patches = isinstance(self.patches, tuple)
        if not patches or not all(isinstance(patch, Patch) for patch in self.patches):
            raise ConfigurationError("patches", self.patches, "a tuple of Patch")
        if not is_whole(self.markers, 0):
            raise ConfigurationError("markers", self.markers, "a whole number, 0 or more")
        _require_positive("marker_radius", self.marker_radius)


@dataclass(eq=False)  # not frozen: a frozen dataclass takes three times as long to create
class State:
    """State of n robots at the end of a control step; world frame.

    Row i of every attribute belongs to robot i.

    Attributes:
        theta: (n, 3) rad (m for a slide), joint positions as the encoders report them.
        theta_dot: (n, 3) rad/s, joint velocities as the encoders report them.
        torque: (n, 3) N m, torques of the motors in the last time step; zero after a reset.
        fk_position: (n, 3) m, point P by forward kinematics of ``theta``.
        fk_velocity: (n, 3) m/s, velocity of P: J(theta) theta_dot.
        conditioning: (n,) 1/cond(J) at ``theta``, in [0, 1].
        platform_position: (n, 3) m, true point P of the simulated platform. Observations must not
            use this attribute, because a real robot cannot measure it.
        platform_tilt: (n,) rad, rotation angle of the simulated platform; zero by design.
        closure_error: (n,) m, largest gap at a loop closure.
        assembly_mode_changed: (n,) whether the robot passed a parallel singularity in this episode.
        working_mode_changed: (n,) whether the robot passed a serial singularity in this episode.
        command: (n, 3) m, commanded position of point P.
        held: (n,) index of the object in the vacuum cup; -1 for none.
        vacuum: (n,) Pa, pressure in the cup below the ambient pressure.
        object_position: (n, k, 3) m, centres of the scene's objects.
        object_quaternion: (n, k, 4), orientations (x, y, z, w) of the objects.
        object_axis: (n, k, 3), z axes of the objects' frames (unit vectors).
        object_velocity: (n, k, 3) m/s, velocities of the objects' centres.
        object_angular_velocity: (n, k, 3) rad/s, angular velocities of the objects.
        belt_speed: (n,) m/s, speed of the belt's surface along x; zero without a belt.
    """

    theta: FloatArray
    theta_dot: FloatArray
    torque: FloatArray
    fk_position: FloatArray
    fk_velocity: FloatArray
    conditioning: FloatArray
    platform_position: FloatArray
    platform_tilt: FloatArray
    closure_error: FloatArray
    assembly_mode_changed: BoolArray
    working_mode_changed: BoolArray
    command: FloatArray
    held: IntArray
    vacuum: FloatArray
    object_position: FloatArray
    object_quaternion: FloatArray
    object_axis: FloatArray
    object_velocity: FloatArray
    object_angular_velocity: FloatArray
    belt_speed: FloatArray

    def take(self, rows: Any) -> State:
        """Return the State of some rows; an integer gives one robot, without the axis n."""
        return State(**{name: values[rows] for name, values in vars(self).items()})

    @property
    def passed_singularity(self) -> BoolArray:
        """Whether each robot left its assembly or working mode in this episode, (n,)."""
        return self.assembly_mode_changed | self.working_mode_changed


def _require_colour(colour: Any) -> None:
    values = finite("colour", colour, (4,), ConfigurationError)
    if not ((values >= 0) & (values <= 1)).all():
        raise ConfigurationError("colour", colour, "four numbers from 0 to 1")


def _require_positive(name: str, value: float) -> None:
    if isinstance(value, bool) or not finite(name, value, (), ConfigurationError) > 0:
        raise ConfigurationError(name, value, "a number above 0")
