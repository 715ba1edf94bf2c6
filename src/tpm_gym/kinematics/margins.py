"""Why a configuration does not exist or has no velocities: errors, composed from the margins.

By how much each part of the mechanism fails follows from the lengths that
:mod:`tpm_gym.kinematics.equations` met on its way.
"""

from __future__ import annotations

import math
from typing import Any

from tpm_gym.arrays import Vector
from tpm_gym.errors import UnreachableError
from tpm_gym.kinematics.geometry import Geometry
from tpm_gym.kinematics.modes import AssemblyMode, WorkingMode

__all__ = ["no_assembly", "no_posture", "parallel_factors"]


def no_assembly(
    theta: Vector,
    branch: AssemblyMode,
    geometry: Geometry,
    circles: tuple[float, float],
    link7: tuple[float, float],
) -> UnreachableError:
    """The error for joint angles at which ``branch`` cannot be assembled.

    ``circles`` are y of B1 and the distance of the centres of the circles of Eq. (6), m; ``link7``
    is level and vertical from B3 to where C3 would be without link 7, m, if the circles meet.
    """
    g = geometry
    y1, distance = circles
    hint = f"choose joint angles within reach (branch {branch})"
    if abs(y1) >= g.l4:
        return UnreachableError(theta, "loop 1 (rod B1C1 to y = 0)", g.l4 - abs(y1), hint)
    radius = math.sqrt(g.l4**2 - y1**2)
    margin = min(radius + g.l4 - distance, distance - (g.l4 - radius))
    if margin < 0 or distance == 0:
        return UnreachableError(theta, "loop 1 (circles of B1C1 and B2C2)", margin, hint)
    level, vertical = abs(link7[0]), link7[1]
    nearest, farthest = (math.hypot(level + side * g.l7, vertical) for side in (-1, 1))
    margin = min(farthest - g.l4, g.l4 - nearest)
    return UnreachableError(theta, "loop 2 (rod B3C3 to link 7)", margin, hint)


def no_posture(
    point: Vector,
    branch: WorkingMode,
    geometry: Geometry,
    legs: tuple[Vector, Vector, Vector],
) -> UnreachableError:
    """The error for a point that has no posture on ``branch``.

    ``legs`` are C_i - A_i, m: level and vertical in the arm's plane, and out of it.
    """
    hint = f"choose a point of the workspace (branch {branch}; see tpm_gym.kinematics.workspace)"
    beyond = geometry.l7 - abs(point[1])
    if beyond < 0:
        return UnreachableError(point, "beta (|y| <= l7)", beyond, hint)
    margin, leg = min((_leg_margin(*leg, geometry), i) for i, leg in enumerate(legs, 1))
    return UnreachableError(point, f"leg {leg}", margin, hint)


def _leg_margin(level: float, vertical: float, out: float, geometry: Geometry) -> float:
    """How far the triangle of arm, rod (projected on the arm's plane) and pivot is from failing."""
    if abs(out) >= geometry.l4:
        return geometry.l4 - abs(out)
    in_plane, rod = math.hypot(level, vertical), math.sqrt(geometry.l4**2 - out**2)
    return min(geometry.l3 + rod - in_plane, in_plane - abs(geometry.l3 - rod))


def parallel_factors(values: tuple[Any, Any, Any], geometry: Geometry) -> dict[str, Any]:
    """Names of the factors of det A, as errors have them -> values in units of l4."""
    sin_beta, level3, planar = values
    return {
        "sin(beta)": sin_beta,
        "(l1 + l3 cos(theta_3) - xC - 2 l2) / l4": level3 / geometry.l4,
        "planar factor / l4^2": planar / geometry.l4**2,
    }
