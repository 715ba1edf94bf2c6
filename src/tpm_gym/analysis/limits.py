"""Limits for :mod:`tpm_gym.analysis.aspects`, such as the stops of the motors."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.kinematics import inverse
from tpm_gym.kinematics.geometry import Geometry
from tpm_gym.kinematics.modes import WorkingMode
from tpm_gym.mechanism.tpm import bodies

Limit = Callable[[FloatArray, WorkingMode, Geometry], BoolArray]
"""Function of points (n, 3) m, a working mode that reaches all of them, and the lengths.

It returns (n,) bool, true for points that the limit allows.
"""


def within_stops(points: FloatArray, branch: WorkingMode, geometry: Geometry) -> BoolArray:
    """Return whether all motors are between their stops, (n,), with P at ``points`` (n, 3) m."""
    theta = inverse(points, branch, geometry)
    low, high = zip(*bodies.build(geometry).stops, strict=True)
    return np.asarray(((theta >= low) & (theta <= high)).all(axis=-1))
