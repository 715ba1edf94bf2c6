"""A free block between table and cup, in any posture: rigid bodies in batches.

Contacts are those of the block's eight corners with the level below, and one with the cup. A time
step finds their impulses by sweeps over them: all corners' normals at once (Jacobi, at the step
that converges fastest for a standing block), friction where the corners' pressure has its centre,
then the cup. Elementwise throughout; sums over corners have one order whatever the number of rows.

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
_SWEEPS = 20
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
        normals: (m,) N s, of the level below.
    """

    body: Body
    pushed: FloatArray
    impulse: FloatArray
    normal: FloatArray
    normals: FloatArray


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
    # 1/I: of a square block, along its own axis and across
    across = 3 / (mass * (half[0] ** 2 + half[2] ** 2))
    along = 3 / (mass * 2 * half[0] ** 2)
    mobility = (along - across) * frame[2][:, None] * frame[2]
    for i in range(3):
        mobility[i, i] += across

    velocity, spin = body.velocity.copy(), body.spin.copy()
    velocity[2] -= GRAVITY * step
    gap = body.position[2] + corners[2] - level
    least = np.maximum(least_rise(gap) / step, _NEVER)
    arms = np.stack([np.ones_like(gap), corners[1], -corners[0]])
    touch = _touch(body.position, frame, lip, half)
    touching = np.flatnonzero(touch.gap < SEEN_BY_LIP)
    contact = _Contact(touch, lip, mass, rough, mobility, touching, step) if len(touching) else None

    # Without friction: what it will be able to bear
    freely, freely_turning, normals = velocity.copy(), spin.copy(), np.zeros_like(gap)
    for _ in range(_SWEEPS):
        normals = _carry(freely, freely_turning, normals, arms, least, mass, mobility)
        if contact is not None:
            contact.press(freely, freely_turning)
    if contact is not None:
        contact.rest()
    low = velocity[:2] + half[2] * np.stack([-spin[1], spin[0]])
    fast = np.sqrt(low[0] * low[0] + low[1] * low[1])
    ways = np.where(fast > SLIP, np.abs(low) / np.maximum(fast, SLIP), math.sqrt(0.5))
    bounds = rough * normals * np.maximum(ways, LEAST)[:, None]
    drag = np.zeros_like(bounds)
    share = mass * _RUBBING
    for _ in range(_SWEEPS):
        normals = (
            _carry(velocity, spin, normals, arms, least, mass, mobility)
            if _
            else _carry(velocity, spin, np.zeros_like(gap), arms, least, mass, mobility)
        )
        slip = velocity[:2, None] + np.stack(
            [
                spin[1] * corners[2] - spin[2] * corners[1],
                spin[2] * corners[0] - spin[0] * corners[2],
            ]
        )
        after = np.minimum(np.maximum(drag - share * slip, -bounds), bounds)
        x, y = after - drag
        drag = after
        about = np.stack([-corners[2] * y, corners[2] * x, corners[0] * y - corners[1] * x])
        velocity[:2] += _sum8(np.stack([x, y])) / mass
        spin += _turned(mobility, *_sum8(about))
        if contact is not None:
            contact.push(velocity, spin)
    return _finish(body, velocity, spin, contact, _sum8(normals), step)


def _carry(
    velocity: FloatArray,
    spin: FloatArray,
    normals: FloatArray,
    arms: FloatArray,
    least: FloatArray,
    mass: FloatArray,
    mobility: FloatArray,
) -> FloatArray:
    """Let the level below push up where corners sink; its impulses (8, m)."""
    speed = velocity[2] + arms[1] * spin[0] + arms[2] * spin[1]
    after: FloatArray = np.maximum(normals + mass * _RELAXATION * (least - speed), 0.0)
    lift, roll, pitch = _sum8(arms * (after - normals))
    velocity[2] += lift / mass
    spin += mobility[0] * roll + mobility[1] * pitch
    return after


def _finish(body, velocity, spin, contact, total, step) -> Step:
    x, y, z = 0.5 * step * spin
    a, b, c, d = body.turn
    turn = body.turn + np.stack(
        [
            x * d + y * c - z * b,
            y * d + z * a - x * c,
            z * d + x * b - y * a,
            -x * a - y * b - z * c,
        ]
    )
    turn /= np.sqrt(
        (turn[0] * turn[0] + turn[1] * turn[1]) + (turn[2] * turn[2] + turn[3] * turn[3])
    )
    after = Body(body.position + step * velocity, velocity, turn, spin)
    none, nothing = np.zeros_like(body.position), np.zeros_like(total)
    if contact is None:
        return Step(after, nothing, none, none.copy(), total)
    pushed, impulse, normal = nothing, none, none.copy()
    rows = contact.rows
    pushed[rows] = contact.given_way(velocity, spin) * step
    impulse[:, rows] = contact.impulse
    normal[:, rows] = contact.normal
    return Step(after, pushed, impulse, normal, total)


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


class _Contact:
    """Between lip and block, for the rows in which they touch."""

    def __init__(self, touch, lip, mass, rough, mobility, rows, step) -> None:
        self.rows, self._step = rows, step
        self.normal, self._arm = touch.normal[:, rows], touch.arm[:, rows]
        self._mass, self._mobility = mass[rows], mobility[:, :, rows]
        self._lip = lip.velocity[:, rows]
        self._least = np.maximum(least_rise(touch.gap[rows], SEEN_BY_LIP) / step, _NEVER)
        self._rough = CUP.friction * rough[rows]
        lever = cross(self._arm, self.normal)
        self._inertia = 1 / (1 / self._mass + _sum3(lever * _turned(self._mobility, *lever)))
        arm2 = _sum3(self._arm * self._arm)
        self._across = 1 / (1 / self._mass + arm2 * self._mobility[2, 2])
        self._strength = CUP.preload * step / np.maximum(-self.normal[2], 1e-3)
        self._press, self.impulse = np.zeros(len(rows)), np.zeros((3, len(rows)))
        self._rub, self._limit = np.zeros((3, len(rows))), np.zeros(len(rows))

    def press(self, velocity: FloatArray, spin: FloatArray) -> None:
        """Let the lip push along the normal."""
        rows = self.rows
        own = velocity[:, rows] + cross(spin[:, rows], self._arm) - self._lip
        press = self._press + self._inertia * (self._least - _sum3(own * self.normal))
        press = np.minimum(np.maximum(press, 0.0), self._strength)
        self._give(velocity, spin, (press - self._press) * self.normal)
        self._press = press

    def rest(self) -> None:
        """Begin anew, with a friction that bears what the push so far lets it."""
        self._limit = self._rough * self._press
        self._press, self.impulse = np.zeros_like(self._press), np.zeros_like(self.impulse)

    def push(self, velocity: FloatArray, spin: FloatArray) -> None:
        """Let the lip push and rub."""
        self.press(velocity, spin)
        rows, normal = self.rows, self.normal
        own = velocity[:, rows] + cross(spin[:, rows], self._arm) - self._lip
        slip = own - _sum3(own * normal) * normal
        rub = self._rub - self._across * slip
        length = np.sqrt(_sum3(rub * rub))
        rub *= np.minimum(self._limit / np.maximum(length, _LITTLE), 1.0)
        self._give(velocity, spin, rub - self._rub)
        self._rub = rub

    def _give(self, velocity: FloatArray, spin: FloatArray, change: FloatArray) -> None:
        velocity[:, self.rows] += change / self._mass
        spin[:, self.rows] += _turned(self._mobility, *cross(self._arm, change))
        self.impulse = self.impulse + change

    def given_way(self, velocity: FloatArray, spin: FloatArray) -> FloatArray:
        """Speed at which the spring gives way where it is at its strength, m/s."""
        own = velocity[:, self.rows] + cross(spin[:, self.rows], self._arm) - self._lip
        lacks = np.maximum(self._least - _sum3(own * self.normal), 0.0)
        return np.where(self._press < self._strength, 0.0, lacks / np.maximum(-self.normal[2], 0.1))


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


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """A x b, components first."""
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def _turned(mobility: FloatArray, x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
    """The change of spin by an angular impulse."""
    change: FloatArray = mobility[0] * x + mobility[1] * y + mobility[2] * z
    return change


def _sum3(parts: FloatArray) -> FloatArray:
    """Over the first axis, in one order."""
    total: FloatArray = parts[0] + parts[1] + parts[2]
    return total


def _sum3_last(parts: FloatArray) -> FloatArray:
    """Over the second axis of (3, 3, m)."""
    total: FloatArray = parts[:, 0] + parts[:, 1] + parts[:, 2]
    return total


def _sum8(parts: FloatArray) -> FloatArray:
    """Over the last axis but one, of 8 corners, in one order."""
    four = parts[..., :4, :] + parts[..., 4:, :]
    two = four[..., :2, :] + four[..., 2:, :]
    total: FloatArray = two[..., 0, :] + two[..., 1, :]
    return total
