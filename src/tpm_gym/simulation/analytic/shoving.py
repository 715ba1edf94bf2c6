"""A block that stands on the table and is shoved by the lip: planar, as long as it does not tip."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.mechanism.cup import CUP
from tpm_gym.simulation.analytic.tumbling import ROUNDING, SEEN_BY_LIP, least_rise

__all__ = ["Shove", "Side", "Standing", "Strengths", "shove", "side_of"]

_SWEEPS = 4
_SHARE = 1 / 8  # of the masses; between the inverse masses of a drag, 4, and of a twist, 12
_SLIP = 1e-4  # m/s
_LEAST = 0.02  # of the friction along the axis across which it slips
_LEAST_LEVEL = 1e-3
_CORNERS = np.array([[1.0, 1.0, -1.0, -1.0], [1.0, -1.0, 1.0, -1.0]])
_LITTLE = 1e-12
_BOTH = 2 * ROUNDING
_CORE = CUP.radius - ROUNDING


class Side(NamedTuple):
    """How lips stand to the sides of upright blocks (m,).

    Attributes:
        gap: m, between the two.
        normal: (2, m) level direction from lip to block, world.
        arm: (2, m) m, from the block's middle to the point of contact, world.
        away: m, by which the rounded parts' cores are apart; negative over the top face.
        local: (2, m) the normal in the block's frame.
        place: (2, m) m, the arm in the block's frame.
        level: Share of the contact's normal along the level.
        slant: Share of it that points down.
    """

    gap: FloatArray
    normal: FloatArray
    arm: FloatArray
    away: FloatArray
    local: FloatArray
    place: FloatArray
    level: FloatArray
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
    # A middle over the core comes out through the nearest side.
    inside = far < _LITTLE
    first = np.abs(local[0]) > np.abs(local[1])
    through = np.stack([first, ~first]) * -np.sign(local)
    way = np.where(inside, through, out / np.maximum(far, _LITTLE))
    depth = core - np.maximum(np.abs(local[0]), np.abs(local[1]))
    apart = np.where(inside, -depth, far) - _CORE
    higher = np.maximum(_BOTH - overlap, 0.0)
    beside = np.maximum(apart, 0.0)
    distance = np.sqrt(beside * beside + higher * higher)
    gap = np.where(distance > _LITTLE, distance, apart) - _BOTH
    slant = np.where(apart > _LITTLE, higher / np.maximum(distance, _LITTLE), 0.0)
    level = np.sqrt(np.maximum(1 - slant * slant, _LEAST_LEVEL))
    place = nearest - ROUNDING * way
    normal = np.stack([way[0] * cosine - way[1] * sine, way[0] * sine + way[1] * cosine])
    arm = np.stack([place[0] * cosine - place[1] * sine, place[0] * sine + place[1] * cosine])
    return Side(gap, normal, arm, apart, way, place, level, slant)


class Standing(NamedTuple):
    """Blocks that stand: velocity (3, m) m/s, turning (m,) rad/s, quaternions (4, m)."""

    velocity: FloatArray
    turning: FloatArray
    turn: FloatArray


class Strengths(NamedTuple):
    """What may act on blocks (m,).

    Attributes:
        weight: m/s, impulse with which the table carries them, by their mass.
        spring: m/s, impulse of the cup's spring, by their mass.
        rough: Coulomb coefficient on the table.
    """

    weight: FloatArray
    spring: FloatArray
    rough: FloatArray


class Shove(NamedTuple):
    """What a shove does in a time step.

    Attributes:
        velocity: (2, m) m/s after it.
        turning: (m,) rad/s after it.
        impulse: (2, m) m/s, of the lip on the block along the level, by its mass.
        tips: (m,) whether the table cannot hold the block upright.
    """

    velocity: FloatArray
    turning: FloatArray
    impulse: FloatArray
    tips: BoolArray


def shove(
    side: Side,
    block: Standing,
    lip: FloatArray,
    strengths: Strengths,
    size: tuple[float, float],
    height: FloatArray,
    step: float,
) -> Shove:
    """Shove standing blocks for a time step (s); all impulses by the blocks' masses.

    As in PyBullet's direct solver, what friction can bear is what the normal forces would be
    without it, and along the world's axes apart.

    Args:
        side: Where the lips are.
        block: The blocks before it.
        lip: (3, m) m/s, of the lips.
        strengths: What may act.
        size: The blocks' width and height, m.
        height: (m,) m, at which the lips push, over the table.
        step: s.
    """
    (velocity, turning, turn), (weight, strength, rough) = block, strengths
    (nx, ny), (rx, ry), half = side.normal, side.arm, size[0] / 2
    ease = 6 / size[0] ** 2  # mass over moment of inertia about the vertical
    lever_n, lever_t = rx * ny - ry * nx, rx * nx + ry * ny
    vx, vy, spin = velocity[0], velocity[1], turning
    lip_t = lip[1] * nx - lip[0] * ny
    steep = side.slant / side.level
    least = np.maximum(least_rise(side.gap, SEEN_BY_LIP) / step, -1e3) / side.level
    least = least + lip[0] * nx + lip[1] * ny + steep * (velocity[2] - lip[2])
    share_n, share_t = 1 / (1 + ease * lever_n * lever_n), 1 / (1 + ease * lever_t * lever_t)
    most = strength / np.maximum(steep, 1e-3)
    # Without friction: what the corners carry, which the push tips over those in front
    lever = height - size[1] / 2 + steep * (rx * nx + ry * ny)
    front = half * (np.abs(side.local[0]) + np.abs(side.local[1]))
    radius = (size[0] ** 2 + size[1] ** 2) / 12  # of gyration, about an edge's direction, squared
    yields = 1 + front * front / radius
    wanted = np.maximum(least - vx * nx - vy * ny - lever_n * spin, 0.0)
    push = np.minimum(share_n * wanted, most)
    total = weight + push * steep
    tipping = total + front * lever * push / radius > total * yields
    softer = 1 / share_n + lever * lever / (radius * yields)
    push = np.where(tipping, np.minimum(wanted / softer, most), push)
    limit = CUP.friction * rough * push / side.level
    total = weight + push * steep
    total = np.maximum(total, (total + front * lever * push / radius) / yields)
    load = np.maximum(total, _LITTLE)
    a, b = (np.minimum(np.maximum(lever * push * n / (load * half), -1.0), 1.0) for n in side.local)
    corners = 0.25 * total * (1 + _CORNERS[0, :, None] * a) * (1 + _CORNERS[1, :, None] * b)
    cosine, sine = 1 - 2 * turn[2] * turn[2], 2 * turn[2] * turn[3]
    x = half * (_CORNERS[0, :, None] * cosine - _CORNERS[1, :, None] * sine)
    y = half * (_CORNERS[0, :, None] * sine + _CORNERS[1, :, None] * cosine)
    arms = np.stack([-y, x])  # of the corners' forces along x and y
    speed = np.sqrt(vx * vx + vy * vy)
    slips = speed > _SLIP
    ways = np.where(slips, np.abs(velocity[:2]) / np.maximum(speed, _SLIP), math.sqrt(0.5))
    bounds = rough * corners * np.maximum(ways, _LEAST)[:, None]
    drag, rub = np.zeros_like(bounds), np.zeros_like(push)
    before = vx * nx + vy * ny
    push = np.zeros_like(push)
    up = np.zeros_like(push)  # friction along the slant, which presses less and pushes more
    share_up = share_n / np.maximum(side.slant * side.slant, 1e-3)
    rises = side.level * (velocity[2] - lip[2]) - side.slant * (lip[0] * nx + lip[1] * ny)
    for _ in range(_SWEEPS):
        wish = up - share_up * (side.slant * (vx * nx + vy * ny + lever_n * spin) + rises)
        after = np.minimum(np.maximum(wish, -limit), limit)
        p = side.slant * (after - up)
        up = after
        vx, vy, spin = vx + p * nx, vy + p * ny, spin + ease * lever_n * p
        most = np.maximum(strength + side.level * up, 0.0) / np.maximum(steep, 1e-3)
        after = push + share_n * (least - vx * nx - vy * ny - lever_n * spin)
        after = np.minimum(np.maximum(after, 0.0), most)
        wish = rub - share_t * (vy * nx - vx * ny + lever_t * spin - lip_t)
        beside = np.minimum(np.maximum(wish, -limit), limit)
        p, q = after - push, beside - rub
        push, rub = after, beside
        vx, vy = vx + (p * nx - q * ny), vy + (p * ny + q * nx)
        spin = spin + ease * (lever_n * p + lever_t * q)
        slip = np.stack([vx, vy])[:, None] + arms * spin
        after = np.minimum(np.maximum(drag - _SHARE * slip, -bounds), bounds)
        change = after - drag
        drag = after
        twist = arms * change
        change = (change[:, 0] + change[:, 1]) + (change[:, 2] + change[:, 3])
        twist = (twist[:, 0] + twist[:, 1]) + (twist[:, 2] + twist[:, 3])
        vx, vy, spin = vx + change[0], vy + change[1], spin + ease * (twist[0] + twist[1])
    push = push + side.slant * up
    moment = push * height - (vx * nx + vy * ny - before) * (size[1] / 2)
    lacks = moment * np.abs(side.local) - half * weight
    reach = half - side.place * np.sign(side.local)
    tips: BoolArray = (lacks > (push * steep + limit) * reach).any(axis=0)
    impulse = np.stack([push * nx - rub * ny, push * ny + rub * nx])
    return Shove(np.stack([vx, vy]), spin, impulse, tips)
