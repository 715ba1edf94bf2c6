"""A block that stands on the table and is shoved by the lip: planar, as long as it does not tip."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.mechanism.cup import CUP
from tpm_gym.simulation.analytic.tumbling import ROUNDING, least_rise

__all__ = ["Shove", "Side", "shove", "side_of"]

_SWEEPS = 5
_LITTLE = 1e-12
_BOTH = 2 * ROUNDING
_CORE = CUP.radius - ROUNDING


class Side(NamedTuple):
    """How lips stand to standing blocks (m,), seen from above.

    Attributes:
        gap: m, between lip and side, along the level; what is rounded is nearer the higher the lip.
        normal: (2, m) from lip to block, world.
        arm: (2, m) m, from the block's middle to the point of contact, world.
        away: m, by which the rounded parts' cores are apart; negative over the top face.
        local: (2, m) the normal in the block's frame.
        place: (2, m) m, the arm in the block's frame.
        slant: Sine by which the normal points down.
    """

    gap: FloatArray
    normal: FloatArray
    arm: FloatArray
    away: FloatArray
    local: FloatArray
    place: FloatArray
    slant: FloatArray


def side_of(away: FloatArray, turn: FloatArray, overlap: FloatArray, half: float) -> Side:
    """Where lips could touch the sides of upright blocks.

    Args:
        away: (2, m) m, world, from the blocks' middles to the lips'.
        turn: (4, m) quaternions.
        overlap: (m,) m, how far the lips are below the top faces.
        half: Half the blocks' width, m.
    """
    cosine, sine = 1 - 2 * turn[2] * turn[2], 2 * turn[2] * turn[3]
    local = np.stack([away[0] * cosine + away[1] * sine, away[1] * cosine - away[0] * sine])
    core = half - ROUNDING
    nearest = np.minimum(np.maximum(local, -core), core)
    out = nearest - local
    far = np.sqrt(out[0] * out[0] + out[1] * out[1])
    way = out / np.maximum(far, _LITTLE)
    # A middle over the core: through the nearest side
    inside = far < _LITTLE
    first = np.abs(local[0]) > np.abs(local[1])
    nearest_side = np.stack([first, ~first]) * -np.sign(local)
    way = np.where(inside, nearest_side, way)
    depth = core - np.maximum(np.abs(local[0]), np.abs(local[1]))
    far = np.where(inside, -depth, far)
    higher = np.minimum(np.maximum(_BOTH - overlap, 0.0), _BOTH)
    gap = far - _CORE - np.sqrt(_BOTH * _BOTH - higher * higher)
    place = nearest - ROUNDING * way
    normal = np.stack([way[0] * cosine - way[1] * sine, way[0] * sine + way[1] * cosine])
    arm = np.stack([place[0] * cosine - place[1] * sine, place[0] * sine + place[1] * cosine])
    return Side(gap, normal, arm, far - _CORE, way, place, higher / _BOTH)


class Shove(NamedTuple):
    """What a shove does in a time step.

    Attributes:
        velocity: (2, m) m/s after it.
        turning: (m,) rad/s after it.
        impulse: (2, m) m/s, of the lip on the block, by its mass.
        tips: (m,) whether the table cannot hold the block upright.
    """

    velocity: FloatArray
    turning: FloatArray
    impulse: FloatArray
    tips: BoolArray


def shove(
    side: Side,
    velocity: FloatArray,
    turning: FloatArray,
    lip: FloatArray,
    normal: FloatArray,
    rough: FloatArray,
    size: tuple[float, float],
    height: FloatArray,
    step: float,
) -> Shove:
    """Shove standing blocks for a time step (s); all impulses by the blocks' masses.

    Args:
        side: Where the lips are.
        velocity: (2, m) m/s before it.
        turning: (m,) rad/s before it.
        lip: (2, m) m/s, of the lips.
        normal: (m,) m/s, impulse with which the tables carry the blocks.
        rough: (m,) Coulomb coefficient on the tables.
        size: The blocks' width and height, m.
        height: (m,) m, at which the lips push, over the table.
        step: s.
    """
    (nx, ny), (rx, ry) = side.normal, side.arm
    width = size[0]
    ease = 6 / width**2  # mass over moment of inertia about the vertical
    lever_n, lever_t = rx * ny - ry * nx, rx * nx + ry * ny
    along, across = velocity[0] * nx + velocity[1] * ny, velocity[1] * nx - velocity[0] * ny
    lip_n, lip_t = lip[0] * nx + lip[1] * ny, lip[1] * nx - lip[0] * ny
    least = np.maximum(least_rise(side.gap) / step, -1e3) + lip_n
    share_n, share_t = 1 / (1 + ease * lever_n * lever_n), 1 / (1 + ease * lever_t * lever_t)
    most = rough * normal
    corner = width / math.sqrt(2)
    before = along
    push = rub = drag_n = drag_t = twist = np.zeros_like(turning)
    friction = CUP.friction * rough
    for _ in range(_SWEEPS):
        after = np.maximum(push + share_n * (least - along - lever_n * turning), 0.0)
        along, turning = along + (after - push), turning + ease * lever_n * (after - push)
        push = after
        limit = friction * push
        wish = rub - share_t * (across + lever_t * turning - lip_t)
        after = np.minimum(np.maximum(wish, -limit), limit)
        across, turning = across + (after - rub), turning + ease * lever_t * (after - rub)
        rub = after
        # The table's friction: an ellipsoid of drag and twist
        a, b, c = drag_n - along, drag_t - across, twist - turning / ease
        length = np.sqrt(a * a + b * b + c * c / corner**2)
        share = np.minimum(most / np.maximum(length, _LITTLE), 1.0)
        a, b, c = share * a, share * b, share * c
        along, across = along + (a - drag_n), across + (b - drag_t)
        turning = turning + ease * (c - twist)
        drag_n, drag_t, twist = a, b, c
    moment = push * height - (along - before) * (size[1] / 2)
    tips = _tips(side, moment, push, normal, friction, width / 2)
    speed = np.stack([along * nx - across * ny, along * ny + across * nx])
    return Shove(speed, turning, np.stack([push * nx - rub * ny, push * ny + rub * nx]), tips)


def _tips(
    side: Side,
    moment: FloatArray,
    push: FloatArray,
    weight: FloatArray,
    friction: FloatArray,
    half: float,
) -> BoolArray:
    """Whether the pressure's centre leaves the bottom, however much the lip's friction helps.

    The lip's force may point down within its cone, which the rounding slants.
    """
    level = np.sqrt(np.maximum(1 - side.slant * side.slant, _LITTLE))
    steep = side.slant / level
    down = (steep + friction) / np.maximum(1 - steep * friction, _LITTLE)
    down = np.where(steep * friction < 1, np.minimum(down, 100.0), 100.0) * push
    # Along each of the block's axes, in the direction of the push
    lacks = moment * np.abs(side.local) - half * weight
    reach = half - side.place * np.sign(side.local)
    tips: BoolArray = (lacks > down * reach).any(axis=0)
    return tips
