"""Plain data that passes between the simulation and the tasks."""

from __future__ import annotations

from dataclasses import dataclass

from tpm_gym.arrays import BoolArray, FloatArray, IntArray

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
    """

    name: str = "object"
    width: float = 0.036
    height: float = 0.030
    mass: float = 0.050
    friction: float = 0.6
    colour: tuple[float, float, float, float] = (0.83, 0.18, 0.33, 1.0)

    @property
    def inertia(self) -> tuple[float, float, float]:
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
    """

    objects: tuple[Block, ...] = ()
    markers: int = 1
    marker_radius: float = 0.010


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

    @property
    def passed_singularity(self) -> BoolArray | bool:
        """(...,) whether the mechanism has left one of its modes in this episode."""
        return self.assembly_mode_changed | self.working_mode_changed
