"""Plain data that passes between the simulation and the tasks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Puck", "Scene", "State"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Puck:
    """The object of the pick-and-place tasks: a square block.

    Square, not round: between boxes the engine finds all four corners of a contact at once, while
    a cylinder rests on one to three points and is pressed through the table where they miss.

    Attributes:
        width: Edge of the square, m.
        height: m.
        mass: kg.
        friction: Coulomb coefficient against the table.
    """

    width: float = 0.036
    height: float = 0.030
    mass: float = 0.050
    friction: float = 0.6

    @property
    def inertia(self) -> tuple[float, float, float]:
        """Principal moments about the centre, kg m^2."""
        level = self.mass * (self.width**2 + self.height**2) / 12
        return level, level, self.mass * self.width**2 / 6


@dataclass(frozen=True)
class Scene:
    """What a task needs the simulation to hold besides the robot and the table.

    Attributes:
        puck: The object, or None.
        marker_radius: Radius of the translucent sphere that shows the goal, m.
    """

    puck: Puck | None = None
    marker_radius: float = 0.010


@dataclass(frozen=True)
class State:
    """What a simulation reports at the end of a control step; leading batch axes are allowed.

    Attributes:
        theta: (..., 3) rad, the three encoders (with their errors, if any are simulated).
        theta_dot: (..., 3) rad/s, the encoders' rates.
        torque: (..., 3) N m, what the motors applied in the last time step; zero after a reset.
        fk_position: (..., 3) m, world: point P by forward kinematics of ``theta``.
        fk_velocity: (..., 3) m/s, world: J(theta) theta_dot.
        conditioning: (...,) 1/cond(J) at ``theta``, in [0, 1].
        platform_position: (..., 3) m, world: point P of the simulated platform, the truth that a
            real robot does not know. Never part of an observation.
        platform_tilt: (...,) rad, rotation of the simulated platform, zero by design.
        closure_error: (...,) m, the largest gap of the simulated loops.
        mode_change: None, or the mode that the mechanism has left in this episode by passing a
            singularity: ``"assembly"`` or ``"working"``.
        command: (..., 3) m, world: where point P is commanded to go.
        holding: (...,) bool, whether the vacuum cup holds the object.
        object_position: (..., 3) m, world: centre of the object. NaN without an object, as below.
        object_quaternion: (..., 4), orientation of the object in the world, (x, y, z, w).
        object_axis: (..., 3) unit vector, world: the object's own z axis.
        object_velocity: (..., 3) m/s, world.
        object_angular_velocity: (..., 3) rad/s, world.
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
    mode_change: str | None
    command: FloatArray
    holding: NDArray[np.bool_] | bool
    object_position: FloatArray
    object_quaternion: FloatArray
    object_axis: FloatArray
    object_velocity: FloatArray
    object_angular_velocity: FloatArray
