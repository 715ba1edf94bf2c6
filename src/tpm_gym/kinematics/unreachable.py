"""Why a branch of the kinematics does not exist: which part of the mechanism is too short or long.

Used to compose error messages, so it works on single inputs and takes its time.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tpm_gym.errors import UnreachableError
from tpm_gym.kinematics.geometry import Geometry
from tpm_gym.kinematics.modes import AssemblyMode, WorkingMode

__all__ = ["no_assembly", "no_posture"]

FloatArray = NDArray[np.float64]


def no_assembly(theta: FloatArray, branch: AssemblyMode, geometry: Geometry) -> UnreachableError:
    """The error for joint angles (3,) at which ``branch`` cannot be assembled."""
    g = geometry
    hint = f"choose joint angles within reach (branch {branch})"
    c, s = np.cos(theta), np.sin(theta)
    y1, z1 = g.l1 + g.l3 * float(c[0]), g.l3 * float(s[0])
    dx, dz = -g.l1 + g.l3 * float(c[1]) + 2 * g.l5, g.l3 * float(s[1]) - z1
    distance = math.hypot(dx, dz)
    if abs(y1) >= g.l4:
        return _error(theta, "loop 1 (rod B1C1 to y = 0)", g.l4 - abs(y1), hint)
    radius1 = math.sqrt(g.l4**2 - y1**2)
    margin = min(radius1 + g.l4 - distance, distance - (g.l4 - radius1))
    if margin < 0 or distance == 0:
        return _error(theta, "loop 1 (circles of B1C1 and B2C2)", margin, hint)
    # Link 3' stands; see whether rod B3C3 reaches the circle on which link 7 carries C3.
    along = (radius1**2 - g.l4**2 + distance**2) / (2 * distance)
    across = branch.planar * math.sqrt(max(0.0, radius1**2 - along**2))
    x_c = (along * dx - across * dz) / distance
    z_c = z1 + (along * dz + across * dx) / distance
    u = abs(x_c - g.l1 - g.l3 * float(c[2]) + 2 * g.l2)
    w = z_c + g.l6 - g.l3 * float(s[2])
    margin = min(math.hypot(u + g.l7, w) - g.l4, g.l4 - math.hypot(u - g.l7, w))
    return _error(theta, "loop 2 (rod B3C3 to link 7)", margin, hint)


def no_posture(position: FloatArray, branch: WorkingMode, geometry: Geometry) -> UnreachableError:
    """The error for a point (3,) m that has no posture on ``branch``."""
    g = geometry
    hint = f"choose a point of the workspace (branch {branch}; see tpm_gym.kinematics.workspace)"
    x, y, z = (float(value) for value in position)
    if abs(y) > g.l7:
        return _error(position, "beta (|y| <= l7)", g.l7 - abs(y), hint)
    x_c = x - g.l2 - branch.cos_beta * math.sqrt(g.l7**2 - y**2)
    z_c = z - 2 * g.l6
    # (C_i - A_i) in the arm's plane (level and vertical), and out of it
    legs = {
        "leg 1": (-g.l1, z_c, x_c),
        "leg 2": (x_c - 2 * g.l5 + g.l1, z_c, 0.0),
        "leg 3": (x + g.l2 - g.l1, z - g.l6, y),
    }
    margins = {name: _leg_margin(*leg, g) for name, leg in legs.items()}
    worst = min(margins, key=lambda name: margins[name])
    return _error(position, worst, margins[worst], hint)


def _leg_margin(a: float, b: float, out: float, geometry: Geometry) -> float:
    """How far the triangle of arm, rod (projected on the arm's plane) and pivot is from failing."""
    if abs(out) >= geometry.l4:
        return geometry.l4 - abs(out)
    in_plane, rod = math.hypot(a, b), math.sqrt(geometry.l4**2 - out**2)
    return min(geometry.l3 + rod - in_plane, in_plane - abs(geometry.l3 - rod))


def _error(point: FloatArray, leg: str, margin: float, hint: str) -> UnreachableError:
    return UnreachableError([float(value) for value in point], leg, margin, hint)
