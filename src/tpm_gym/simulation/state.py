"""Plain data that passes between the simulation and the tasks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tpm_gym.arrays import BoolArray, FloatArray, IntArray, Vector, finite, is_whole
from tpm_gym.errors import ConfigurationError

__all__ = ["CONTROL_PERIOD", "Block", "Scene", "State"]

CONTROL_PERIOD = 1 / 25
"""Time between two commands of an environment, s."""


@dataclass(frozen=True)
class Block:
    """An object of a task: a square block.

    Square, not round: between boxes an engine finds all four corners of a contact at once, while a
    cylinder rests on one to three points and is pressed through the table where they miss.

    Attributes:
        name: What ``reset(options=...)`` calls it; unique in its scene.
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
        """Reject blocks that cannot be."""
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
        """From the centre to the corners, m."""
        return math.hypot(self.width, self.width, self.height) / 2

    @property
    def inertia(self) -> Vector:
        """Principal moments about the centre, kg m^2."""
        level = self.mass * (self.width**2 + self.height**2) / 12
        return level, level, self.mass * self.width**2 / 6


@dataclass(frozen=True)
class Scene:
    """What a task needs the simulation to hold besides the robot and the table.

    Attributes:
        objects: Any number of blocks.
        markers: How many points a goal shows as translucent spheres.
        marker_radius: Their radius, m.

    Raises:
        ConfigurationError: If a value cannot be.
    """

    objects: tuple[Block, ...] = ()
    markers: int = 1
    marker_radius: float = 0.010

    def __post_init__(self) -> None:
        """Reject scenes that cannot be."""
        # By their names reset's options tell them apart.
        blocks = isinstance(self.objects, tuple) and all(isinstance(b, Block) for b in self.objects)
        if not blocks or len({"goal", *(b.name for b in self.objects)}) <= len(self.objects):
            valid = "a tuple of blocks, each with a name of its own that is not 'goal'"
            raise ConfigurationError("objects", self.objects, valid)
        if not is_whole(self.markers, 0):
            raise ConfigurationError("markers", self.markers, "a whole number, 0 or more")
        _require_positive("marker_radius", self.marker_radius)


@dataclass(frozen=True)
class State:
    """What a simulation reports at the end of a control step; leading batch axes are allowed.

    Attributes:
        theta: (..., 3) rad (m for a slide), the encoders (with their errors, if simulated).
        theta_dot: (..., 3) rad/s, the encoders' rates.
        torque: (..., 3) N m, what the motors applied in the last time step; zero after a reset.
        fk_position: (..., 3) m, world: point P by forward kinematics of ``theta``.
        fk_velocity: (..., 3) m/s, world: J(theta) theta_dot.
        conditioning: (...,) 1/cond(J) at ``theta``, in [0, 1].
        platform_position: (..., 3) m, world: point P of the simulated platform, the truth that a
            real robot does not know. Never part of an observation.
        platform_tilt: (...,) rad, rotation of the simulated platform, zero by design.
        closure_error: (...,) m, the largest gap of the simulated loops.
        assembly_mode_changed: (...,) whether the mechanism has passed a parallel singularity in
            this episode.
        working_mode_changed: (...,) the same for a serial one.
        command: (..., 3) m, world: where point P is commanded to go.
        held: (...,) index of the object that the vacuum cup holds; -1 for none.
        vacuum: (...,) Pa, how far the pressure in the cup is below the ambient's.
        object_position: (..., n, 3) m, world: centres of the scene's objects.
        object_quaternion: (..., n, 4), their orientations in the world, (x, y, z, w).
        object_axis: (..., n, 3) unit vectors, world: the objects' own z axes.
        object_velocity: (..., n, 3) m/s, world.
        object_angular_velocity: (..., n, 3) rad/s, world.
    """

    theta: FloatArray
    theta_dot: FloatArray
    torque: FloatArray
    fk_position: FloatArray
    fk_velocity: FloatArray
    conditioning: FloatArray | float
    platform_position: FloatArray
    platform_tilt: FloatArray | float
    closure_error: FloatArray | float
    assembly_mode_changed: BoolArray | bool
    working_mode_changed: BoolArray | bool
    command: FloatArray
    held: IntArray | int
    vacuum: FloatArray | float
    object_position: FloatArray
    object_quaternion: FloatArray
    object_axis: FloatArray
    object_velocity: FloatArray
    object_angular_velocity: FloatArray

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> State:
        """One with exactly these attributes, in each control step: a tenth of the time."""
        # A frozen dataclass sets them one by one through object.__setattr__.
        state = object.__new__(cls)
        vars(state).update(values)
        return state

    @property
    def passed_singularity(self) -> BoolArray | bool:
        """(...,) whether the mechanism has left one of its modes in this episode."""
        return self.assembly_mode_changed | self.working_mode_changed


def _require_positive(name: str, value: float) -> None:
    if isinstance(value, bool) or not finite(name, value, (), ConfigurationError) > 0:
        raise ConfigurationError(name, value, "a number above 0")
