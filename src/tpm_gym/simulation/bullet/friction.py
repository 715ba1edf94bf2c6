"""Coulomb's friction cone for Bullet's direct solver, which has a friction box.

**Level faces.** The solver limits the friction force of a contact to mu N along each of two
directions. At 45 degrees to these directions, friction is sqrt(2) times too strong, and it does not
oppose the slip. On a level face the directions are the world's x and y, and Bullet can scale both
limits for each body. For a slipping contact, this module scales them so that a corner of the box
lies on the cone, opposite to the slip. For a sticking contact, the limit along x follows from the
cone and the last force along y, and vice versa. Without a last force, the box lies inside the cone.
An object at rest that the lip comes near is expected to slip along the lip's way.

**Upright faces.** The solver takes N from a solution without friction. But a block that the lip
pushes leans on the lip only because the table brakes it. Without friction N is 0, and the lip would
be as slippery as ice. So this module adds the missing friction as a force, from the last N.

Remaining errors, measured in ``tests/simulation/test_friction.py``: direction and added forces lag
by one time step. The smaller scale never falls below :data:`_LEAST`. All points of a contact share
the mean of their scales. So friction brakes too little the spin of a block, and the sideways motion
of a block that spins and slides. Contacts between objects keep the box, and upright ones have no
friction in a steady push.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import pybullet

from tpm_gym.arrays import Vector
from tpm_gym.mechanism.cup import CUP
from tpm_gym.simulation.bullet.client import Client
from tpm_gym.simulation.bullet.robot import Robot
from tpm_gym.simulation.engine import loops
from tpm_gym.simulation.state import Block

_LEAST = 0.02  # smallest scale; with 0, a row of the solver would vanish
_FAST = 1e-2  # m/s; a faster contact slips, whatever the last force was
_SLIP = 1e-5  # m/s; in a slower contact, the next force is assumed along the last force
_LITTLE = 1e-3  # (force / cone limit)^2; after a smaller force, the next may have any direction
_STICKS = 0.98  # (force / cone limit)^2; with a smaller force the contact sticks
_SAME = 0.003  # a smaller change of a scale is ignored, to save a call
_LEVEL = 0.7  # z of the normal; faces with less are upright
_UNKNOWN = (math.sqrt(0.5), math.sqrt(0.5))  # scales for an unknown direction of the force
_BOX = (1.0, 1.0)  # Bullet's default scales
_Push = tuple[Vector, float]
"""Sum of the forces that were added to a contact, and its largest friction at last, N."""
_NONE: _Push = ((0.0, 0.0, 0.0), 0.0)


class _Face:
    """Level face on which objects slide, and the scales of its friction along x and y.

    Its surface moves along x at ``speed``, m/s.
    """

    def __init__(self, body: int, link: int) -> None:
        self.body, self.link = body, link
        self.scales, self.speed = _BOX, 0.0


class _Motion(NamedTuple):
    """Place (m), velocity (m/s) and angular velocity (rad/s) of an object."""

    place: Vector
    velocity: Vector
    turning: Vector

    @classmethod
    def of(cls, body: int, number: int) -> _Motion:
        """Read the motion of a body."""
        place, _ = pybullet.getBasePositionAndOrientation(body, number)
        return cls(place, *pybullet.getBaseVelocity(body, number))

    def slip(
        self, other: tuple[float, float], points: Sequence[Any]
    ) -> tuple[tuple[float, float], float]:
        """Return the scales for the slip of contact points, and its mean speed in m/s.

        Points of a spinning object slip in different directions, but share the scales.
        """
        (x, y, z), (u, v, _), (p, q, r) = self
        along_x = along_y = speed = total = 0.0
        for point in points:
            (a, b, c), weight = point[5], max(point[9], 1e-9)
            slip_x = u - other[0] + q * (c - z) - r * (b - y)
            slip_y = v - other[1] + r * (a - x) - p * (c - z)
            scale_x, scale_y = _along(slip_x, slip_y)
            along_x, along_y = along_x + weight * scale_x, along_y + weight * scale_y
            speed, total = speed + weight * math.hypot(slip_x, slip_y), total + weight
        return (along_x / total, along_y / total), speed / total


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
        time_step: Time step, s.
    """

    def __init__(
        self,
        client: Client,
        robot: Robot,
        bodies: Sequence[int],
        tables: Sequence[int],
        belts: Sequence[int],
        blocks: Sequence[Block],
        time_step: float,
    ) -> None:
        """Create the faces of tables, belts and cup, with Bullet's default friction."""
        # Without objects, there still is one table.
        faces = [_Face(table, -1) for table in tables[: len(bodies)]]
        self._bodies = list(zip(bodies, faces, blocks, strict=True))
        self._belts = [_Face(belt, -1) for belt in belts[: len(bodies)]]
        self._cup = _Face(*robot.tool)
        number = client.number
        self._number, self._factor = number, 1.0
        self._step = time_step
        self._friction_force = loops().friction_force
        self._pushes: list[_Push] = []
        self._active: list[int] = []
        self._resting: set[int] = set()
        self._scale = partial(pybullet.changeDynamics, physicsClientId=number)

    def reset(self) -> None:
        """Set the scales of all faces to an unknown direction of the force."""
        self._pushes = [_NONE] * len(self._bodies)
        for face in (self._cup, *self._belts, *(face for _, face, _ in self._bodies)):
            face.scales = _BOX  # differs from _UNKNOWN, so that _set() sends the scales to Bullet
            self._set(face, _UNKNOWN)

    def set_belt(self, speed: float) -> None:
        """Store the speed of the belts along x, m/s."""
        for belt in self._belts:
            belt.speed = speed

    def alter(self, factor: float) -> None:
        """Set the factor by which the objects' friction differs from nominal."""
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
            push, self._pushes[index] = self._pushes[index], _NONE
            if index != held and self._rests(index):
                u, v, _ = self._lip_velocity()
                if math.hypot(u, v) > _FAST:  # a strike would make the object slip along (u, v)
                    self._set(table, _along(u, v))
                    self._set(cup, _BOX)
                continue
            points = pybullet.getContactPoints(body, -1, -2, -2, number)  # with all other bodies
            if not points:
                continue
            below = [point for point in points if point[2] == table.body]
            lip = [point for point in points if point[2] == cup.body and point[4] == cup.link]
            beside = [point for point in lip if abs(point[7][2]) < _LEVEL]
            rough, motion = self._factor * block.friction, _Motion.of(body, number)
            if below:
                self._set(table, _scales(motion, (0.0, 0.0), below, rough))
            if self._belts:
                belt = self._belts[index]
                if on_belt := [point for point in points if point[2] == belt.body]:
                    self._set(belt, _scales(motion, (belt.speed, 0.0), on_belt, rough))
            if beside:
                self._set(cup, _BOX)
                coefficient = rough * CUP.friction
                self._pushes[index] = self._resist(body, motion, beside, push, coefficient)
            elif lip and index != held:
                u, v, _ = self._lip_velocity()
                self._set(cup, _scales(motion, (u, v), lip, rough * CUP.friction))

    def _lip_velocity(self) -> Vector:
        state = pybullet.getLinkState(self._cup.body, self._cup.link, 1, 0, self._number)
        return state[6]  # type: ignore[no-any-return]  # PyBullet has no types

    def _resist(
        self, body: int, motion: _Motion, points: Sequence[Any], last: _Push, coefficient: float
    ) -> _Push:
        """Apply the friction that the solver leaves out where the lip pushes a side of an object.

        The points count as one contact at the point with the largest force. A blow lasts one time
        step, and pushes no more in the next. So the smaller force of two time steps counts.

        Args:
            body: Body id of the object.
            motion: Motion of the object.
            points: PyBullet's contact points.
            last: The last push.
            coefficient: Coulomb's coefficient of the contact.
        """
        number, cup, point = self._number, self._cup, max(points, key=lambda point: point[9])
        normal = sum(point[9] for point in points)
        solved = sum(math.hypot(point[10], point[12]) for point in points)
        mass, _, moments, *_ = pybullet.getDynamicsInfo(body, -1, number)
        most = coefficient * normal - solved
        contact, moving = (point[5], point[7], motion.place), (*motion[1:], self._lip_velocity())
        before, limit = last[0], min(last[1], most)
        force, after = self._friction_force(
            *contact, moving, before, limit, mass, moments, self._step
        )
        x, y, z = force
        for pushed, push in (((body, -1), force), ((cup.body, cup.link), (-x, -y, -z))):
            pybullet.applyExternalForce(*pushed, push, point[5], pybullet.WORLD_FRAME, number)
        return after, most

    def _rests(self, index: int) -> bool:
        """Return whether an object has not moved since :meth:`prepare`, and the cup is not on it.

        This check takes a third of the time of scaling.
        """
        if index not in self._resting:
            return False
        body, *_ = self._bodies[index]
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


def _scales(
    motion: _Motion, other: tuple[float, float], points: Sequence[Any], coefficient: float
) -> tuple[float, float]:
    """Return the friction limits along x and y (world) in units of mu N.

    Args:
        motion: Motion of the object.
        other: Velocity of the other body along x and y, m/s.
        points: PyBullet's contact points.
        coefficient: Coulomb's coefficient.
    """
    (x, y), speed = motion.slip(other, points)
    if speed > _FAST:
        return x, y
    a, b = _used(points, coefficient)
    if a * a + b * b < _LITTLE:
        return _UNKNOWN
    if a * a + b * b < _STICKS:
        return math.sqrt(1 - b * b), math.sqrt(1 - a * a)
    return (x, y) if speed > _SLIP else _along(a, b)


def _along(x: float, y: float) -> tuple[float, float]:
    """Return the scales whose corner of the box lies on the cone along (x, y)."""
    length = max(math.hypot(x, y), 1e-12)
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
