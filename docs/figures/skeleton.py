"""The mechanism in one posture, as points and straight links for drawing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics import WorkingMode, inverse_all
from tpm_gym.kinematics.geometry import PAPER, Geometry

_ELEVATION = np.deg2rad(20.0)  # of the eye


@dataclass(frozen=True)
class Skeleton:
    """The paper's named points, each (..., 3) m in the paper's frame; NaN where not reachable.

    Attributes:
        a: A1, A2, A3 (3, 3), the actuated pivots.
        b: B1, B2, B3 (..., 3, 3), the elbows.
        c: C1, C2, C3 (..., 3, 3), the far ends of the rods.
        d1: Joint R12 between link 3' and link 7.
        e1: Joint R13 between link 7 and the platform.
        f1: The platform's end over E1.
        d3: The platform's end over C3.
        theta: (..., 3) rad.
        geometry: The lengths.
    """

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d1: FloatArray
    e1: FloatArray
    f1: FloatArray
    d3: FloatArray
    theta: FloatArray
    geometry: Geometry

    def links(self) -> dict[str, tuple[FloatArray, FloatArray, float]]:
        """Return name -> both ends (..., 3) m and the length of the link in the geometry, m."""
        g = self.geometry
        ux, uy = np.array([g.l5, 0.0, 0.0]), np.array([0.0, g.l5, 0.0])
        (b1, b2, b3), (c1, c2, c3) = np.moveaxis(self.b, -2, 0), np.moveaxis(self.c, -2, 0)
        return {
            **{f"arm {i + 1}": (self.a[i], self.b[..., i, :], g.l3) for i in range(3)},
            "link 3": (b1 - ux, b1 + ux, 2 * g.l5),
            "rod 4a": (b1 + ux, c1 + ux, g.l4),
            "rod 4b": (b1 - ux, c1 - ux, g.l4),
            "rod 6": (b2, c2, g.l4),
            "link 3'": (c2, c1 + ux, 3 * g.l5),
            "offset C1D1": (c1, self.d1, g.l6),
            "link 7": (self.d1, self.e1, g.l7),
            "offset E1F1": (self.e1, self.f1, g.l6),
            "platform": (self.f1, self.d3, 2 * g.l2),
            "offset D3C3": (self.d3, c3, g.l6),
            "link 9": (b3 - uy, b3 + uy, 2 * g.l5),
            "rod 11a": (b3 + uy, c3 + uy, g.l4),
            "rod 11b": (b3 - uy, c3 - uy, g.l4),
            "link 10": (c3 - uy, c3 + uy, 2 * g.l5),
        }


def skeleton(position: FloatArray, mode: WorkingMode, geometry: Geometry = PAPER) -> Skeleton:
    """Return the mechanism with point P at ``position`` (..., 3) m on one working mode."""
    g = geometry
    solutions = inverse_all(position, g)
    theta = solutions.theta[..., mode.index, :]
    beta = solutions.beta[..., mode.index]
    zero = np.zeros_like(beta)
    arms = g.l3 * np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    pivots = np.array([[0.0, g.l1, 0.0], [-g.l1, 0.0, 0.0], [g.l1, 0.0, 0.0]])
    along = np.stack(
        [
            np.stack([zero, arms[..., 0, 0], arms[..., 0, 1]], axis=-1),
            np.stack([arms[..., 1, 0], zero, arms[..., 1, 1]], axis=-1),
            np.stack([arms[..., 2, 0], zero, arms[..., 2, 1]], axis=-1),
        ],
        axis=-2,
    )
    up = np.array([0.0, 0.0, g.l6])
    f1 = position - (g.l2, 0.0, 0.0)
    e1 = f1 - up
    d1 = e1 - g.l7 * np.stack([np.cos(beta), np.sin(beta), zero], axis=-1)
    d3 = f1 + (2 * g.l2, 0.0, 0.0)
    c = np.stack([d1 - up, d1 - up - (2 * g.l5, 0.0, 0.0), d3 - up], axis=-2)
    return Skeleton(pivots, pivots + along, c, d1, e1, f1, d3, theta, geometry)


def seen_from(azimuth: float, points: FloatArray) -> FloatArray:
    """Project points (..., 3) m to (..., 2) m, from an eye at an angle (rad) above the horizon."""
    sin_a, cos_a = np.sin(azimuth), np.cos(azimuth)
    sin_e, cos_e = np.sin(_ELEVATION), np.cos(_ELEVATION)
    right = np.array([-sin_a, cos_a, 0.0])
    up = np.array([-sin_e * cos_a, -sin_e * sin_a, cos_e])
    return np.stack([points @ right, points @ up], axis=-1)
