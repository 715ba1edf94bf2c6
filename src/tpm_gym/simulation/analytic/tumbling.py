"""A free block between table and cup, in any posture: rigid bodies in batches.

Contacts are those of the block's eight corners with the level below, and one with the cup. As in
PyBullet's direct solver, friction bears what the normal impulses would be without it: they are
found first, then all again with such bounds. Each time by sweeps: all corners at once (Jacobi, at
the steps that converge fastest for a standing block), then the cup. Elementwise throughout; sums
over corners have one order whatever the number of rows.

As in PyBullet, block and cup have their edges rounded for each other: by 1 mm each.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

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
_SWEEPS = 6
_RELAXATION = 1 / 5.5  # of 1/m: between the inverse inertias of heave, 4, and of tilting, 7.1
_RUBBING = 1 / 10  # the same for friction, of 8.9 for slipping and 12 for turning
SLIP = 1e-4  # m/s; what is slower has no direction
LEAST = 0.02  # of friction along an axis, whatever the direction of the slip
_NEVER = -1e3  # m/s
_LITTLE = 1e-12

_EAST, _NORTH, _UP = np.eye(3)
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
    corners = _sum3(frame[:, :, None] * (_SIGNS * np.array(half)[:, None])[:, None, :, None])
    masses = _Masses.of(frame[2], mass, half)
    gap = body.position[2] + corners[2] - level
    flat, zero = np.zeros_like(gap), np.zeros_like(mass)
    below = _Rows(masses, _jacobian(_UP, corners), _RELAXATION * mass)
    sides = np.concatenate([_jacobian(_EAST, corners), _jacobian(_NORTH, corners)])
    drag = _Rows(masses, sides, _RUBBING * mass)
    touch = _touch(body.position, frame, lip, half)
    lips = _lip_rows(masses, touch) if (touch.gap < SEEN_BY_LIP).any() else None

    start = np.concatenate([body.velocity, body.spin])
    start[2] -= GRAVITY * step
    least = np.maximum(least_rise(gap) / step, _NEVER)
    push = np.maximum(least_rise(touch.gap, SEEN_BY_LIP) / step, _NEVER)
    push = push + _sum3(touch.normal * lip.velocity)
    strength = CUP.preload * step / np.maximum(-touch.normal[2], 1e-3)

    # Without friction: what it will be able to bear
    twist, normals, press = start.copy(), flat, zero[None]
    for _ in range(_SWEEPS):
        normals = below.solve(twist, normals, least, flat, np.inf)
        if lips is not None:
            press = lips[0].solve(twist, press, push[None], zero, strength)
    bounds = rough * normals * _ways(body, half[2])[:, None]
    bounds = np.concatenate([bounds[0], bounds[1]])
    limit = CUP.friction * rough * press
    twist, normals, press = start, flat, zero[None]
    rub, dragged = np.zeros((2, len(mass))), np.zeros_like(bounds)
    for _ in range(_SWEEPS):
        normals = below.solve(twist, normals, least, flat, np.inf)
        dragged = drag.solve(twist, dragged, 0.0, -bounds, bounds)
        if lips is not None:
            press = lips[0].solve(twist, press, push[None], zero, strength)
            rub = lips[1].solve(twist, rub, lips[1].along(lip.velocity), -limit, limit)
    impulse = touch.normal * press[0]
    if lips is None:
        return Step(_moved(body, twist, step), zero, impulse, impulse)
    impulse = impulse + lips[1].force(rub)
    lacks = np.maximum(push - lips[0].speed(twist)[0], 0.0) * step
    weak = press[0] >= strength
    pushed = np.where(weak, lacks / np.maximum(-touch.normal[2], 0.1), 0.0)
    normal = np.where(press[0] > 0, touch.normal, 0.0)
    return Step(_moved(body, twist, step), pushed, impulse, normal)


class _Masses(NamedTuple):
    """Inverses of mass (m,) and of the inertia, (3, 3, m)."""

    lightness: FloatArray
    mobility: FloatArray

    @classmethod
    def of(cls, axis: FloatArray, mass: FloatArray, half: tuple[float, float, float]) -> _Masses:
        """Of square blocks with this axis (3, m)."""
        across = 3 / (mass * (half[0] ** 2 + half[2] ** 2))
        along = 3 / (mass * 2 * half[0] ** 2)
        mobility = (along - across) * axis[:, None] * axis
        for i in range(3):
            mobility[i, i] += across
        return cls(1 / mass, mobility)


class _Rows:
    """Some constraints (c,) on the velocities and spins (6, m) of all blocks, solved at once.

    Args:
        masses: Of the blocks.
        jacobian: (c, 6, m).
        share: (m,) kg, impulse for a speed that is missing; None for the exact one of one row.
    """

    def __init__(self, masses: _Masses, jacobian: FloatArray, share: FloatArray | None) -> None:
        """Find what impulses do."""
        self._jacobian = jacobian
        spin = (
            masses.mobility[0] * jacobian[:, 3, None]
            + masses.mobility[1] * jacobian[:, 4, None]
            + masses.mobility[2] * jacobian[:, 5, None]
        )
        self._response = np.concatenate([masses.lightness * jacobian[:, :3], spin], axis=1)
        self._share = 1 / _sum6(jacobian * self._response) if share is None else share

    def speed(self, twist: FloatArray) -> FloatArray:
        """(c, m) m/s."""
        return _sum6(self._jacobian * twist)

    def along(self, velocity: FloatArray) -> FloatArray:
        """(c, m) m/s of something that does not turn, along the constraints."""
        return _sum3_last(self._jacobian[:, :3] * velocity)

    def force(self, impulses: FloatArray) -> FloatArray:
        """(3, m) N s of two constraints' impulses."""
        first, second = self._jacobian[:, :3] * impulses[:, None]
        force: FloatArray = first + second
        return force

    def solve(
        self, twist: FloatArray, impulses: FloatArray, least: Any, low: Any, high: Any
    ) -> FloatArray:
        """Change impulses (c, m) so that speeds come to ``least``, and ``twist`` by them."""
        after: FloatArray = impulses + self._share * (least - self.speed(twist))
        after = np.minimum(np.maximum(after, low), high)
        twist += _over_rows(self._response * (after - impulses)[:, None])
        return after


def _jacobian(direction: FloatArray, arms: FloatArray) -> FloatArray:
    """(c, 6, m) of points at arms (3, c, m), along a direction (3,) or (3, m)."""
    x, y, z = (np.broadcast_to(part, arms.shape[1:]) for part in direction)
    turn = (arms[1] * z - arms[2] * y, arms[2] * x - arms[0] * z, arms[0] * y - arms[1] * x)
    return np.stack([x, y, z, *turn], axis=1)


def _lip_rows(masses: _Masses, touch: _Touch) -> tuple[_Rows, _Rows]:
    """The contact with the lip: along its normal, and along a level and a steep tangent."""
    x, y, z = touch.normal
    level = np.sqrt(x * x + y * y)
    steep = level > 1e-6
    far = np.where(steep, level, 1.0)
    first = np.stack([np.where(steep, -y / far, 1.0), np.where(steep, x / far, 0.0), 0 * x])
    second = np.stack([-z * first[1], z * first[0], x * first[1] - y * first[0]])
    arm = touch.arm[:, None]
    one = _jacobian(touch.normal, arm)
    two = np.concatenate([_jacobian(first, arm), _jacobian(second, arm)])
    return _Rows(masses, one, None), _Rows(masses, two, None)


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
    rate = np.stack(
        [
            x * d + y * c - z * b,
            y * d + z * a - x * c,
            z * d + x * b - y * a,
            -x * a - y * b - z * c,
        ]
    )
    turn = body.turn + rate
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
    """Where cup and block are nearest: by projecting from one to the other."""
    core = (np.array(half) - ROUNDING)[:, None]
    bottom = lip.point[2] + ROUNDING
    top = bottom + (_BELLOWS - 2 * ROUNDING)
    there = position
    for _ in range(4):
        # onto the cup
        away = there[:2] - lip.point[:2]
        far = np.sqrt(away[0] * away[0] + away[1] * away[1])
        shrink = np.minimum((CUP.radius - ROUNDING) / np.maximum(far, _LITTLE), 1.0)
        cup = np.concatenate(
            [lip.point[:2] + shrink * away, np.minimum(np.maximum(there[2], bottom), top)[None]]
        )
        # onto the block
        local = _sum3_last(frame * (cup - position))
        inside = np.minimum(np.maximum(local, -core), core)
        there = position + _sum3(frame * inside[:, None])
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
    return np.stack(
        [
            np.stack([1 - 2 * (yy + zz), 2 * (xy + wz), 2 * (xz - wy)]),
            np.stack([2 * (xy - wz), 1 - 2 * (xx + zz), 2 * (yz + wx)]),
            np.stack([2 * (xz + wy), 2 * (yz - wx), 1 - 2 * (xx + yy)]),
        ]
    )


def _sum3(parts: FloatArray) -> FloatArray:
    """Over the first axis, in one order."""
    total: FloatArray = parts[0] + parts[1] + parts[2]
    return total


def _sum3_last(parts: FloatArray) -> FloatArray:
    """Over the second axis of (c, 3, m)."""
    total: FloatArray = parts[:, 0] + parts[:, 1] + parts[:, 2]
    return total


def _sum6(parts: FloatArray) -> FloatArray:
    """Over the second axis of (c, 6, m)."""
    three = parts[:, :3] + parts[:, 3:]
    total: FloatArray = three[:, 0] + three[:, 1] + three[:, 2]
    return total


def _over_rows(parts: FloatArray) -> FloatArray:
    """Over the first axis, of 1, 2, 4, 8 or 16, in one order."""
    while len(parts) > 1:
        middle = len(parts) // 2
        parts = parts[:middle] + parts[middle:]
    total: FloatArray = parts[0]
    return total
