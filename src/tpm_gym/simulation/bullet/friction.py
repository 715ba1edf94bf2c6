"""Coulomb's cone for the direct solver, whose friction is a box with axes of its own.

The solver bounds the friction of a contact along two directions, each by mu N: at 45 degrees to
them it is sqrt(2) too strong, and it does not point against the slip. On a level face the
directions are the world's x and y, and the engine can scale them for each body. Scaled by the
direction in which the contact slips, the box's corner lies on the cone, opposite to the slip;
where it sticks, each bound is what the cone leaves beside the other force of the last time step,
and where there was none the box lies inside the cone.

What is left, measured (``tests/simulation/bullet/test_friction.py``, docs/fidelity.md): a direction
lags a time step; the weaker bound never falls below :data:`_LEAST`; all points of a contact share
the direction of its middle, so that a block which spins is braked too little; and contacts between
objects, or with upright faces, keep the box.
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
_FAST = 1e-2  # m/s; beyond that it slips, whatever the last force was
_SLIP = 1e-5  # m/s; below that the last force has the direction of the next
_LITTLE = 1e-3  # of the cone, squared: below that the next force may have any direction
_STICKS = 0.98  # of the cone, squared: below that it sticks, and what moves is the solver's noise
_SAME = 0.01  # change of a scale that is not worth a call
_UNKNOWN = (math.sqrt(0.5), math.sqrt(0.5))
_BOX = (1.0, 1.0)  # the engine's own


class _Face:
    """A body's level face, on which objects slide, and how its friction is scaled now."""

    def __init__(self, body: int, link: int) -> None:
        self.body, self.link = body, link
        self.scales = _BOX


class Friction:
    """The friction of objects on their tables and below the cup.

    Args:
        client: The physics client.
        robot: With the cup.
        bodies: The objects' numbers in the client.
        tables: That of each one's own table: bodies slide in different directions.
        blocks: What the objects are.
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
        """As if nothing had ever slipped."""
        for face in (self._cup, *(face for _, face, _ in self._bodies)):
            face.scales = _BOX  # so that it is set, whatever it is now
            self._set(face, _UNKNOWN)

    def alter(self, factor: float) -> None:
        """All objects are ``factor`` times as rough as nominal."""
        self._factor = factor

    def look(self, near: Sequence[int], first: int) -> int:
        """Before a control period: from which of its time steps on to :meth:`turn`.

        From the beginning if an object moves, else from ``first``, when the cup comes to one of
        those that are ``near``.
        """
        moving = [index for index in range(len(self._bodies)) if self._moves(index)]
        self._active = sorted({*moving, *near}) if moving else list(near)
        # An object that is alone rests until the cup comes; others may push each other.
        alone = len(self._bodies) == 1
        self._resting = {index for index in near if alone and index not in moving}
        return 0 if moving else first

    def _moves(self, index: int) -> bool:
        """Whether an object slides or falls; one that settles after it fell flat does not."""
        body, table, _ = self._bodies[index]
        (x, y, z), _ = pybullet.getBaseVelocity(body, self._number)
        settles = table.scales is _UNKNOWN and math.hypot(x, y) <= _SLIP and abs(z) < _FAST
        return not settles and math.hypot(x, y, z) > _SLIP

    def turn(self, held: int) -> None:
        """Before a time step: scale the friction of what may slip."""
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
        """Whether an object still stands as it did at the last look, and nothing touches it.

        Then there is nothing to turn; to ask costs a third of what turning does.
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
    """Bounds along the world's axes in units of mu N, for a slip (m/s) and the last time step."""
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
    """Where the cone's edge is in that direction."""
    length = math.hypot(x, y)
    return max(abs(x) / length, _LEAST), max(abs(y) / length, _LEAST)


def _used(points: Sequence[Any], coefficient: float) -> tuple[float, float]:
    """Friction that these contacts bore, along the world's axes, in units of mu N."""
    along_x = along_y = normal = 0.0
    for point in points:
        force, first, (a, b, _), second, (c, d, _) = point[9:]
        along_x += first * a + second * c
        along_y += first * b + second * d
        normal += force
    most = coefficient * normal
    return (along_x / most, along_y / most) if most > 0 else (0.0, 0.0)
