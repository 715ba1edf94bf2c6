"""Coulomb's friction cone for Bullet's direct solver, which has a friction box.

The solver bounds the friction of a contact by mu N along each of two directions. At 45 degrees to
them the friction is sqrt(2) times too strong, and it does not oppose the slip. On a level face the
directions are the world's x and y, and Bullet can scale the bounds for each body. This module
scales them by the direction of the slip, so that the corner of the box lies on the cone, opposite
to the slip. Where a contact sticks, each bound is what the cone leaves beside the other force of
the last time step. Where there was no force, the box lies inside the cone.

Remaining errors, measured in ``tests/simulation/bullet/test_friction.py``: a direction lags by one
time step. The weaker bound never falls below :data:`_LEAST`. All points of a contact share the
direction of its middle, so that a spinning block is braked too little. Contacts between objects,
or with upright faces, keep the box.
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

__all__ = ["Friction"]

_LEAST = 0.02  # of the scales, so that no row of the solver vanishes
_FAST = 1e-2  # m/s; a faster contact slips, whatever the last force was
_SLIP = 1e-5  # m/s; of a slower contact the next force has the last one's direction
_LITTLE = 1e-3  # of the cone, squared; after a smaller force the next may have any direction
_STICKS = 0.98  # of the cone, squared; with a smaller force it sticks, and motion is noise
_SAME = 0.01  # smaller changes of a scale are not worth a call
_UNKNOWN = (math.sqrt(0.5), math.sqrt(0.5))
_BOX = (1.0, 1.0)  # the engine's own


class _Face:
    """Level face of a body, on which objects slide, and the scales of its friction."""

    def __init__(self, body: int, link: int) -> None:
        self.body, self.link = body, link
        self.scales = _BOX


class Friction:
    """The friction of objects on their tables and below the cup.

    Args:
        client: The physics client.
        robot: Robot with the cup.
        bodies: Numbers of the objects in the client.
        tables: Number of each object's own table: objects slide in different directions.
        blocks: The objects.
    """

    def __init__(
        self,
        client: Client,
        robot: Robot,
        bodies: Sequence[int],
        tables: Sequence[int],
        blocks: Sequence[Block],
    ) -> None:
        """Start with nothing scaled."""
        faces = [_Face(table, -1) for table in tables[: len(bodies)]]  # one, without objects
        self._bodies = list(zip(bodies, faces, blocks, strict=True))
        self._cup = _Face(*robot.tool)
        number = client.number
        self._number, self._factor = number, 1.0
        self._active: list[int] = []
        self._resting: set[int] = set()
        self._scale = partial(pybullet.changeDynamics, physicsClientId=number)

    def reset(self) -> None:
        """Start as if nothing had slipped."""
        for face in (self._cup, *(face for _, face, _ in self._bodies)):
            face.scales = _BOX  # so that it is set, whatever it is now
            self._set(face, _UNKNOWN)

    def alter(self, factor: float) -> None:
        """Make all objects ``factor`` times as rough as nominal."""
        self._factor = factor

    def look(self, near: Sequence[int], first: int) -> int:
        """Return the first time step of the next control period that needs :meth:`turn`.

        It is 0 if an object moves, else ``first``, when the cup can touch one of the ``near`` ones.
        """
        moving = []
        for index, (body, table, _) in enumerate(self._bodies):
            (x, y, z), _ = pybullet.getBaseVelocity(body, self._number)
            # Settling after a flat fall does not count.
            settles = table.scales is _UNKNOWN and math.hypot(x, y) <= _SLIP and abs(z) < _FAST
            if not settles and math.hypot(x, y, z) > _SLIP:
                moving.append(index)
        self._active = sorted({*moving, *near}) if moving else list(near)
        # A single object rests until the cup comes; several may push each other.
        alone = len(self._bodies) == 1
        self._resting = set(near).difference(moving) if alone else set()
        return 0 if moving else first

    def turn(self, held: int) -> None:
        """Scale the friction of objects that may slip, before a time step."""
        number, cup = self._number, self._cup
        for index in self._active:
            body, table, block = self._bodies[index]
            if index != held and self._rests(index):
                continue
            points = pybullet.getContactPoints(body, -1, -2, -2, number)  # with anything
            if not points:
                continue
            below = [point for point in points if point[2] == table.body]
            above = [point for point in points if point[2] == cup.body and point[4] == cup.link]
            (x, y, _), (p, q, _) = pybullet.getBaseVelocity(body, number)
            half, rough = block.height / 2, self._factor * block.friction
            if below:
                self._set(table, _scales(x - half * q, y + half * p, below, rough))
            if above and index != held:
                state = pybullet.getLinkState(cup.body, cup.link, 1, 0, number)
                u, v, _ = state[6]
                self._set(
                    cup, _scales(x + half * q - u, y - half * p - v, above, rough * CUP.friction)
                )

    def _rests(self, index: int) -> bool:
        """Return whether an object has not moved since the last look, and nothing touches it.

        Then nothing has to be turned. Asking costs a third of turning.
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
        if scales is face.scales:  # unknown as before
            return
        (a, b), (c, d) = scales, face.scales
        if abs(a - c) > _SAME or abs(b - d) > _SAME or scales is _UNKNOWN:
            face.scales = scales
            self._scale(face.body, face.link, anisotropicFriction=(a, b, 1.0))


def _scales(x: float, y: float, points: Sequence[Any], coefficient: float) -> tuple[float, float]:
    """Return bounds along the world's axes in units of mu N, for a slip (m/s)."""
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
    """Return the point of the cone's edge in a direction."""
    length = math.hypot(x, y)
    return max(abs(x) / length, _LEAST), max(abs(y) / length, _LEAST)


def _used(points: Sequence[Any], coefficient: float) -> tuple[float, float]:
    """Return the friction of some contacts, along the world's axes, in units of mu N."""
    along_x = along_y = normal = 0.0
    for point in points:
        force, first, (a, b, _), second, (c, d, _) = point[9:]
        along_x += first * a + second * c
        along_y += first * b + second * d
        normal += force
    most = coefficient * normal
    return (along_x / most, along_y / most) if most > 0 else (0.0, 0.0)
