"""Coulomb's friction cone for Bullet's direct solver, which has a friction box.

**Level faces.** The solver limits the friction force of a contact to mu * N (coefficient times
normal force) along each of two directions. If an object slips at 45 degrees to these directions,
friction is sqrt(2) times too strong. At other oblique angles, friction is also not opposite to the
slip. On a level face the directions are the world's x and y, and Bullet can scale both limits for
each body. For a slipping contact, this module scales both limits so that a corner of the box lies
on the cone, opposite to the slip. For a sticking contact, the module assumes that the friction
along y stays as in the last time step. The limit along x is then the largest friction along x that
lies in the cone. The limit along y is computed likewise from the friction along x. If the total
friction in the last time step was zero or very small, its next direction is unknown. Then the
module chooses a box inside the cone.

**Slides.** All points of a contact share these scales, and contacts between objects have no scales.
So this module adds the friction that was missing in the last time step, as a force and a torque.
The missing friction is mu * N against the slip of each point, minus the solver's friction.

**Upright faces.** The solver takes N from a solution without friction. But when the lip pushes a
block, the block presses on the lip only because friction at the table brakes the block. In a
solution without friction, N is 0 at the lip, so the solver allows no friction there. So this module
computes the missing friction from N in the last time step, and adds it as a force.

Some errors remain (measured in ``tests/simulation/test_friction.py``). The scales and the added
forces lag by one time step, since they are computed from the last one. The smaller scale never
falls below :data:`_LEAST`. A level contact between two objects has the friction box while it
sticks, and in the first time step of a slide.
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
_NOTHING = 1e-6  # N, N m; smaller ones are rounding, and would only disturb the solver
_Push = tuple[Vector, float]
"""Record of the friction force that was added to a contact in a time step: a vector and a limit, N.

The vector is the steady part of the added force: the part that holds a block that sticks (see
``compiled.friction_force``). The limit is the largest allowed magnitude of the added force: mu * N
minus the solver's friction.
"""
_ZERO: Vector = (0.0, 0.0, 0.0)
_NONE: _Push = (_ZERO, 0.0)
_Slip = tuple[float, float, float, float]
"""Slip velocity (x, y, z) of a contact point, and its magnitude, m/s."""
_Wrench = tuple[float, float, float, float, float, float]
"""Force (x, y, z) N, and torque (x, y, z) N m about an object's centre."""
_Lacks = dict[tuple[int, int], _Wrench]
"""For each pair of sliding bodies, the friction that the solver left out in a time step."""


class _Face:
    """Level face on which objects slide, and the scales of its friction along x and y.

    The face moves along x at ``speed``, m/s.
    """

    def __init__(self, body: int, link: int) -> None:
        self.body, self.link = body, link
        self.scales, self.speed = _BOX, 0.0


class _Motion(NamedTuple):
    """Place (m), velocity (m/s) and angular velocity (rad/s) of a link of a body.

    ``free`` tells whether forces can move the link: True for objects and the cup, False for tables
    and belts.
    """

    body: int
    link: int
    place: Vector
    velocity: Vector
    turning: Vector
    free: bool

    def at(self, point: Vector) -> Vector:
        """Compute the velocity of a point of the body, m/s."""
        if self.turning is _ZERO:
            return self.velocity
        (x, y, z), (u, v, w), (p, q, r), (a, b, c) = self.place, self.velocity, self.turning, point
        x, y, z = a - x, b - y, c - z
        return u + q * z - r * y, v + r * x - p * z, w + p * y - q * x


class Friction:
    """Friction of objects on their tables and under the cup.

    Args:
        bodies: Body ids of the objects.
        tables: Body ids of the tables, one per object: objects slide in different directions, and
            Bullet's friction scales apply to a whole table.
        belts: Body ids of the belts, one per object; empty without a belt.
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
        self._pushes: dict[tuple[int, int], _Push] = {}  # of the last time step
        self._pushed: dict[tuple[int, int], _Push] = {}  # of the one before
        self._lacks: _Lacks = {}  # of the last time step
        self._lacked: _Lacks = {}  # of the one before
        self._active: list[int] = []
        self._held = -1  # body id of the held object
        self._resting: set[int] = set()
        self._scale = partial(pybullet.changeDynamics, physicsClientId=number)

    def reset(self) -> None:
        """Set the friction scales of each face to the values for a force of unknown direction."""
        self._pushes, self._lacks = {}, {}
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
            first: First time step in which the cup can touch an object. This is the result if no
                object moves and the belt, if there is one, is at rest.
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
        if not moving:
            self._pushes, self._lacks = {}, {}
        # A single object rests until the cup touches it. Several objects may push each other.
        alone = len(self._bodies) == 1
        self._resting = set(near).difference(moving) if alone else set()
        return 0 if moving else first

    def scale(self, held: int) -> None:
        """Scale the friction of objects that may slip; call before each time step."""
        self._held = self._bodies[held][0] if held >= 0 else -1
        self._pushed, self._pushes = self._pushes, {}
        self._lacked, self._lacks = self._lacks, {}
        for index in self._active:
            body, table, _ = self._bodies[index]
            if index != held and self._rests(index):
                u, v, _ = self._lip().velocity
                if math.hypot(u, v) > _FAST:  # a strike may make the object slip in any direction
                    self._set(table, _UNKNOWN)
                    self._set(self._cup, _BOX)
            elif points := pybullet.getContactPoints(body, -1, -2, -2, self._number):  # with all
                self._scale_at(index, points, index == held)

    def _scale_at(self, index: int, points: Sequence[Any], held: bool) -> None:
        """Scale an object's friction at its contacts, and add friction that the solver left out."""
        (body, table, block), cup = self._bodies[index], self._cup
        rough, motion = self._factor * block.friction, self._motion(body)
        if below := [point for point in points if point[2] == table.body]:
            self._slide(motion, _surface(table), below, rough, table)
        if self._belts:
            belt = self._belts[index]
            if on_belt := [point for point in points if point[2] == belt.body]:
                self._slide(motion, _surface(belt), on_belt, rough, belt)
        if lip := [point for point in points if point[2] == cup.body and point[4] == cup.link]:
            if _beside(lip):
                self._set(cup, _BOX)
                self._resist(motion, self._lip(), lip, rough * CUP.friction)
            elif not held:
                self._slide(motion, self._lip(), lip, rough * CUP.friction, cup)
        for other, (their, _, their_block) in enumerate(self._bodies):
            between = [point for point in points if point[2] == their]
            if between and (other > index or other not in self._active):  # once for both
                coefficient = rough * self._factor * their_block.friction
                add = self._resist if _beside(between) else self._slide
                add(motion, self._motion(their), between, coefficient)

    def _motion(self, body: int) -> _Motion:
        place, _ = pybullet.getBasePositionAndOrientation(body, self._number)
        velocity, turning = pybullet.getBaseVelocity(body, self._number)
        return _Motion(body, -1, place, velocity, turning, free=True)

    def _lip(self) -> _Motion:
        body, link = self._cup.body, self._cup.link
        state = pybullet.getLinkState(body, link, 1, 0, self._number)
        return _Motion(body, link, state[0], state[6], _ZERO, free=True)  # it does not turn

    def _slide(
        self,
        motion: _Motion,
        other: _Motion,
        points: Sequence[Any],
        coefficient: float,
        face: _Face | None = None,
    ) -> None:
        """Scale the friction of a face, and add the friction that the last time step left out.

        Friction that is missing in one time step is not always missing in the next: an impact lasts
        one time step, and a slip can reverse. So the missing friction of the last two time steps is
        compared, and the smaller value is added.

        Args:
            motion: Motion of the object.
            other: Motion of the body that the object touches.
            points: PyBullet's contact points.
            coefficient: Coulomb's coefficient.
            face: Face of the other body; None if the other body is an object.
        """
        slips = [_slip(motion, other, point) for point in points]
        if face is not None:
            self._set(face, _scales(slips, points, coefficient))
        pair = motion.body, other.body
        # Forces on a held object are not determined, since all is rigid: N has no meaning there.
        if self._held in pair or max(slip[3] for slip in slips) <= _FAST:
            return
        lack = _lack(motion, slips, points, coefficient)
        self._lacks[pair] = lack
        if pair in self._lacked:
            x, y, z, p, q, r = map(_smaller, self._lacked[pair], lack)
            if max(map(abs, (x, y, z, p, q, r))) > _NOTHING:
                self._push(motion, other, motion.place, (x, y, z), (p, q, r))

    def _push(
        self, motion: _Motion, other: _Motion, at: Vector, force: Vector, torque: Vector = _ZERO
    ) -> None:
        """Apply a force (N) at a point (m) and a torque (N m); ``other`` gets the reactions."""
        number, frame = self._number, pybullet.WORLD_FRAME
        for pushed, sign in ((motion, 1.0), (other, -1.0)):
            if pushed.free:
                x, y, z = force
                push, (p, q, r) = (sign * x, sign * y, sign * z), torque
                pybullet.applyExternalForce(pushed.body, pushed.link, push, at, frame, number)
                if torque is not _ZERO:
                    turn = sign * p, sign * q, sign * r
                    pybullet.applyExternalTorque(pushed.body, pushed.link, turn, frame, number)

    def _resist(
        self, motion: _Motion, other: _Motion, points: Sequence[Any], coefficient: float
    ) -> None:
        """Apply the friction that the solver leaves out where an object's side is pushed.

        All contact points at upright faces are treated as one contact, at the point with the
        largest force. An impact lasts only one time step. So the friction is limited to the smaller
        one of the limits of the last two time steps.

        Args:
            motion: Motion of the object.
            other: Motion of the lip or object that pushes it.
            points: PyBullet's contact points.
            coefficient: Coulomb's coefficient of the contact.
        """
        points = _beside(points)
        point = max(points, key=lambda point: point[9])
        normal = sum(point[9] for point in points)
        solved = sum(math.hypot(point[10], point[12]) for point in points)
        most = coefficient * normal - solved
        pair, moving = (motion.body, other.body), (*motion[3:5], other.at(point[5]))
        before, limit = self._pushed.get(pair, _NONE)
        mass, _, moments, *_ = pybullet.getDynamicsInfo(motion.body, -1, self._number)
        if other.link < 0:  # an object gives way
            theirs = pybullet.getDynamicsInfo(other.body, -1, self._number)[0]
            share = theirs / (mass + theirs)
            mass, moments = share * mass, tuple(share * moment for moment in moments)
        force, after = self._friction_force(
            point[5], point[7], motion.place, moving, before, min(limit, most), mass, moments,
            self._step,
        )  # fmt: skip
        self._push(motion, other, point[5], force)
        self._pushes[pair] = after, most

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


def _beside(points: Sequence[Any]) -> list[Any]:
    """Return the contact points at upright faces."""
    return [point for point in points if abs(point[7][2]) < _LEVEL]


def _surface(face: _Face) -> _Motion:
    return _Motion(face.body, face.link, _ZERO, (face.speed, 0.0, 0.0), _ZERO, free=False)


def _slip(motion: _Motion, other: _Motion, point: Any) -> _Slip:
    (u, v, w), (p, q, r), (a, b, c) = motion.at(point[5]), other.at(point[5]), point[7]
    u, v, w = u - p, v - q, w - r
    along = u * a + v * b + w * c
    u, v, w = u - along * a, v - along * b, w - along * c
    return u, v, w, math.sqrt(u * u + v * v + w * w)


def _lack(
    motion: _Motion, slips: Sequence[_Slip], points: Sequence[Any], coefficient: float
) -> _Wrench:
    """Compute Coulomb's friction (N, N m) of the points that slip, minus the solver's friction.

    Args:
        motion: Motion of the object.
        slips: Slip of each point.
        points: PyBullet's contact points, with the forces of the last time step.
        coefficient: Coulomb's coefficient.
    """
    solved = [_solved(point) for point in points]
    # PyBullet returns the friction on either body. It opposes the slip.
    power = sum(
        f * u + g * v + h * w for (f, g, h), (u, v, w, _) in zip(solved, slips, strict=True)
    )
    sign = -1.0 if power > 0 else 1.0
    fx = fy = fz = tx = ty = tz = 0.0
    for own, (u, v, w, speed), point in zip(solved, slips, points, strict=True):
        if speed > _FAST:
            (a, b, c), (i, j, k), share = motion.place, point[5], coefficient * point[9] / speed
            x, y, z = (
                -share * u - sign * own[0],
                -share * v - sign * own[1],
                -share * w - sign * own[2],
            )
            fx, fy, fz = fx + x, fy + y, fz + z
            tx += (j - b) * z - (k - c) * y
            ty += (k - c) * x - (i - a) * z
            tz += (i - a) * y - (j - b) * x
    return fx, fy, fz, tx, ty, tz


def _solved(point: Any) -> Vector:
    """Return the solver's friction at a point, N."""
    first, (a, b, c), second, (d, e, f) = point[10:]
    return first * a + second * d, first * b + second * e, first * c + second * f


def _smaller(one: float, other: float) -> float:
    """Return the number that is nearer to zero; zero if the signs differ."""
    return math.copysign(min(abs(one), abs(other)), one) if one * other > 0 else 0.0


def _scales(
    slips: Sequence[_Slip], points: Sequence[Any], coefficient: float
) -> tuple[float, float]:
    """Return the friction limits along x and y (world), divided by mu times the normal force.

    Points of a spinning object slip in different directions, but share the scales.

    Args:
        slips: Slip of each point.
        points: PyBullet's contact points.
        coefficient: Coulomb's coefficient.
    """
    along_x = along_y = speed = total = 0.0
    for (x, y, _, fast), point in zip(slips, points, strict=True):
        weight = max(point[9], 1e-9)
        scale_x, scale_y = _along(x, y)
        along_x, along_y = along_x + weight * scale_x, along_y + weight * scale_y
        speed, total = speed + weight * fast, total + weight
    mean = along_x / total, along_y / total
    if speed > _FAST * total:
        return mean
    a, b = _used(points, coefficient)
    if a * a + b * b < _LITTLE:
        return _UNKNOWN
    if a * a + b * b < _STICKS:
        return math.sqrt(1 - b * b), math.sqrt(1 - a * a)
    return mean if speed > _SLIP * total else _along(a, b)


def _along(x: float, y: float) -> tuple[float, float]:
    """Return scales of the friction box whose corner in direction (x, y) is on the cone."""
    length = max(math.hypot(x, y), 1e-12)
    return max(abs(x) / length, _LEAST), max(abs(y) / length, _LEAST)


def _used(points: Sequence[Any], coefficient: float) -> tuple[float, float]:
    """Return the total friction along x and y (world), divided by mu times the normal force."""
    along_x, along_y, _ = map(sum, zip(*map(_solved, points), strict=True))
    most = coefficient * sum(point[9] for point in points)
    return (along_x / most, along_y / most) if most > 0 else (0.0, 0.0)
