"""Plain data that passes between engines, simulation and tasks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from tpm_gym.arrays import BoolArray, FloatArray, IntArray, Vector, finite, is_whole
from tpm_gym.errors import ConfigurationError

__all__ = ["CONTROL_PERIOD", "Block", "Scene", "State"]

CONTROL_PERIOD = 1 / 25
"""Control period: time between two commands of an environment, s."""


@dataclass(frozen=True)
class Block:
    """A square block, the object of a task.

    Blocks are square because engines find all four corners of a contact between boxes at once. A
    cylinder rests on one to three points and is pressed through the table beside them.

    Attributes:
        name: Name in ``reset(options=...)``; unique in its scene.
        width: Edge of the square, m.
        height: m.
        mass: kg.
        friction: Coulomb coefficient against the table.
        colour: Red, green, blue, opacity, each from 0 to 1.

    Raises:
        ConfigurationError: If a value cannot be.
    """

    name: str = "object"
    width: float = 0.036
    height: float = 0.030
    mass: float = 0.050
    friction: float = 0.6
    colour: tuple[float, float, float, float] = (0.83, 0.18, 0.33, 1.0)

    def __post_init__(self) -> None:
        """Reject impossible values."""
        if not isinstance(self.name, str) or not self.name:
            raise ConfigurationError("name", self.name, "a name")
        for name in ("width", "height", "mass", "friction"):
            _require_positive(name, getattr(self, name))
        colour = finite("colour", self.colour, (4,), ConfigurationError)
        if not ((colour >= 0) & (colour <= 1)).all():
            raise ConfigurationError("colour", self.colour, "four numbers from 0 to 1")

    @property
    def half(self) -> Vector:
        """Half edges, m."""
        return self.width / 2, self.width / 2, self.height / 2

    @property
    def radius(self) -> float:
        """Distance of the corners from the centre, m."""
        return math.hypot(self.width, self.width, self.height) / 2

    @property
    def inertia(self) -> Vector:
        """Principal moments about the centre, kg m^2."""
        level = self.mass * (self.width**2 + self.height**2) / 12
        return level, level, self.mass * self.width**2 / 6


@dataclass(frozen=True)
class Scene:
    """Objects and goal markers that a task adds to robot and table.

    Attributes:
        objects: Any number of blocks.
        markers: Number of points that a goal shows, as translucent spheres.
        marker_radius: Radius of the spheres, m.

    Raises:
        ConfigurationError: If a value cannot be.
    """

    objects: tuple[Block, ...] = ()
    markers: int = 1
    marker_radius: float = 0.010

    def __post_init__(self) -> None:
        """Reject impossible values."""
        # By their names reset's options tell them apart.
        blocks = isinstance(self.objects, tuple) and all(isinstance(b, Block) for b in self.objects)
        if not blocks or len({"goal", *(b.name for b in self.objects)}) <= len(self.objects):
            valid = "a tuple of blocks, each with a name of its own that is not 'goal'"
            raise ConfigurationError("objects", self.objects, valid)
        if not is_whole(self.markers, 0):
            raise ConfigurationError("markers", self.markers, "a whole number, 0 or more")
        _require_positive("marker_radius", self.marker_radius)


@dataclass(eq=False)  # frozen, it would take three times as long to make
class State:
    """State of n robots at the end of a control step; world frame.

    Every attribute has a leading axis of n rows, one for each robot. :meth:`take` gives some
    robots, or one without that axis.

    Attributes:
        theta: (n, 3) rad (m for a slide), joint positions by the encoders, with their errors.
        theta_dot: (n, 3) rad/s, joint velocities by the encoders.
        torque: (n, 3) N m, torques of the motors in the last time step; zero after a reset.
        fk_position: (n, 3) m, point P by forward kinematics of ``theta``.
        fk_velocity: (n, 3) m/s, J(theta) theta_dot.
        conditioning: (n,) 1/cond(J) at ``theta``, in [0, 1].
        platform_position: (n, 3) m, point P of the simulated platform, which a real robot does not
            know. Never part of an observation.
        platform_tilt: (n,) rad, rotation of the simulated platform; zero by design.
        closure_error: (n,) m, largest gap of the simulated loops.
        assembly_mode_changed: (n,) whether the robot passed a parallel singularity in this episode.
        working_mode_changed: (n,) whether the robot passed a serial singularity in this episode.
        command: (n, 3) m, where point P is commanded to go.
        held: (n,) index of the object in the vacuum cup; -1 for none.
        vacuum: (n,) Pa, pressure in the cup below the ambient pressure.
        object_position: (n, k, 3) m, centres of the scene's objects.
        object_quaternion: (n, k, 4), their orientations (x, y, z, w).
        object_axis: (n, k, 3) unit vectors, the objects' own z axes.
        object_velocity: (n, k, 3) m/s.
        object_angular_velocity: (n, k, 3) rad/s.
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

    def take(self, rows: Any) -> State:
        """Return the state of some robots, or with an integer the state of one, without n."""
        return State(**{name: values[rows] for name, values in vars(self).items()})

    @property
    def passed_singularity(self) -> BoolArray:
        """(n,) whether the robot left one of its modes in this episode."""
        return self.assembly_mode_changed | self.working_mode_changed


def _require_positive(name: str, value: float) -> None:
    if isinstance(value, bool) or not finite(name, value, (), ConfigurationError) > 0:
        raise ConfigurationError(name, value, "a number above 0")
