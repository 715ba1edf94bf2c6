"""Coulomb's friction cone for Bullet's direct solver, which has a friction box.

The solver limits the friction force of a contact to mu N along each of two directions. At 45
degrees to these directions, friction is sqrt(2) times too strong, and it does not oppose the slip.
On a level face the directions are the world's x and y, and Bullet can scale both limits for each
body. For a slipping contact, this module scales them so that a corner of the box lies on the cone,
opposite to the slip. For a sticking contact, the limit along x follows from the cone and the last
force along y, and vice versa. Without a last force, the box lies inside the cone.

Remaining errors, measured in ``tests/simulation/test_friction.py``: the direction lags by
one time step. The smaller scale never falls below :data:`_LEAST`. All points of a contact share
the slip direction of its middle, so that friction brakes a spinning block too little. Contacts
between objects and contacts with upright faces keep the box.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import pybullet

from tpm_gym.mechanism.cup import CUP
from tpm_gym.simulation.bullet.client import Client
from tpm_gym.simulation.bullet.robot import Robot
from tpm_gym.simulation.state import Block

_LEAST = 0.02  # smallest scale; with 0, a row of the solver would vanish
_FAST = 1e-2  # m/s; a faster contact slips, whatever the last force was
_SLIP = 1e-5  # m/s; in a slower contact, the next force is assumed along the last force
_LITTLE = 1e-3  # (force / cone limit)^2; after a smaller force, the next may have any direction
_STICKS = 0.98  # (force / cone limit)^2; with a smaller force the contact sticks
_SAME = 0.01  # a smaller change of a scale is ignored, to save a call
_UNKNOWN = (math.sqrt(0.5), math.sqrt(0.5))  # scales for an unknown direction of the force
_BOX = (1.0, 1.0)  # Bullet's default scales


class _Face:
    """Level face on which objects slide, and the scales of its friction along x and y.

    Its surface moves along x at ``speed``, m/s.
    """

    def __init__(self, body: int, link: int) -> None:
        self.body, self.link = body, link
        self.scales, self.speed = _BOX, 0.0


class Friction:
    """Friction of objects on their tables and under the cup.

    Args:
        client: Physics client.
        robot: Robot with the cup.
        bodies: Body ids of the objects.
        tables: Body ids of the tables, one per object, because objects slide in different
            directions.
        belts: Body ids of the belts, one per object; empty without a belt.
        blocks: Objects of the scene.
    """

    def __init__(
        self,
        client: Client,
        robot: Robot,
        bodies: Sequence[int],
        tables: Sequence[int],
        belts: Sequence[int],
        blocks: Sequence[Block],
    ) -> None:
        """Create the faces of tables, belts and cup, with Bullet's default friction."""
        # Without objects, there still is one table.
        faces = [_Face(table, -1) for table in tables[: len(bodies)]]
        self._bodies = list(zip(bodies, faces, blocks, strict=True))
        self._belts = [_Face(belt, -1) for belt in belts[: len(bodies)]]
        self._cup = _Face(*robot.tool)
        number = client.number
        self._number, self._factor = number, 1.0
        self._active: list[int] = []
        self._resting: set[int] = set()
        self._scale = partial(pybullet.changeDynamics, physicsClientId=number)

    def reset(self) -> None:
        """Set the scales of all faces to an unknown direction of the force."""
        for face in (self._cup, *self._belts, *(face for _, face, _ in self._bodies)):
            face.scales = _BOX  # differs from _UNKNOWN, so that _set() sends the scales to Bullet
            self._set(face, _UNKNOWN)

    def set_belt(self, speed: float) -> None:
        """Store the speed of the belts along x, m/s."""
        for belt in self._belts:
            belt.speed = speed

    def alter(self, factor: float) -> None:
        """Store the factor of the objects' nominal friction coefficients."""
        self._factor = factor

    def prepare(self, near: Sequence[int], first: int) -> int:
        """Return the first time step of the next control period that needs :meth:`scale`.

        Args:
            near: Indices of the objects that the cup can touch in the control period.
            first: First time step in which the cup can touch an object; returned if none moves.
        """
        if self._belts and self._belts[0].speed:  # an object at rest on the belt slips
            self._active, self._resting = list(range(len(self._bodies))), set()
            return 0
        moving = []
        for index, (body, table, _) in enumerate(self._bodies):
            (x, y, z), _ = pybullet.getBaseVelocity(body, self._number)
            # Vertical settling of an object that lies flat is not a motion.
            settles = table.scales is _UNKNOWN and math.hypot(x, y) <= _SLIP and abs(z) < _FAST
            if not settles and math.hypot(x, y, z) > _SLIP:
                moving.append(index)
        self._active = sorted({*moving, *near}) if moving else list(near)
        # A single object rests until the cup touches it. Several objects may push each other.
        alone = len(self._bodies) == 1
        self._resting = set(near).difference(moving) if alone else set()
        return 0 if moving else first

    def scale(self, held: int) -> None:
        """Scale the friction of objects that may slip; call before each time step."""
        number, cup = self._number, self._cup
        for index in self._active:
            body, table, block = self._bodies[index]
            if index != held and self._rests(index):
                continue
            points = pybullet.getContactPoints(body, -1, -2, -2, number)  # with all other bodies
            if not points:
                continue
            below = [point for point in points if point[2] == table.body]
            above = [point for point in points if point[2] == cup.body and point[4] == cup.link]
            (x, y, _), (p, q, _) = pybullet.getBaseVelocity(body, number)
            half, rough = block.height / 2, self._factor * block.friction
            if below:
                self._set(table, _scales(x - half * q, y + half * p, below, rough))
            if self._belts:
                belt = self._belts[index]
                if on_belt := [point for point in points if point[2] == belt.body]:
                    slip = x - half * q - belt.speed, y + half * p
                    self._set(belt, _scales(*slip, on_belt, rough))
            if above and index != held:
                state = pybullet.getLinkState(cup.body, cup.link, 1, 0, number)
                u, v, _ = state[6]
                self._set(
                    cup, _scales(x + half * q - u, y - half * p - v, above, rough * CUP.friction)
                )

    def _rests(self, index: int) -> bool:
        """Return whether an object has not moved since :meth:`prepare`, and the cup is not on it.

        The friction of such an object needs no scaling. This check takes a third of the time.
        """
        body, table, _ = self._bodies[index]
        if index not in self._resting or table.scales is not _UNKNOWN:
            return False
        (x, y, _), _ = pybullet.getBaseVelocity(body, self._number)
        lip = self._cup.body, -1, self._cup.link, self._number
        if math.hypot(x, y) > _SLIP or pybullet.getContactPoints(body, *lip):
            self._resting.discard(index)
            return False
        return True

    def _set(self, face: _Face, scales: tuple[float, float]) -> None:
        if scales is face.scales:  # _UNKNOWN, as before
            return
        (a, b), (c, d) = scales, face.scales
        if abs(a - c) > _SAME or abs(b - d) > _SAME or scales is _UNKNOWN:
            face.scales = scales
            self._scale(face.body, face.link, anisotropicFriction=(a, b, 1.0))


def _scales(x: float, y: float, points: Sequence[Any], coefficient: float) -> tuple[float, float]:
    """Return the friction limits along x and y (world) in units of mu N, for a slip (x, y) m/s."""
    speed = math.hypot(x, y)
    if speed > _FAST:
        return _along(x, y)
    a, b = _used(points, coefficient)
    if a * a + b * b < _LITTLE:
        return _UNKNOWN
    if a * a + b * b < _STICKS:
        return math.sqrt(1 - b * b), math.sqrt(1 - a * a)
    return _along(x, y) if speed > _SLIP else _along(a, b)


def _along(x: float, y: float) -> tuple[float, float]:
    """Return the scales whose corner of the box lies on the cone along (x, y)."""
    length = math.hypot(x, y)
    return max(abs(x) / length, _LEAST), max(abs(y) / length, _LEAST)


def _used(points: Sequence[Any], coefficient: float) -> tuple[float, float]:
    """Return the sum of friction forces along the world's x and y, in units of mu N."""
    along_x = along_y = normal = 0.0
    for point in points:
        force, first, (a, b, _), second, (c, d, _) = point[9:]
        along_x += first * a + second * c
        along_y += first * b + second * d
        normal += force
    most = coefficient * normal
    return (along_x / most, along_y / most) if most > 0 else (0.0, 0.0)
