"""Impulses at contacts: projected Gauss-Seidel with Coulomb's cone.

Velocities change first, positions after them. There is no restitution. A penetration is taken out
by a share of its depth. Impulses start from those of the last time step.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.compiling import compiled
from tpm_gym.simulation.analytic.contact.state import Record, Records
from tpm_gym.simulation.vectors import cross, dot, plus, put, three

__all__ = ["Motor", "prepare", "solve", "still"]

_SWEEPS = 12
_HASTE = 1.3  # factor of each step of a normal impulse; below 2 sweeps converge
_STILL, _UNTURNED = 5e-4, 0.01  # m/s, rad/s: slower objects at rest stay there
_TOLERANCE = 3e-4  # m/s; a sweep that changes less is the last one
_RECOVERY = 0.1  # share of a penetration that is taken out
_SLOP = 1e-5  # m, a penetration that stays
_FASTEST = 0.3  # m/s, of what is taken out
_LEAST = 1e-4  # 1/kg; bounds the steps of friction on what cannot yield
_TRACE = 0.7  # share of the trace that bounds the step of friction; above 0.5 it converges


class Motor(NamedTuple):
    """The spring that drives the cup's slide.

    Attributes:
        speed: Vertical velocity of the cup that it aims at, m/s.
        mass: Of the cup and what it holds, kg.
        limit: Largest impulse downwards, N s.
    """

    speed: float
    mass: float
    limit: float


@compiled
def _turned(body: Record, moment: Vector) -> Vector:
    """Return the change of spin by an angular impulse."""
    axis, across = three(body["axis"]), body["across"]
    about = (body["along"] - across) * dot(axis, moment)
    return (
        across * moment[0] + about * axis[0],
        across * moment[1] + about * axis[1],
        across * moment[2] + about * axis[2],
    )


@compiled
def _reply(body: Record, arm: Vector, impulse: Vector) -> Vector:
    """Return the change of velocity at a point of a body by an impulse there."""
    x, y, z = three(body["lightness"])
    return plus(
        (x * impulse[0], y * impulse[1], z * impulse[2]),
        cross(_turned(body, cross(arm, impulse)), arm),
    )


@compiled
def _trace(body: Record, arm: Vector) -> float:
    """Return the sum of the replies to unit impulses along three perpendicular directions."""
    x, y, z = three(body["lightness"])
    turn = cross(arm, three(body["axis"]))
    spread = 2 * body["across"] * dot(arm, arm)
    trace: float = x + y + z + spread + (body["along"] - body["across"]) * dot(turn, turn)
    return trace


@compiled
def _push(body: Record, arm: Vector, impulse: Vector, sign: float) -> None:
    """Apply an impulse to a body."""
    velocity, spin, light = body["velocity"], body["spin"], body["lightness"]
    velocity[0] += sign * light[0] * impulse[0]
    velocity[1] += sign * light[1] * impulse[1]
    velocity[2] += sign * light[2] * impulse[2]
    if body["across"] > 0:  # the cup does not turn
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
    """Compute what stays the same over the sweeps and apply the forces of the last time step.

    Args:
        contacts: The first ``count`` are used.
        count: Number of contacts.
        bodies: The bodies that they join.
        forces: (slots, 3) N, of the last time step.
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
        contact["ease_n"] = _HASTE / own
        contact["enough"] = (_TOLERANCE / own) ** 2
        contact["ease_t"] = 1 / max(_TRACE * (trace - own), _LEAST)
        rises = min(_RECOVERY * max(-gap - _SLOP, 0.0) / step, _FASTEST)
        contact["speed"] = -gap / step if gap > 0 else rises
        last = three(forces[contact["slot"]])
        last = last[0] * step, last[1] * step, last[2] * step
        press = max(dot(last, normal), 0.0)
        rub = plus(last, normal, -dot(last, normal))
        rub = _within(rub, contact["friction"] * press)
        impulse = plus(rub, normal, press)
        contact["press"] = press
        put(contact["impulse"], impulse)
        if press > 0:
            _apply(contact, bodies, impulse)


@compiled
def _within(vector: Vector, limit: float) -> Vector:
    """Shorten a vector to a length."""
    square = dot(vector, vector)
    if square <= limit * limit:
        return vector
    share = limit / math.sqrt(square)
    return vector[0] * share, vector[1] * share, vector[2] * share


@compiled
def _apply(contact: Record, bodies: Records, impulse: Vector) -> None:
    """Apply an impulse to both bodies of a contact."""
    _push(bodies[contact["b"]], three(contact["arm_b"]), impulse, 1.0)
    if contact["a"] >= 0:
        _push(bodies[contact["a"]], three(contact["arm_a"]), impulse, -1.0)


@compiled
def _relax(contact: Record, bodies: Records) -> bool:
    """Solve one contact with all others as they are; return whether it was off by much."""
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
    rub = plus(plus(old, normal, -before), slip, -contact["ease_t"])
    new = plus(_within(rub, contact["friction"] * press), normal, press)
    change = plus(new, old, -1.0)
    put(contact["impulse"], new)
    _apply(contact, bodies, change)
    off: bool = dot(change, change) > contact["enough"]
    return off


@compiled
def solve(contacts: Records, count: int, bodies: Records, motor: Motor, calm: bool) -> None:
    """Find impulses at which no contact closes, no friction exceeds its cone, and the spring acts.

    Args:
        contacts: The first ``count`` are used, as :func:`prepare` left them.
        count: Number of contacts.
        bodies: Their velocities are changed.
        motor: The spring of body 0.
        calm: Whether to end as soon as all objects are :func:`still`: impulses that balance all
            forces have been found then.
    """
    spring, cup = 0.0, bodies[0]["velocity"]
    for sweep in range(_SWEEPS):
        off = False
        wanted = spring + (motor.speed - cup[2]) * motor.mass
        wanted = max(wanted, -motor.limit)  # upwards the cup is on its stop
        cup[2] += (wanted - spring) / motor.mass
        spring = wanted
        for j in range(count):
            off |= _relax(contacts[j], bodies)
        if not off or (calm and sweep > 0 and still(bodies)):
            return


@compiled
def still(bodies: Records) -> bool:
    """Return whether no object moves."""
    for index in range(1, len(bodies)):
        velocity, spin = three(bodies[index]["velocity"]), three(bodies[index]["spin"])
        if dot(velocity, velocity) > _STILL**2 or dot(spin, spin) > _UNTURNED**2:
            return False
    return True
