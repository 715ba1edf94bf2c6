"""Where the two operation modes meet, and where the rotated one can be.

The mechanism moves in one of two modes (:mod:`tpm_gym.kinematics.rotated`). It can change from one
to the other where they meet, at the constraint singularity z_C1 = z_B1, and nowhere else. In the
paper frame, metres and radians.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.analysis.aspects import DEFAULT_SHAPE, Cells, Shape
from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.kinematics.rotated import inverse_rotated


def transition(
    theta_1: ArrayLike, beta: ArrayLike, side: ArrayLike = -1, geometry: Geometry = PAPER
) -> FloatArray:
    """Points P (..., 3) m of the surface on which both modes meet.

    Angles (...,) rad and ``side`` (...,), the sign of xC, broadcast. The surface is a curve of C1,
    on which rods 4a and 4b are level in x, swept by link 7. NaN where rods 4 do not reach y = 0;
    that arms 2 and 3 reach is not checked.
    """
    g, (one, turn) = geometry, (np.asarray(theta_1), np.asarray(beta))
    with np.errstate(invalid="ignore"):
        x_c = side * np.sqrt(g.l4**2 - (g.l1 + g.l3 * np.cos(one)) ** 2)
    x, y = x_c + g.l7 * np.cos(turn) + g.l2, g.l7 * np.sin(turn)
    return np.stack(np.broadcast_arrays(x, y, g.l3 * np.sin(one) + 2 * g.l6), axis=-1)


def rotated_set(geometry: Geometry = PAPER, shape: Shape = DEFAULT_SHAPE) -> Cells:
    """Where point P can be with link 3' turned, whatever its tilt, as cells of a grid.

    ``shape`` counts cells along x, y, z; along y an even number.
    """
    g = geometry
    leg3 = g.l3 + g.l4 + math.hypot(g.l2, g.l6)  # from A3
    leg1 = g.l4 + math.hypot(g.l2 + g.l7, 2 * g.l6)  # from the plane x = 0
    low = np.array([max(g.l1 - leg3, -leg1), -g.l7, -leg3])
    high = np.array([min(g.l1 + leg3, leg1), g.l7, leg3])
    spacing = (high - low) / shape
    half = np.indices((shape[0], shape[1] // 2, shape[2]))  # the other is its mirror image
    centres = low + (np.moveaxis(half, 0, -1) + 0.5) * spacing
    mask: BoolArray = np.any(inverse_rotated(centres, g).valid, axis=-1)
    corner, edges = tuple(low.tolist()), tuple(spacing.tolist())
    return Cells(corner, edges, np.concatenate([mask, mask[:, ::-1]], axis=1))
