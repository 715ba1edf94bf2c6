"""A free block between table and cup, in any posture: a rigid body.

Contacts are those of the block's four lowest corners with the level below, and one with the cup. As
in PyBullet's direct solver, friction bears what the normal impulses would be without it. Both are
found side by side by sweeps over impulses, one contact after the other (projected Gauss-Seidel).

As in PyBullet, block and cup have their edges rounded for each other.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.mount import GRAVITY
from tpm_gym.simulation.analytic.body import (
    LITTLE,
    MASS,
    NORMAL,
    ROUGH,
    ROUNDING,
    SEEN_BY_LIP,
    SPIN,
    TILTED_SLIP,
    TURN,
    VX,
    VY,
    X,
    Z,
    axes,
    clip,
    cross,
    dot,
    least_rise,
    level_length,
    plus,
    put,
    slip_shares,
    three,
)
from tpm_gym.simulation.analytic.compiling import compiled

__all__ = ["Push", "tumble"]

# Contacts' directions, in order: up at the corners; the lip's normal; east and north at the
# corners; the lip's tangents, one level and one steep
_COUNT, _BEARING, _LIP, _EAST, _NORTH, _RUB = 15, 5, 4, 5, 9, 13
_SWEEPS = 48  # so many, as the cup's spring can press thirty times as hard as the block's weight
_NEVER = -1e3  # m/s

_Frame = tuple[Vector, Vector, Vector]


class Push(NamedTuple):
    """What the lip did in a time step.

    Attributes:
        back: How far the cup's spring gave way, m.
        impulse: On the block, N s.
        normal: Of the contact; zero for none.
    """

    back: float
    impulse: Vector
    normal: Vector


@compiled
def tumble(
    row: FloatArray, lip: Vector, speed: Vector, level: float, half: Vector, step: float
) -> Push:
    """Run a time step of a block.

    Args:
        row: The block; moved.
        lip: Centre of the lip before it, m, world.
        speed: Of the lip in it, with the spring on its way back, m/s.
        level: Height of what is below, m.
        half: Half edges of the block, m.
        step: s.
    """
    frame = axes(row)
    gap, normal, arm = _touch(row, frame, lip, half)
    corners = _corners(frame, half)
    jacobian = _jacobian(corners, normal, arm)
    twist = np.empty(6)
    put(twist, 0, three(row, VX))
    put(twist, 3, three(row, SPIN))
    twist[2] -= GRAVITY * step
    wanted = np.zeros(_COUNT)
    for corner in range(4):
        wanted[corner] = max(least_rise(row[Z] - level + corners[corner, 2]) / step, _NEVER)
    wanted[_LIP] = max(least_rise(gap, SEEN_BY_LIP) / step, _NEVER) + dot(normal, speed)
    for rub in (_RUB, _RUB + 1):
        wanted[rub] = dot(three(jacobian[rub], 0), speed)
    strength = CUP.preload * step / max(-normal[2], 1e-3)
    impulses = _solve(
        jacobian, row[MASS], half, frame[2], twist, wanted, strength, _grips(row, half)
    )
    press = impulses[_LIP]
    lacks = max(wanted[_LIP] - _weighed(jacobian[_LIP], twist), 0.0) * step
    back = lacks / max(-normal[2], 0.1) if press >= strength else 0.0
    force = (press * normal[0], press * normal[1], press * normal[2])
    for rub in (_RUB, _RUB + 1):
        force = plus(force, three(jacobian[rub], 0), impulses[rub])
    _move(row, twist, step)
    return Push(back, force, normal if press > 0 else (0.0, 0.0, 0.0))


@compiled
def _corners(frame: _Frame, half: Vector) -> FloatArray:
    """From the block's middle to its four lowest corners (4, 3) m."""
    p, q, r = half
    arms, taken = np.empty((8, 3)), np.zeros(8)
    for k in range(8):
        i, j, h = (p if k & 4 else -p), (q if k & 2 else -q), (r if k & 1 else -r)
        for d in range(3):
            arms[k, d] = i * frame[0][d] + j * frame[1][d] + h * frame[2][d]
    some = np.empty((4, 3))
    for k in range(4):
        lowest = -1
        for corner in range(8):
            if not taken[corner] and (lowest < 0 or arms[corner, 2] < arms[lowest, 2]):
                lowest = corner
        taken[lowest] = 1.0
        put(some[k], 0, three(arms[lowest], 0))
    return some


@compiled
def _jacobian(corners: FloatArray, normal: Vector, arm: Vector) -> FloatArray:
    """What velocity and spin are along all contacts' directions (c, 6)."""
    jacobian = np.zeros((_COUNT, 6))
    for k in range(4):
        x, y, z = corners[k]
        jacobian[k, 2] = jacobian[_EAST + k, 0] = jacobian[_NORTH + k, 1] = 1.0
        jacobian[k, 3], jacobian[k, 4] = y, -x
        jacobian[_EAST + k, 4], jacobian[_EAST + k, 5] = z, -y
        jacobian[_NORTH + k, 3], jacobian[_NORTH + k, 5] = -z, x
    a, b, _ = normal
    level = level_length(a, b)
    east = (-b / level, a / level, 0.0) if level > 1e-6 else (1.0, 0.0, 0.0)
    for k, way in ((_LIP, normal), (_RUB, east), (_RUB + 1, cross(normal, east))):
        put(jacobian[k], 0, way)
        put(jacobian[k], 3, cross(arm, way))
    return jacobian


@compiled
def _response(jacobian: FloatArray, mass: float, half: Vector, axis: Vector) -> FloatArray:
    """What impulses along the contacts' directions do to velocity and spin (c, 6)."""
    across = 3 / (mass * (half[0] ** 2 + half[2] ** 2))
    along = 3 / (mass * 2 * half[0] ** 2)
    response = np.empty((_COUNT, 6))
    for k in range(_COUNT):
        turn = three(jacobian[k], 3)
        about = (along - across) * dot(turn, axis)
        for d in range(3):
            response[k, d] = jacobian[k, d] / mass
            response[k, 3 + d] = across * turn[d] + axis[d] * about
    return response


@compiled
def _solve(
    jacobian: FloatArray,
    mass: float,
    half: Vector,
    axis: Vector,
    twist: FloatArray,
    wanted: FloatArray,
    strength: float,
    grips: FloatArray,
) -> FloatArray:
    """Find impulses (c,), and with them velocity and spin (6,) from those without, ``twist``."""
    response = _response(jacobian, mass, half, axis)
    keeps, constant = np.empty((_COUNT, _COUNT)), np.empty(_COUNT)
    for k in range(_COUNT):
        share = 1 / _weighed(jacobian[k], response[k])
        constant[k] = share * (wanted[k] - _weighed(jacobian[k], twist))
        for other in range(_COUNT):
            keeps[k, other] = -share * _weighed(jacobian[k], response[other])
        keeps[k, k] = 0.0
    found, plain = np.zeros(_COUNT), np.zeros(_BEARING)  # plain: without friction, for its bounds
    for _ in range(_SWEEPS):
        for k in range(_BEARING):
            high = strength if k == _LIP else math.inf
            plain[k] = clip(constant[k] + _weighed(keeps[k], plain), 0.0, high)
            found[k] = clip(constant[k] + _weighed(keeps[k], found), 0.0, high)
        for k in range(_BEARING, _COUNT):
            bearer = _LIP if k >= _RUB else (k - _EAST) % 4
            bound = grips[k - _BEARING] * plain[bearer]
            found[k] = clip(constant[k] + _weighed(keeps[k], found), -bound, bound)
    for k in range(_COUNT):
        for d in range(6):
            twist[d] += response[k, d] * found[k]
    return found


@compiled
def _weighed(parts: FloatArray, weights: FloatArray) -> float:
    """Sum of products, as many as there are weights."""
    total = 0.0
    for k in range(len(weights)):
        total += parts[k] * weights[k]
    return total


@compiled
def _grips(row: FloatArray, half: Vector) -> FloatArray:
    """What share of what bears it each friction can be (c - 5,)."""
    x, y = row[VX] - half[2] * row[SPIN + 1], row[VY] + half[2] * row[SPIN]
    east, north = slip_shares(x, y, TILTED_SLIP)
    grips = np.empty(_COUNT - _BEARING)
    for k in range(4):
        grips[k], grips[4 + k] = row[ROUGH] * east, row[ROUGH] * north
    grips[8] = grips[9] = CUP.friction * row[ROUGH]
    return grips


@compiled
def _move(row: FloatArray, twist: FloatArray, step: float) -> None:
    """The block a time step on, at that velocity and spin."""
    velocity, spin = three(twist, 0), three(twist, 3)
    put(row, X, plus(three(row, X), velocity, step))
    put(row, VX, velocity)
    put(row, SPIN, spin)
    x, y, z = 0.5 * step * spin[0], 0.5 * step * spin[1], 0.5 * step * spin[2]
    a, b, c, d = row[TURN], row[TURN + 1], row[TURN + 2], row[TURN + 3]
    e, f = a + x * d + y * c - z * b, b + y * d + z * a - x * c
    g, h = c + z * d + x * b - y * a, d - (x * a + y * b + z * c)
    length = math.sqrt((e * e + f * f) + (g * g + h * h))
    put(row, TURN, (e / length, f / length, g / length))
    row[TURN + 3] = h / length


@compiled
def _touch(
    row: FloatArray, frame: _Frame, lip: Vector, half: Vector
) -> tuple[float, Vector, Vector]:
    """Where cup and block are nearest: gap m, normal, arm on the block m; far off if they are."""
    middle = three(row, X)
    away = plus(middle, (lip[0], lip[1], lip[2] + CUP.bellows / 2), -1.0)
    cup = math.sqrt(CUP.radius**2 + (CUP.bellows / 2) ** 2)
    if dot(away, away) >= (math.sqrt(dot(half, half)) + cup + SEEN_BY_LIP) ** 2:
        return math.inf, (0.0, 0.0, -1.0), (0.0, 0.0, 0.0)
    there, cup_point = _nearest(middle, frame, lip, half)
    apart = plus(there, cup_point, -1.0)
    distance = math.sqrt(dot(apart, apart))
    if distance < 1e-7:
        gap, normal = _inside(row, frame, lip, half)
    else:
        share = 1 / max(distance, LITTLE)
        gap = distance - 2 * ROUNDING
        normal = (apart[0] * share, apart[1] * share, apart[2] * share)
    return gap, normal, plus(plus(there, normal, -ROUNDING), middle, -1.0)


@compiled
def _nearest(middle: Vector, frame: _Frame, lip: Vector, half: Vector) -> tuple[Vector, Vector]:
    """Nearest points of the cores of block and cup: by projecting from one to the other."""
    bottom = lip[2] + ROUNDING
    top = bottom + (CUP.bellows - 2 * ROUNDING)
    there, cup = middle, lip
    for _ in range(4):
        x, y = there[0] - lip[0], there[1] - lip[1]
        share = min((CUP.radius - ROUNDING) / max(level_length(x, y), LITTLE), 1.0)
        cup = (lip[0] + share * x, lip[1] + share * y, clip(there[2], bottom, top))
        out, there = plus(cup, middle, -1.0), middle
        for k in range(3):
            core = half[k] - ROUNDING
            there = plus(there, frame[k], clip(dot(frame[k], out), -core, core))
    return there, cup


@compiled
def _inside(row: FloatArray, frame: _Frame, lip: Vector, half: Vector) -> tuple[float, Vector]:
    """Gap and normal where the cup is in the block: as in the last contact, or the nearest way."""
    middle, normal = three(row, X), three(row, NORMAL)
    if dot(normal, normal) > 0.5:
        return _apart(normal, middle, frame, lip, half), normal
    normal = (0.0, 0.0, -1.0)
    best = _apart(normal, middle, frame, lip, half)
    for axis in frame[:2]:
        for sign in (-1.0, 1.0):
            way = (sign * axis[0], sign * axis[1], sign * axis[2])
            gap = _apart(way, middle, frame, lip, half)
            if gap > best:
                best, normal = gap, way
    return best, normal


@compiled
def _apart(normal: Vector, middle: Vector, frame: _Frame, lip: Vector, half: Vector) -> float:
    """How far cup and block are apart along a normal, m."""
    away = dot(normal, plus(middle, lip, -1.0))
    block = 0.0
    for k in range(3):
        block += half[k] * abs(dot(frame[k], normal))
    level = level_length(normal[0], normal[1])
    return away - block - CUP.radius * level - CUP.bellows * max(normal[2], 0.0)
