"""A block that stands on the table and is shoved by the lip: planar, as long as it does not tip."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.mechanism.cup import CUP
from tpm_gym.simulation.analytic.body import (
    LITTLE,
    MASS,
    ROUGH,
    ROUNDING,
    SEEN_BY_LIP,
    SPIN,
    TURN,
    VX,
    VY,
    VZ,
    X,
    Y,
    clip,
    least_rise,
    level_length,
    slip_shares,
)
from tpm_gym.simulation.analytic.compiling import compiled

__all__ = ["Shove", "Side", "drags_over", "shove", "side_of"]

_SWEEPS = 4
_SHARE = 1 / 8  # of the masses; between the inverse masses of a drag, 4, and of a twist, 12
_LEAST_LEVEL = 1e-3
_BOTH = 2 * ROUNDING
_CORE = CUP.radius - ROUNDING


class Side(NamedTuple):
    """How the lip stands to the sides of an upright block.

    Attributes:
        gap: m, between the two.
        nx: Level direction from lip to block, world.
        ny: The same along y.
        rx: m, from the block's middle to the point of contact, world.
        ry: The same along y.
        away: m, by which the rounded parts' cores are apart; negative over the top face.
        u: The normal in the block's frame.
        v: The same along y.
        p: m, the arm in the block's frame.
        q: The same along y.
        level: Share of the contact's normal along the level.
        slant: Share of it that points down.
    """

    gap: float
    nx: float
    ny: float
    rx: float
    ry: float
    away: float
    u: float
    v: float
    p: float
    q: float
    level: float
    slant: float


@compiled
def _heading(row: FloatArray) -> tuple[float, float]:
    """Cosine and sine of an upright block's turn."""
    z, w = row[TURN + 2], row[TURN + 3]
    return 1 - 2 * z * z, 2 * z * w


@compiled
def side_of(row: FloatArray, lip_x: float, lip_y: float, overlap: float, half: float) -> Side:
    """Where a lip (m, world) could touch the sides of an upright block.

    Args:
        row: The block.
        lip_x: Of the lip's centre.
        lip_y: Of the lip's centre.
        overlap: m, how far the lip is below the top face.
        half: Half the block's width, m.
    """
    cosine, sine = _heading(row)
    x, y = lip_x - row[X], lip_y - row[Y]
    a, b = x * cosine + y * sine, y * cosine - x * sine
    core = half - ROUNDING
    nearest_a, nearest_b = clip(a, -core, core), clip(b, -core, core)
    u, v = nearest_a - a, nearest_b - b
    far = level_length(u, v)
    if far < LITTLE:  # A middle over the core comes out through the nearest side.
        apart = max(abs(a), abs(b)) - core - _CORE
        if abs(a) > abs(b):
            u, v = -math.copysign(1.0, a), 0.0
        else:
            u, v = 0.0, -math.copysign(1.0, b)
    else:
        apart = far - _CORE
        u, v = u / far, v / far
    higher, beside = max(_BOTH - overlap, 0.0), max(apart, 0.0)
    distance = level_length(beside, higher)
    gap = (distance if distance > LITTLE else apart) - _BOTH
    slant = higher / max(distance, LITTLE) if apart > LITTLE else 0.0
    level = math.sqrt(max(1 - slant * slant, _LEAST_LEVEL))
    p, q = nearest_a - ROUNDING * u, nearest_b - ROUNDING * v
    return Side(
        gap,
        u * cosine - v * sine,
        u * sine + v * cosine,
        p * cosine - q * sine,
        p * sine + q * cosine,
        apart,
        u,
        v,
        p,
        q,
        level,
        slant,
    )


class Shove(NamedTuple):
    """What a shove does in a time step; impulses by the block's mass.

    Attributes:
        vx: m/s after it.
        vy: m/s after it.
        spin: rad/s after it.
        push: (x, y) m/s, impulse of the lip on the block along the level.
        tips: Whether the table cannot hold the block upright.
    """

    vx: float
    vy: float
    spin: float
    push: tuple[float, float]
    tips: bool


class _Bearing(NamedTuple):
    """What bears what: the lip's friction, and how the table carries the corners.

    Attributes:
        friction: Most of it between lip and block, m/s.
        total: What the table carries, m/s.
        tilt: (a, b) share that moves from one corner to the other, along the block's axes.
    """

    friction: float
    total: float
    tilt: tuple[float, float]


@compiled
def _bearing(
    row: FloatArray,
    side: Side,
    least: float,
    weight: float,
    strength: float,
    lever: float,
    half: Vector,
) -> _Bearing:
    """What would be without friction: the corners carry what the push tips over those in front."""
    steep, width = side.slant / side.level, half[0]
    lever_n = side.rx * side.ny - side.ry * side.nx
    share = 1 / (1 + 1.5 / width**2 * lever_n * lever_n)
    front = width * (abs(side.u) + abs(side.v))
    radius = (width**2 + half[2] ** 2) / 3  # of gyration, about an edge's direction, squared
    yields = 1 + front * front / radius
    wanted = least - row[VX] * side.nx - row[VY] * side.ny - lever_n * row[SPIN + 2]
    wanted, most = max(wanted, 0.0), strength / max(steep, 1e-3)
    push = min(share * wanted, most)
    total = weight + push * steep
    if total + front * lever * push / radius > total * yields:
        push = min(wanted / (1 / share + lever * lever / (radius * yields)), most)
        total = weight + push * steep
    friction = CUP.friction * row[ROUGH] * push / side.level
    total = max(total, (total + front * lever * push / radius) / yields)
    moment = lever * push / (max(total, LITTLE) * width)
    return _Bearing(
        friction, total, (clip(moment * side.u, -1.0, 1.0), clip(moment * side.v, -1.0, 1.0))
    )


@compiled
def _bounds(row: FloatArray, bearing: _Bearing) -> FloatArray:
    """What friction can take at each corner along the world's axes (2, 4) m/s."""
    east, north = slip_shares(row[VX], row[VY])
    bounds = np.empty((2, 4))
    for k in range(4):
        i, j = (1.0 if k < 2 else -1.0), (1.0 if k % 2 == 0 else -1.0)
        share = 0.25 * (1 + i * bearing.tilt[0]) * (1 + j * bearing.tilt[1])
        bounds[0, k] = row[ROUGH] * share * bearing.total * east
        bounds[1, k] = row[ROUGH] * share * bearing.total * north
    return bounds


@compiled
def _arms(row: FloatArray, half: float) -> FloatArray:
    """Arms of the corners' forces along the world's axes (2, 4) m."""
    cosine, sine = _heading(row)
    arms = np.empty((2, 4))
    for k in range(4):
        a, b = (half if k < 2 else -half), (half if k % 2 == 0 else -half)
        arms[0, k], arms[1, k] = -(a * sine + b * cosine), a * cosine - b * sine
    return arms


@compiled
def shove(
    row: FloatArray,
    side: Side,
    lip: Vector,
    weight: float,
    height: float,
    half: Vector,
    step: float,
) -> Shove:
    """Shove a standing block for a time step.

    As in PyBullet's direct solver, what friction can bear is what the normal forces would be
    without it, and along the world's axes apart.

    Args:
        row: The block before it.
        side: Where the lip is.
        lip: Velocity of the lip, m/s.
        weight: Impulse with which the table carries the block, by its mass, m/s.
        height: Over the table, at which the lip pushes, m.
        half: Half edges of the block, m.
        step: s.
    """
    nx, ny, steep = side.nx, side.ny, side.slant / side.level
    ease = 1.5 / half[0] ** 2  # mass over moment of inertia about the vertical
    lever_n, lever_t = side.rx * ny - side.ry * nx, side.rx * nx + side.ry * ny
    share_n, share_t = 1 / (1 + ease * lever_n * lever_n), 1 / (1 + ease * lever_t * lever_t)
    strength = CUP.preload * step / row[MASS]
    least = max(least_rise(side.gap, SEEN_BY_LIP) / step, -1e3) / side.level
    least += lip[0] * nx + lip[1] * ny + steep * (row[VZ] - lip[2])
    lever = height - half[2] + steep * (side.rx * nx + side.ry * ny)
    bearing = _bearing(row, side, least, weight, strength, lever, half)
    limit = bearing.friction
    bounds, arms, drag = _bounds(row, bearing), _arms(row, half[0]), np.zeros((2, 4))
    vx, vy, spin = row[VX], row[VY], row[SPIN + 2]
    push = rub = up = 0.0  # up: friction along the slant, which presses less and pushes more
    share_up = share_n / max(side.slant * side.slant, 1e-3)
    rises = side.level * (row[VZ] - lip[2]) - side.slant * (lip[0] * nx + lip[1] * ny)
    lip_t = lip[1] * nx - lip[0] * ny
    for _ in range(_SWEEPS):
        before = up
        up -= share_up * (side.slant * (vx * nx + vy * ny + lever_n * spin) + rises)
        up = clip(up, -limit, limit)
        p = side.slant * (up - before)
        vx, vy, spin = vx + p * nx, vy + p * ny, spin + ease * lever_n * p
        most = max(strength + side.level * up, 0.0) / max(steep, 1e-3)
        after = push + share_n * (least - vx * nx - vy * ny - lever_n * spin)
        after = clip(after, 0.0, most)
        beside = rub - share_t * (vy * nx - vx * ny + lever_t * spin - lip_t)
        beside = clip(beside, -limit, limit)
        p, q = after - push, beside - rub
        push, rub = after, beside
        vx, vy = vx + (p * nx - q * ny), vy + (p * ny + q * nx)
        spin += ease * (lever_n * p + lever_t * q)
        vx, vy, spin = _rub(vx, vy, spin, ease, drag, bounds, arms)
    push += side.slant * up
    moment = push * height - ((vx - row[VX]) * nx + (vy - row[VY]) * ny) * half[2]
    tips = False
    for way, place in ((side.u, side.p), (side.v, side.q)):
        lacks = moment * abs(way) - half[0] * weight
        reach = half[0] - (math.copysign(place, place * way) if way else 0.0)
        tips |= lacks > (push * steep + limit) * reach
    return Shove(vx, vy, spin, (push * nx - rub * ny, push * ny + rub * nx), tips)


@compiled
def drags_over(
    row: FloatArray, lip: Vector, slip: Vector, press: float, weight: float, half: Vector
) -> bool:
    """Whether a lip that slides over the top face of a standing block tips it over an edge.

    It drags along its slip, at the height of the face, and holds down where it is farthest from
    that edge. It never drags a block along: the table, which bears more, is twice as rough.

    Args:
        row: The block.
        lip: Centre of the lip, m, world.
        slip: Of the lip over the face, in any unit.
        press: Impulse of the lip, by the block's mass, m/s.
        weight: Impulse of the table without the lip, by the mass, m/s.
        half: Half edges of the block, m.
    """
    cosine, sine = _heading(row)
    x, y, fast = lip[0] - row[X], lip[1] - row[Y], max(level_length(slip[0], slip[1]), LITTLE)
    drag = CUP.friction * row[ROUGH] * press
    for east, north in ((cosine, sine), (-sine, cosine)):
        along, place = (slip[0] * east + slip[1] * north) / fast, x * east + y * north
        arm = half[0] - max(math.copysign(place, place * along) - _CORE, -half[0])
        if drag * abs(along) * 2 * half[2] > press * arm + weight * half[0]:
            return True
    return False


@compiled
def _rub(
    vx: float,
    vy: float,
    spin: float,
    ease: float,
    drag: FloatArray,
    bounds: FloatArray,
    arms: FloatArray,
) -> tuple[float, float, float]:
    """A sweep over the corners' friction (2, 4), ``drag``; velocity and turning after it."""
    drag_x = drag_y = twist = 0.0
    for k in range(4):
        for way in range(2):
            arm = arms[way, k]
            slip = (vx if way == 0 else vy) + arm * spin
            after = clip(drag[way, k] - _SHARE * slip, -bounds[way, k], bounds[way, k])
            change = after - drag[way, k]
            drag[way, k] = after
            twist += arm * change
            if way == 0:
                drag_x += change
            else:
                drag_y += change
    return vx + drag_x, vy + drag_y, spin + ease * twist
