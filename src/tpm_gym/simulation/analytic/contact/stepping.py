"""A time step of one table: contacts, impulses, motion, and the vacuum after it.

Time steps in which something may touch are computed in parts of a millisecond, so that the result
hardly depends on the time step. A table at rest that the lip does not come near costs one
comparison in a control period.
"""

from __future__ import annotations

import math

from tpm_gym.arrays import BoolArray, FloatArray, IntArray, Vector
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.mount import GRAVITY
from tpm_gym.simulation.analytic.compiling import SOURCES, compiled, kept
from tpm_gym.simulation.analytic.contact.collision import collide_lip, collide_objects
from tpm_gym.simulation.analytic.contact.grasp import CUP_MASS, Way, breathe, lip_of, seal_load
from tpm_gym.simulation.analytic.contact.solver import Motor, prepare, solve, still
from tpm_gym.simulation.analytic.contact.state import AT_REST, Record, Records, Setting, Work
from tpm_gym.simulation.analytic.contact.vectors import (
    axes,
    cross,
    dot,
    length,
    plus,
    put,
    three,
)
from tpm_gym.simulation.engine import SPRING_GAIN
from tpm_gym.simulation.stage import TABLE

__all__ = ["advance"]

_SLOW, _LAZY = 5e-3, 0.3  # m/s, rad/s: slower objects may come to rest
_NEARBY = 5e-4  # m
_SETTLED = 1e-6  # m; the cup is back when it is nearer
_STOPPED = 1e-3  # m/s
_NEAR = 0.005  # m
_ZERO: Vector = (0.0, 0.0, 0.0)


@kept
def advance(
    states: tuple[Records, Records, FloatArray],
    rows: IntArray,
    path: FloatArray,
    on: BoolArray,
    setting: Setting,
    work: Work,
    force: FloatArray,
    sources: str = SOURCES,
) -> None:
    """Run K time steps of some tables.

    Args:
        states: Objects (n, k), cups (n,) and impulses (n, slots, 3); changed.
        rows: (r,) which tables.
        path: (r, K + 2, 3) m, world, point P.
        on: (r,) whether the vacuum is on.
        setting: Constants.
        work: Workspace.
        force: (r, K, 3) N, world, on the platform; written where it is not zero.
        sources: Key of the compiled function on disk.
    """
    for i in range(len(rows)):
        row, points = rows[i], path[i]
        objects, cup, memory = states[0][row], states[1][row], states[2][row]
        if _rests(objects, cup) and cup["vacuum"] == 0 and not _reached(objects, points, setting):
            continue
        for k in range(len(points) - 2):
            way = Way(three(points[k]), three(points[k + 1]), three(points[k + 2]))
            put(force[i, k], _step(objects, cup, memory, way, on[i], setting, work))


@compiled
def _rests(objects: Records, cup: Record) -> bool:
    """Return whether nothing moves but the cup as a whole."""
    return cup["held"] < 0 and cup["slide"] == 0 and _at_rest(objects)


@compiled
def _at_rest(objects: Records) -> bool:
    """Return whether all objects are at rest."""
    for index in range(len(objects)):
        if objects[index]["rest"] < AT_REST:
            return False
    return True


@compiled
def _slow(objects: Records) -> bool:
    """Return whether all objects move so slowly that they may come to rest."""
    for index in range(len(objects)):
        velocity, spin = three(objects[index]["velocity"]), three(objects[index]["spin"])
        if dot(velocity, velocity) > _SLOW**2 or dot(spin, spin) > _LAZY**2:
            return False
    return True


@compiled
def _reached(objects: Records, points: FloatArray, setting: Setting) -> bool:
    """Return whether the lip may come to touch an object, by boxes around both."""
    low, lowest, highest = math.inf, (math.inf, math.inf), (-math.inf, -math.inf)
    for k in range(1, len(points)):
        x, y, z = three(points[k])
        low = min(low, z)
        lowest = min(lowest[0], x), min(lowest[1], y)
        highest = max(highest[0], x), max(highest[1], y)
    for index in range(len(objects)):
        x, y, z = three(objects[index]["position"])
        turn, half = objects[index]["quaternion"], setting.half[index]
        size = length(three(half))
        top = z + _NEAR + (half[2] if turn[0] == 0 and turn[1] == 0 else size)
        near = size + CUP.radius + _NEAR
        over = lowest[0] < x + near and highest[0] > x - near and low - CUP.length < top
        if over and lowest[1] < y + near and highest[1] > y - near:
            return True
    return False


@compiled
def _step(
    objects: Records,
    cup: Record,
    memory: FloatArray,
    way: Way,
    on: bool,
    setting: Setting,
    work: Work,
) -> Vector:
    """Run a time step of a table; return the force on the platform, N."""
    held, step, contacts, rate = cup["held"], setting.step, work.contacts, cup["slide_rate"]
    start = three(objects[held]["position"]) if held >= 0 else _ZERO
    parts, calm = setting.parts, held < 0 and _slow(objects)
    if calm:
        # Mostly everything stays where it is; if not, the time step is computed again in parts
        count, first = _collide(objects, cup, way.now, way.then, setting, work)
        if first == 0 and cup["slide"] == 0 and _at_rest(objects):
            if cup["vacuum"] > 0 or on:
                breathe(objects, cup, way, on, _ZERO, setting)
            return _ZERO
        parts = 1
    elif held >= 0 and _clear(objects, cup, way, setting):
        parts = 1
    lip_push, touched, first = _ZERO, _ZERO, 0
    speed = (way.now[2] - _point(way, -1 / parts)[2]) * parts / step + rate
    number = 0
    while number < parts:
        part = step / parts
        last, point = _point(way, number / parts), _point(way, (number + 1) / parts)
        velocity = plus(point, last, -1.0)
        velocity = velocity[0] / part, velocity[1] / part, velocity[2] / part
        mass = CUP_MASS + (objects[held]["mass"] if held >= 0 else 0.0)
        _fill(objects, (velocity[0], velocity[1], speed), mass, setting.half, part, work.bodies)
        count, first = _collide(objects, cup, last, point, setting, work)
        prepare(contacts, count, work.bodies, memory, part)
        target = velocity[2] - SPRING_GAIN * cup["slide"] / part
        solve(contacts, count, work.bodies, Motor(target, mass, CUP.preload * part), calm)
        if calm and not still(work.bodies):
            calm, parts = False, setting.parts
            speed = (way.now[2] - _point(way, -1 / parts)[2]) * parts / step + rate
            continue
        memory[:] = 0.0
        for j in range(count):
            contact = contacts[j]
            impulse = three(contact["impulse"])
            put(memory[contact["slot"]], plus(_ZERO, impulse, 1 / part))
            if j < first:
                lip_push = plus(lip_push, impulse, -1.0)
            elif contact["b"] == 0:
                touched = plus(touched, impulse)
            elif contact["a"] == 0:
                touched = plus(touched, impulse, -1.0)
        speed = work.bodies[0]["velocity"][2]
        cup["slide_rate"] = speed - velocity[2]
        cup["slide"] = max(cup["slide"] + part * cup["slide_rate"], 0.0)
        if not calm:
            _move(objects, held, work.bodies, part)
        if held >= 0:
            hung = plus(point, three(cup["grip"]))
            put(objects[held]["position"], (hung[0], hung[1], hung[2] + cup["slide"]))
        number += 1
    if cup["slide"] < _SETTLED and abs(cup["slide_rate"]) < _STOPPED:
        cup["slide"] = cup["slide_rate"] = 0.0
    seal = _ZERO
    if held >= 0:
        moved = plus(three(objects[held]["position"]), start, -1.0)
        velocity = moved[0] / step, moved[1] / step, moved[2] / step
        seal = seal_load(objects[held], velocity, touched, step)
        put(objects[held]["velocity"], velocity)
    _settle(objects, work.bodies, held, calm)
    breathe(objects, cup, way, on, seal, setting)
    x, y, z = plus(lip_push, seal, -step)
    return x / step, y / step, (z - CUP_MASS * (cup["slide_rate"] - rate)) / step


@compiled
def _collide(
    objects: Records, cup: Record, last: Vector, point: Vector, setting: Setting, work: Work
) -> tuple[int, int]:
    """Find all contacts as P moves; return their number and that of the lip's, which come first."""
    held, near = cup["held"], length(plus(point, last, -1.0)) + _NEARBY
    lip = lip_of(last, cup["slide"])
    first = collide_lip(objects, held, lip, near, setting, work.contacts)
    if first == 0 and held < 0 and _at_rest(objects):
        return 0, 0
    count = collide_objects(objects, held, setting, work.polygons, work.contacts, first)
    return count, first


@compiled
def _point(way: Way, time: float) -> Vector:
    """Return point P at a share of the time step, on the parabola through its three places."""
    bend = plus(plus(way.then, way.now, -2.0), way.before)
    half = plus(way.then, way.before, -1.0)
    return plus(plus(way.now, half, 0.5 * time), bend, 0.5 * time * time)


@compiled
def _fill(
    objects: Records, cup: Vector, mass: float, halves: FloatArray, step: float, bodies: Records
) -> None:
    """Set the solver's bodies to the velocities without contacts."""
    body = bodies[0]
    put(body["velocity"], (cup[0], cup[1], cup[2] - GRAVITY * step))
    put(body["spin"], _ZERO)
    put(body["lightness"], (0.0, 0.0, 1 / mass))
    body["across"] = body["along"] = 0.0
    for index in range(len(objects)):
        item, body = objects[index], bodies[index + 1]
        light, frame, (p, _, r) = 1 / item["mass"], axes(item["quaternion"]), three(halves[index])
        body["across"], body["along"] = 3 * light / (p * p + r * r), 1.5 * light / (p * p)
        put(body["velocity"], plus(three(item["velocity"]), (0.0, 0.0, -1.0), GRAVITY * step))
        put(body["lightness"], (light, light, light))
        put(body["axis"], frame[2])
        spin = three(item["spin"])
        gyroscopic = step * (body["across"] / body["along"] - 1) * dot(spin, frame[2])
        put(body["spin"], plus(spin, cross(spin, frame[2]), -gyroscopic))


@compiled
def _move(objects: Records, held: int, bodies: Records, step: float) -> None:
    """Move free objects at the velocities that the solver found."""
    for index in range(len(objects)):
        if index != held:
            item, body = objects[index], bodies[index + 1]
            velocity, (p, q, r) = three(body["velocity"]), three(body["spin"])
            put(item["position"], plus(three(item["position"]), velocity, step))
            put(item["velocity"], velocity)
            put(item["spin"], (p, q, r))
            turn = item["quaternion"]
            x, y, z = 0.5 * step * p, 0.5 * step * q, 0.5 * step * r
            a, b, c, d = turn[0], turn[1], turn[2], turn[3]
            e, f = a + x * d + y * c - z * b, b + y * d + z * a - x * c
            g, h = c + z * d + x * b - y * a, d - (x * a + y * b + z * c)
            size = math.sqrt((e * e + f * f) + (g * g + h * h))
            turn[0], turn[1], turn[2], turn[3] = e / size, f / size, g / size, h / size


@compiled
def _clear(objects: Records, cup: Record, way: Way, setting: Setting) -> bool:
    """Return whether the held object is far from everything, and everything else at rest."""
    held = cup["held"]
    place, moved = three(objects[held]["position"]), length(plus(way.then, way.now, -1.0))
    reach = length(three(setting.half[held])) + moved + _NEAR
    if cup["slide"] > 0 or place[2] - TABLE.top < reach:
        return False
    for index in range(len(objects)):
        if index != held:
            away = length(plus(three(objects[index]["position"]), place, -1.0))
            if objects[index]["rest"] < AT_REST or away < reach + length(three(setting.half[index])):
                return False
    return True


@compiled
def _settle(objects: Records, bodies: Records, held: int, calm: bool) -> None:
    """Count time steps without motion, and stop what stays."""
    stays = calm or still(bodies)
    for index in range(len(objects)):
        item = objects[index]
        item["rest"] = AT_REST if calm else item["rest"] + 1 if stays and index != held else 0
        if calm:
            put(item["velocity"], _ZERO)
            put(item["spin"], _ZERO)
