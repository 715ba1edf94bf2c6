"""Mount of the robot over the table: conversion between machine's frame and world frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, Quaternion, Vector, finite
from tpm_gym.errors import ConfigurationError

GRAVITY = 9.81
"""Acceleration of gravity along the world's -z, m/s^2."""

_HALF_TURN = np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Mount:
    """Mount of the base over the table.

    The base is mounted upside down, a half turn about x: world = (x, -y, height - z).

    Attributes:
        height: Height of the base plane above the table top (world z = 0), m.

    Raises:
        ConfigurationError: If the height is no number from -100 to 100.
    """

    height: float

    def __post_init__(self) -> None:
        """Reject heights so large that coordinates lose precision."""
        if not abs(finite("height", self.height, (), ConfigurationError)) <= 100:
            raise ConfigurationError("height", self.height, "at most 100 m")

    def to_world(self, point: ArrayLike) -> FloatArray:
        """Convert points (..., 3) m from the machine's frame to the world frame."""
        world: FloatArray = self.rotate(point) + np.array([0.0, 0.0, self.height])
        return world

    def to_paper(self, point: ArrayLike) -> FloatArray:
        """Convert points (..., 3) m from the world frame to the machine's frame."""
        return self.rotate(np.asarray(point, dtype=np.float64) - np.array([0.0, 0.0, self.height]))

    def rotate(self, vector: ArrayLike) -> FloatArray:
        """Convert free vectors (..., 3), such as velocities, between machine's and world frame.

        The conversion is the same in both directions.
        """
        turned: FloatArray = np.multiply(vector, _HALF_TURN, dtype=np.float64)
        return turned

    @cached_property
    def frame(self) -> tuple[FloatArray, FloatArray]:
        """Factors (1 or -1) and origin (m) that convert points to the world frame, (3,) each.

        ``world = factors * point + origin``, and ``point = factors * (world - origin)``, where
        ``point`` is in the machine's frame.
        """
        return _HALF_TURN, np.array([0.0, 0.0, self.height])

    @cached_property
    def plain_frame(self) -> tuple[Vector, Vector]:
        """:attr:`frame` in plain floats."""
        return (1.0, -1.0, -1.0), (0.0, 0.0, self.height)

    @property
    def free_fall(self) -> Vector:
        """Acceleration of gravity in the machine's frame, m/s^2."""
        return (0.0, 0.0, GRAVITY)

    @property
    def quaternion(self) -> Quaternion:
        """Orientation of the machine's frame in the world, (x, y, z, w)."""
        return (1.0, 0.0, 0.0, 0.0)

    @staticmethod
    def tilt(quaternion: Quaternion) -> float:
        """Compute the angle between an orientation (x, y, z, w) and the machine's frame, rad."""
        _, y, z, w = quaternion
        return 2 * math.asin(min(1.0, math.hypot(y, z, w)))
