"""A free block between table and cup, in any posture: rigid bodies in batches.

Contacts are those of the block's four lowest corners with the level below, and one with the cup. As
in PyBullet's direct solver, friction bears what the normal impulses would be without it. Both are
found side by side by sweeps over impulses: all that bear at once, then all that rub, at the steps
that converge fastest for a standing block. Elementwise throughout; sums over contacts have one
order whatever the number of rows.

As in PyBullet, block and cup have their edges rounded for each other: by 1 mm each.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tpm_gym.arrays import FloatArray
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.mount import GRAVITY

__all__ = ["Body", "Lip", "Step", "axes", "least_rise", "tumble"]

RECOVERY = 0.08  # share of a penetration that a time step takes out
SLOP = 1e-5  # m; a penetration that stays
SEEN_BY_LIP = 6e-4  # m; at this distance lip and block keep from going deeper than to touch

ROUNDING = 1e-3  # m; of the edges of cup and block for each other
_BELLOWS = 0.015  # m; length of the part of the cup that touches
_COUNT, _RUB = 15, slice(13, 15)  # contacts' directions; the lip's tangents
_BORNE = np.array([0, 1, 2, 3] * 2 + [4, 4])  # those whose press bears friction, in its order
_SWEEPS = 12
_EASE = 0.6  # of the exact steps along the lip's directions, as corners move with them
_RELAXATION = 1 / 5.5  # of 1/m: between the inverse inertias of heave, 4, and of tilting, 7.1
_RUBBING = 1 / 10  # the same for friction, of 8.9 for slipping and 12 for turning
SLIP = 1e-4  # m/s; what is slower has no direction
LEAST = 0.02  # of friction along an axis, whatever the direction of the slip
_NEVER = -1e3  # m/s
_LITTLE = 1e-12

_SIGNS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]).T


class Body(NamedTuple):
    """Blocks (m,) in motion: components first, world, SI units.

    Attributes:
        position: (3, m).
        velocity: (3, m).
        turn: (4, m) quaternions (x, y, z, w).
        spin: (3, m).
    """

    position: FloatArray
    velocity: FloatArray
    turn: FloatArray
    spin: FloatArray


class Lip(NamedTuple):
    """Cups in a time step.

    Attributes:
        point: (3, m) centre of the lip before it.
        velocity: (3, m) in it, with the spring on its way back.
        normal: (3, m) of the last contact, from lip to block; zero where there was none.
    """

    point: FloatArray
    velocity: FloatArray
    normal: FloatArray


class Step(NamedTuple):
    """What a time step made.

    Attributes:
        body: The blocks after it.
        pushed: (m,) m, how far the cup's spring gave way.
        impulse: (3, m) N s, of the lip on the block.
        normal: (3, m) of the contact with the lip; zero for none.
    """

    body: Body
    pushed: FloatArray
    impulse: FloatArray
    normal: FloatArray


def tumble(
    body: Body,
    lip: Lip,
    level: FloatArray,
    mass: FloatArray,
    rough: FloatArray,
    half: tuple[float, float, float],
    step: float,
) -> Step:
    """Run a time step (s).

    Args:
        body: The blocks.
        lip: The cups.
        level: (m,) m, height of what is below.
        mass: (m,) kg.
        rough: (m,) Coulomb coefficient on what is below.
        half: Half edges of the blocks, m.
        step: s.
    """
    frame = axes(body.turn)
    touch = _touch(body.position, frame, lip, half)
    arms, gap = _corners(body.position[2] - level, frame, half)
    jacobian = _jacobian(arms, touch)
    start = np.concatenate([body.velocity, body.spin])
    start[2] -= GRAVITY * step
    wanted = np.zeros((_COUNT, len(mass)))
    wanted[:4] = least_rise(gap) / step
    wanted[4] = least_rise(touch.gap, SEEN_BY_LIP) / step
    wanted[:5] = np.maximum(wanted[:5], _NEVER)
    wanted[4] += _sum3(touch.normal * lip.velocity)
    wanted[_RUB] = _weighed(jacobian[:3, _RUB], lip.velocity[:, None])
    strength = CUP.preload * step / np.maximum(-touch.normal[2], 1e-3)
    grips = np.empty((_COUNT - 5, len(mass)))
    grips[:8].reshape(2, 4, -1)[:] = (rough * _ways(body, half[2]))[:, None]
    grips[8:] = CUP.friction * rough
    twist, impulses = _solve(
        jacobian, _response(jacobian, frame[2], mass, half), mass, start, wanted, strength, grips
    )
    press = impulses[4]
    force = touch.normal * press + _weighed(jacobian[:3, _RUB].swapaxes(0, 1), impulses[_RUB, None])
    lacks = np.maximum(wanted[4] - _sum6(jacobian[:, 4] * twist), 0.0) * step
    pushed = np.where(press >= strength, lacks / np.maximum(-touch.normal[2], 0.1), 0.0)
    normal = np.where(press > 0, touch.normal, 0.0)
    return Step(_moved(body, twist, step), pushed, force, normal)


def _corners(
    height: FloatArray, frame: FloatArray, half: tuple[float, float, float]
) -> tuple[FloatArray, FloatArray]:
    """The four lowest corners of blocks whose middles are at a height over what is below (m,).

    Returns:
        From the middles to the corners (3, 4, m) m, and their heights (4, m) m.
    """
    arms = _weighed(frame[:, :, None], (_SIGNS * np.array(half)[:, None])[:, None, :, None])
    lowest = np.argsort(arms[2], axis=0, kind="stable")[:4]
    some: FloatArray = arms[:, lowest, np.arange(len(height))]
    return some, height + some[2]


def _jacobian(arms: FloatArray, touch: _Touch) -> FloatArray:
    """What velocity and spin are along all contacts' directions (6, c, m).

    In order: up at the corners; the lip's normal; east and north at the corners; the lip's
    tangents, one level and one steep.
    """
    x, y, z = arms
    jacobian = np.zeros((6, _COUNT, arms.shape[2]))
    jacobian[2, :4] = jacobian[0, 5:9] = jacobian[1, 9:13] = 1.0
    jacobian[3, :4], jacobian[4, :4] = y, -x
    jacobian[4, 5:9], jacobian[5, 5:9] = z, -y
    jacobian[3, 9:13], jacobian[5, 9:13] = -z, x
    a, b, c = jacobian[:3, 4] = touch.normal
    level = np.sqrt(a * a + b * b)
    steep = level > 1e-6
    far = np.where(steep, level, 1.0)
    e, f = np.where(steep, -b / far, 1.0), np.where(steep, a / far, 0.0)
    jacobian[0, 13], jacobian[1, 13] = e, f
    jacobian[0, 14], jacobian[1, 14], jacobian[2, 14] = -c * f, c * e, a * f - b * e
    x, y, z = touch.arm
    for k in (4, 13, 14):
        a, b, c = jacobian[:3, k]
        jacobian[3, k], jacobian[4, k], jacobian[5, k] = y * c - z * b, z * a - x * c, x * b - y * a
    return jacobian


def _response(
    jacobian: FloatArray, axis: FloatArray, mass: FloatArray, half: tuple[float, float, float]
) -> FloatArray:
    """What impulses along the contacts' directions do to velocity and spin (6, c, m)."""
    across = 3 / (mass * (half[0] ** 2 + half[2] ** 2))
    along = 3 / (mass * 2 * half[0] ** 2)
    turn = jacobian[3:]
    about = (along - across) * _weighed(turn, axis[:, None])
    return np.concatenate([jacobian[:3] / mass, across * turn + axis[:, None] * about])


def _solve(
    jacobian: FloatArray,
    response: FloatArray,
    mass: FloatArray,
    start: FloatArray,
    wanted: FloatArray,
    strength: FloatArray,
    grips: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Find impulses (c, m), and velocity and spin (6, m) with them, from those without (start).

    Side by side: without friction, which gives its bounds, and with it.
    """
    coupling = _weighed(jacobian[:, :, None], response[:, None])
    share = np.empty_like(wanted)
    share[:4], share[5:13] = _RELAXATION * mass, _RUBBING * mass
    share[4] = _EASE / coupling[4, 4]
    share[13], share[14] = _EASE / coupling[13, 13], _EASE / coupling[14, 14]
    constant = share * (wanted - _weighed(jacobian, start[:, None]))
    keeps = -share * coupling
    keeps.reshape(_COUNT * _COUNT, -1)[:: _COUNT + 1] += 1.0
    high = np.full((5, 1, len(mass)), np.inf)
    high[4, 0] = strength
    impulses = np.zeros((_COUNT, 2, len(mass)))
    bearing, rubbing = impulses[:5], impulses[5:, 1]
    to_bearing, to_rubbing = keeps[:, :5, None], keeps[:, 5:]
    first, second, every = constant[:5, None], constant[5:], impulses[:, None, 1]
    for _ in range(_SWEEPS):
        after = _weighed(to_bearing, impulses[:, None])
        after += first
        np.minimum(np.maximum(after, 0.0, out=after), high, out=bearing)
        bound = grips * impulses[_BORNE, 0]
        after = _weighed(to_rubbing, every)
        after += second
        np.minimum(np.maximum(after, -bound, out=after), bound, out=rubbing)
    found = impulses[:, 1]
    return start + _weighed(response.swapaxes(0, 1), found[:, None]), found


def _ways(body: Body, down: float) -> FloatArray:
    """Share (2, m) of friction along the world's axes, by the direction in which bottoms slip."""
    x, y = body.velocity[0] - down * body.spin[1], body.velocity[1] + down * body.spin[0]
    fast = np.sqrt(x * x + y * y)
    ways = np.where(fast > SLIP, np.abs(np.stack([x, y])) / np.maximum(fast, SLIP), math.sqrt(0.5))
    return np.maximum(ways, LEAST)


def _moved(body: Body, twist: FloatArray, step: float) -> Body:
    """The blocks a time step (s) on, at velocities and spins (6, m)."""
    x, y, z = 0.5 * step * twist[3:]
    a, b, c, d = body.turn
    turn = body.turn.copy()
    turn[0] += x * d + y * c - z * b
    turn[1] += y * d + z * a - x * c
    turn[2] += z * d + x * b - y * a
    turn[3] -= x * a + y * b + z * c
    squares = turn * turn
    turn /= np.sqrt((squares[0] + squares[1]) + (squares[2] + squares[3]))
    return Body(body.position + step * twist[:3], twist[:3], turn, twist[3:])


class _Touch(NamedTuple):
    """The nearest points of cup and block: gap (m,), normal (3, m), arm on the block (3, m)."""

    gap: FloatArray
    normal: FloatArray
    arm: FloatArray


def _touch(
    position: FloatArray, frame: FloatArray, lip: Lip, half: tuple[float, float, float]
) -> _Touch:
    """Where cup and block are nearest; nowhere for those that are clear of each other."""
    away = position - lip.point
    away[2] -= _BELLOWS / 2
    reach = math.hypot(*half) + math.hypot(CUP.radius, _BELLOWS / 2) + SEEN_BY_LIP
    near = np.flatnonzero(_sum3(away * away) < reach * reach)
    touch = _Touch(np.full_like(away[0], np.inf), np.zeros_like(away), np.zeros_like(away))
    touch.normal[2] = -1.0
    if len(near):
        some = Lip(*(part[:, near] for part in lip))
        found = _nearest(position[:, near], frame[:, :, near], some, half)
        touch.gap[near], touch.normal[:, near], touch.arm[:, near] = found
    return touch


def _nearest(
    position: FloatArray, frame: FloatArray, lip: Lip, half: tuple[float, float, float]
) -> _Touch:
    """Where cup and block are nearest: by projecting from one to the other."""
    core = (np.array(half) - ROUNDING)[:, None]
    bottom = lip.point[2] + ROUNDING
    top = bottom + (_BELLOWS - 2 * ROUNDING)
    there, cup, across = position, np.empty_like(position), frame.swapaxes(0, 1)
    for _ in range(4):
        # onto the cup
        away = there[:2] - lip.point[:2]
        squares = away * away
        far = np.maximum(np.sqrt(squares[0] + squares[1]), _LITTLE)
        cup[:2] = lip.point[:2] + np.minimum((CUP.radius - ROUNDING) / far, 1.0) * away
        np.minimum(np.maximum(there[2], bottom), top, out=cup[2])
        # onto the block
        local = _weighed(across, (cup - position)[:, None])
        inside = np.minimum(np.maximum(local, -core), core)
        there = position + _weighed(frame, inside[:, None])
    apart = there - cup
    distance = np.sqrt(_sum3(apart * apart))
    normal = apart / np.maximum(distance, _LITTLE)
    gap = distance - 2 * ROUNDING
    deep = np.flatnonzero(distance < 1e-7)
    if len(deep):
        gap[deep], normal[:, deep] = _inside(
            position[:, deep], frame[:, :, deep], Lip(*(part[:, deep] for part in lip)), half
        )
    return _Touch(gap, normal, there - ROUNDING * normal - position)


def _inside(
    position: FloatArray, frame: FloatArray, lip: Lip, half: tuple[float, float, float]
) -> tuple[FloatArray, FloatArray]:
    """Gap and normal where the cup is in the block: as in the last contact, or the nearest way."""
    down = np.zeros_like(position)
    down[2] = -1.0
    known = _sum3(lip.normal * lip.normal) > 0.5
    best, normal = _along(np.where(known, lip.normal, down), position, frame, lip, half)
    for axis in (frame[0], frame[1]):
        for sign in (-1.0, 1.0):
            gap, way = _along(sign * axis, position, frame, lip, half)
            better = ~known & (gap > best)
            best, normal = np.where(better, gap, best), np.where(better, way, normal)
    return best, normal


def _along(
    normal: FloatArray,
    position: FloatArray,
    frame: FloatArray,
    lip: Lip,
    half: tuple[float, float, float],
) -> tuple[FloatArray, FloatArray]:
    """How far cup and block are apart along a normal."""
    away = _sum3(normal * (position - lip.point))
    block = _sum3(np.array(half)[:, None] * np.abs(_sum3_last(frame * normal)))
    level = np.sqrt(normal[0] * normal[0] + normal[1] * normal[1])
    return away - block - CUP.radius * level - _BELLOWS * np.maximum(normal[2], 0.0), normal


def least_rise(gap: FloatArray, seen: float = 0.0) -> FloatArray:
    """How far a contact at a distance (m) must open at least in a time step, m.

    A contact is not there before it is as near as ``seen`` (m).
    """
    out = RECOVERY * np.maximum(-gap - SLOP, 0.0)
    return np.where(gap > 0, np.where(gap < seen, -gap, -np.inf), out)


def axes(turn: FloatArray) -> FloatArray:
    """The blocks' own axes (3, 3, m): one after the other, each in the world."""
    x, y, z, w = turn
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    wx, wy, wz = w * x, w * y, w * z
    frame = np.empty((3, *turn[:3].shape))
    frame[0, 0], frame[0, 1], frame[0, 2] = 1 - 2 * (yy + zz), 2 * (xy + wz), 2 * (xz - wy)
    frame[1, 0], frame[1, 1], frame[1, 2] = 2 * (xy - wz), 1 - 2 * (xx + zz), 2 * (yz + wx)
    frame[2, 0], frame[2, 1], frame[2, 2] = 2 * (xz + wy), 2 * (yz - wx), 1 - 2 * (xx + yy)
    return frame


def _sum3(parts: FloatArray) -> FloatArray:
    """Over the first axis, in one order."""
    total: FloatArray = parts[0] + parts[1] + parts[2]
    return total


def _sum3_last(parts: FloatArray) -> FloatArray:
    """Over the second axis of (c, 3, m)."""
    total: FloatArray = parts[:, 0] + parts[:, 1] + parts[:, 2]
    return total


def _weighed(parts: FloatArray, weights: FloatArray) -> FloatArray:
    """Sum of products over the first axis, in one order as long as others are longer than one."""
    total: FloatArray = np.add.reduce(np.multiply(parts, weights, order="C"), axis=0)
    return total


def _sum6(parts: FloatArray) -> FloatArray:
    """Over the first axis of (6, m)."""
    return _sum3(parts[:3] + parts[3:])
