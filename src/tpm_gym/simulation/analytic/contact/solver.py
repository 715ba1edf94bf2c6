"""Contact impulses by projected Gauss-Seidel iterations with Coulomb's friction cone.

Velocities are computed first, then positions. There is no restitution. A time step removes a
fraction of each penetration. The iterations start from the impulses of the last time step.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.compiling import compiled
from tpm_gym.simulation.analytic.contact.state import Record, Records
from tpm_gym.simulation.vectors import cross, dot, plus, put, three

_SWEEPS = 12
_RELAXATION = 1.3  # over-relaxation of normal impulses; the sweeps converge below 2
_STILL, _UNTURNED = 5e-4, 0.01  # m/s, rad/s: objects below both speeds count as still
_TOLERANCE = 3e-4  # m/s; a sweep that changes velocities by less is the last sweep
_RECOVERY = 0.1  # fraction of a penetration that a time step removes
_SLOP = 1e-5  # m, penetration that is not removed
_FASTEST = 0.3  # m/s, largest speed at which a penetration is removed
_LEAST = 1e-4  # 1/kg; limits ease_t of bodies that cannot move sideways
_TRACE = 0.7  # fraction of the trace that determines ease_t; friction converges above 0.5


class Motor(NamedTuple):
    """Spring that drives the cup's slide.

    Attributes:
        speed: Target of the cup's vertical velocity, m/s.
        mass: Mass of body 0, kg: the cup with the held object.
        limit: Largest downward impulse, N s.
    """

    speed: float
    mass: float
    limit: float


@compiled
def _turned(body: Record, moment: Vector) -> Vector:
    """Return the change of angular velocity (rad/s) by an angular impulse (N m s)."""
    axis, across = three(body["axis"]), body["across"]
    about = (body["along"] - across) * dot(axis, moment)
    return (
        across * moment[0] + about * axis[0],
        across * moment[1] + about * axis[1],
        across * moment[2] + about * axis[2],
    )


@compiled
def _reply(body: Record, arm: Vector, impulse: Vector) -> Vector:
    """Return the change of velocity (m/s) at a point of a body by an impulse (N s) there."""
    x, y, z = three(body["lightness"])
    return plus(
        (x * impulse[0], y * impulse[1], z * impulse[2]),
        cross(_turned(body, cross(arm, impulse)), arm),
    )


@compiled
def _trace(body: Record, arm: Vector) -> float:
    """Return the trace of a matrix, 1/kg.

    The matrix maps an impulse at a point of the body to the change of the point's velocity.
    """
    x, y, z = three(body["lightness"])
    turn = cross(arm, three(body["axis"]))
    spread = 2 * body["across"] * dot(arm, arm)
    trace: float = x + y + z + spread + (body["along"] - body["across"]) * dot(turn, turn)
    return trace


@compiled
def _push(body: Record, arm: Vector, impulse: Vector, sign: float) -> None:
    """Apply sign * impulse (N s) to a point of a body."""
    velocity, spin, light = body["velocity"], body["spin"], body["lightness"]
    velocity[0] += sign * light[0] * impulse[0]
    velocity[1] += sign * light[1] * impulse[1]
    velocity[2] += sign * light[2] * impulse[2]
    if body["across"] > 0:  # 0 for the cup, which does not rotate
        turn = _turned(body, cross(arm, impulse))
        spin[0] += sign * turn[0]
        spin[1] += sign * turn[1]
        spin[2] += sign * turn[2]


@compiled
def _speed(body: Record, arm: Vector) -> Vector:
    """Return the velocity of a point of a body, m/s."""
    return plus(three(body["velocity"]), cross(three(body["spin"]), arm))


@compiled
def prepare(
    contacts: Records, count: int, bodies: Records, forces: FloatArray, step: float
) -> None:
    """Compute the constants of all contacts, and apply the impulses of the last time step.

    Args:
        contacts: Contacts, of which the first ``count`` are used; changed.
        count: Number of contacts.
        bodies: Bodies of the contacts; their velocities are changed.
        forces: (slots, 3) N, contact forces of the last time step.
        step: Time step, s.
    """
    for j in range(count):
        contact = contacts[j]
        normal, arm = three(contact["normal"]), three(contact["arm_b"])
        body = bodies[contact["b"]]
        reply, trace = _reply(body, arm, normal), _trace(body, arm)
        if contact["a"] >= 0:
            body, arm = bodies[contact["a"]], three(contact["arm_a"])
            reply, trace = plus(reply, _reply(body, arm, normal)), trace + _trace(body, arm)
        own, gap = dot(normal, reply), contact["gap"]
        put(contact["reply"], reply)
        contact["ease_n"] = _RELAXATION / own
        contact["enough"] = (_TOLERANCE / own) ** 2
        contact["ease_t"] = 1 / max(_TRACE * (trace - own), _LEAST)
        rises = min(_RECOVERY * max(-gap - _SLOP, 0.0) / step, _FASTEST)
        contact["speed"] = -gap / step if gap > 0 else rises
        last = three(forces[contact["slot"]])
        last = last[0] * step, last[1] * step, last[2] * step
        press = max(dot(last, normal), 0.0)
        friction = plus(last, normal, -dot(last, normal))
        friction = _within(friction, contact["friction"] * press)
        impulse = plus(friction, normal, press)
        contact["press"] = press
        put(contact["impulse"], impulse)
        if press > 0:
            _apply(contact, bodies, impulse)


@compiled
def _within(vector: Vector, limit: float) -> Vector:
    """Shorten a vector to the length ``limit`` if it is longer."""
    square = dot(vector, vector)
    if square <= limit * limit:
        return vector
    factor = limit / math.sqrt(square)
    return vector[0] * factor, vector[1] * factor, vector[2] * factor


@compiled
def _apply(contact: Record, bodies: Records, impulse: Vector) -> None:
    """Apply an impulse to both bodies of a contact."""
    _push(bodies[contact["b"]], three(contact["arm_b"]), impulse, 1.0)
    if contact["a"] >= 0:
        _push(bodies[contact["a"]], three(contact["arm_a"]), impulse, -1.0)


@compiled
def _relax(contact: Record, bodies: Records) -> bool:
    """Update the impulse of one contact; return False if the change is negligible."""
    speed = _speed(bodies[contact["b"]], three(contact["arm_b"]))
    if contact["a"] >= 0:
        own = _speed(bodies[contact["a"]], three(contact["arm_a"]))
        speed = plus(speed, own, -1.0)
    normal, before = three(contact["normal"]), contact["press"]
    lacks = contact["speed"] - dot(normal, speed)
    press = max(before + lacks * contact["ease_n"], 0.0)
    if press == 0 and before == 0:
        return False
    contact["press"] = press
    speed = plus(speed, three(contact["reply"]), press - before)
    slip = plus(speed, normal, -dot(normal, speed))
    old = three(contact["impulse"])
    friction = plus(plus(old, normal, -before), slip, -contact["ease_t"])
    new = plus(_within(friction, contact["friction"] * press), normal, press)
    change = plus(new, old, -1.0)
    put(contact["impulse"], new)
    _apply(contact, bodies, change)
    off: bool = dot(change, change) > contact["enough"]
    return off


@compiled
def solve(contacts: Records, count: int, bodies: Records, motor: Motor, calm: bool) -> None:
    """Compute the contact impulses and the spring's impulse, and apply them to the bodies.

    Args:
        contacts: Contacts after :func:`prepare`, of which the first ``count`` are used; changed.
        count: Number of contacts.
        bodies: Bodies of the contacts; their velocities are changed.
        motor: Spring that drives body 0, the cup.
        calm: Whether to end the iterations as soon as objects and belt are :func:`still`, because
            the contact impulses then balance the other forces on the objects.
    """
    spring, cup = 0.0, bodies[0]["velocity"]
    for sweep in range(_SWEEPS):
        off = False
        wanted = spring + (motor.speed - cup[2]) * motor.mass
        wanted = max(wanted, -motor.limit)  # the cup's stop causes upward impulses of any size
        cup[2] += (wanted - spring) / motor.mass
        spring = wanted
        for j in range(count):
            off |= _relax(contacts[j], bodies)
        if not off or (calm and sweep > 0 and still(bodies)):
            return


@compiled
def still(bodies: Records) -> bool:
    """Return whether objects and belt are slower than ``_STILL`` and ``_UNTURNED`` (rad/s)."""
    for index in range(1, len(bodies)):
        velocity, spin = three(bodies[index]["velocity"]), three(bodies[index]["spin"])
        if dot(velocity, velocity) > _STILL**2 or dot(spin, spin) > _UNTURNED**2:
            return False
    return True
