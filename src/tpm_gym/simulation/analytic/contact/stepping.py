"""Time steps of objects and cup on each table: contacts, impulses, motion, vacuum.

A table is skipped for a whole control period if its objects are at rest and the lip stays away.
"""

from __future__ import annotations

import math

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray, IntArray, Vector
from tpm_gym.compiling import compilable, compiled, kept
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.mount import GRAVITY
from tpm_gym.simulation.analytic.contact.collision import collide_lip, collide_objects
from tpm_gym.simulation.analytic.contact.grasp import CUP_MASS, Way, breathe, carry, lip_of
from tpm_gym.simulation.analytic.contact.solver import Motor, prepare, solve, still
from tpm_gym.simulation.analytic.contact.state import (
    AT_REST,
    Record,
    Records,
    Route,
    Setting,
    Tables,
    Work,
)
from tpm_gym.simulation.engine import SPRING_GAIN
from tpm_gym.simulation.stage import TABLE
from tpm_gym.simulation.vectors import axes, cross, dot, length, plus, put, put_row, row_of, three

_SLOW, _SLOW_SPIN = 5e-3, 0.3  # m/s, rad/s: objects below both speeds may come to rest
_SETTLED, _STOPPED = 1e-6, 1e-3  # m, m/s: below both, the slide is set to 0
_LEVEL = 1e-9  # m; largest distance from the table top of an object that stands on it
_NEARBY = 5e-4  # m; margin for contacts of the lip, beyond its motion in a time step
_BESIDE = 0.005  # m; a table is not skipped if the lip may come closer to an object
_FREE_CUP = 4 * CUP_MASS
"""Mass of an empty cup in the solver, kg.

It is larger than the cup's true mass and similar to an object's mass, so that the solver converges
several times faster. The largest force of the cup's spring can accelerate this mass at 300 m/s^2.
"""
_ZERO: Vector = (0.0, 0.0, 0.0)


@kept
def advance(
    tables: Tables,
    earlier: Tables,
    rows: IntArray,
    path: Route,
    on: BoolArray,
    setting: Setting,
    work: Work,
    push: FloatArray,
    carried: FloatArray,
) -> None:
    """Simulate objects and cups of some robots, each over its own table, in a control period.

    Args:
        tables: State of the objects and cups of all robots; changed.
        earlier: Output: the state of the simulated robots at the beginning of the control period.
        rows: (r,) indices of the robots to simulate.
        path: Motion of point P of these robots, in all time steps of the control period.
        on: (r,) whether the vacuum is on.
        push: (r, w, 3) N, force on the platform in each of the final w time steps of ``path``,
            machine's frame; output, initially zero.
        carried: (r,) kg, masses of the held objects at the end; output, initially zero.
    """
    steps, skipped, turn = len(path.weights), len(path.weights) - push.shape[1], setting.turn
    points = np.empty((steps + 2, 3))
    for i in range(len(rows)):
        row = rows[i]
        earlier.awake[row] = tables.awake[row] or _reached(tables.objects, row, path, i, setting)
        if not earlier.awake[row]:
            continue
        _copy(tables, earlier, row)
        _place(path, i, setting, points)
        objects, cup, forces = tables.objects[row], tables.cups[row], tables.forces[row]
        work.bodies[-1]["velocity"][0] = tables.belts[row]
        for k in range(steps):
            way = Way(row_of(points, k), row_of(points, k + 1), row_of(points, k + 2))
            force = _step(objects, cup, forces, way, on[i], setting, work)
            if k >= skipped:
                put(push[i, k - skipped], _placed(force, turn, _ZERO))
        held = int(cup["held"])
        if held >= 0:
            carried[i] = objects[held]["mass"]
        empty = held < 0 and cup["slide"] == 0 and cup["vacuum"] == 0
        tables.awake[row] = not (empty and _at_rest(objects))


@kept
def read(
    objects: Records,
    cups: Records,
    position: FloatArray,
    quaternion: FloatArray,
    velocity: FloatArray,
    spin: FloatArray,
    held: IntArray,
    vacuum: FloatArray,
) -> None:
    """Copy the state of objects and cups to the arrays of a :class:`.contact.Reading`."""
    for row in range(len(cups)):
        held[row], vacuum[row] = int(cups[row]["held"]), cups[row]["vacuum"]
        for index in range(objects.shape[1]):
            item = objects[row, index]
            for i in range(3):
                position[row, index, i] = item["position"][i]
                velocity[row, index, i] = item["velocity"][i]
                spin[row, index, i] = item["spin"][i]
            for i in range(4):
                quaternion[row, index, i] = item["quaternion"][i]


@kept
def place(tables: Tables, rows: IntArray, poses: FloatArray, setting: Setting) -> None:
    """Release held objects, and place all objects with zero velocity.

    :meth:`.contact.Contact.place` explains the details.

    Args:
        tables: State of the objects and cups of all robots; changed.
        rows: (r,) indices of the tables.
        poses: (r, k, 7) centres (m) and orientations (x, y, z, w) of the objects, world.
        setting: Constants of the simulation.
    """
    for i in range(len(rows)):
        row, standing = rows[i], tables.belts[rows[i]] == 0
        for index in range(poses.shape[1]):
            item, pose = tables.objects[row, index], poses[i, index]
            put(item["position"], (pose[0], pose[1], pose[2]))
            put(item["velocity"], _ZERO)
            put(item["spin"], _ZERO)
            for k in range(4):
                item["quaternion"][k] = pose[3 + k]
            standing &= _stands(pose, setting.half[index, 2], setting.table)
        for index in range(poses.shape[1]):
            tables.objects[row, index]["rest"] = AT_REST if standing else 0
        cup = tables.cups[row]
        cup["slide"] = cup["slide_rate"] = cup["vacuum"] = 0.0
        cup["held"] = -1.0
        put(cup["grip"], _ZERO)
        tables.forces[row] = 0.0
        tables.awake[row] = not standing


@compiled
def _stands(pose: FloatArray, half: float, table: tuple[float, float, float]) -> bool:
    """Return whether an object at a pose (7,) stands upright on the table top."""
    low, high, edge = table
    over = low <= pose[0] <= high and abs(pose[1]) <= edge
    return bool(over and abs(pose[2] - half - TABLE.top) < _LEVEL and pose[6] == 1.0)


@compiled
def _copy(tables: Tables, copy: Tables, row: int) -> None:
    """Copy the objects, cup and forces of a table."""
    copy.cups[row] = tables.cups[row]
    for index in range(tables.objects.shape[1]):
        copy.objects[row, index] = tables.objects[row, index]
    for slot in range(tables.forces.shape[1]):
        put_row(copy.forces[row], slot, row_of(tables.forces[row], slot))


@compiled
def _place(path: Route, i: int, setting: Setting, points: FloatArray) -> None:
    """Write the positions of P on a robot's path to ``points`` (m, world).

    The first position is one time step before the path, and the second is at its beginning. The
    others are at the ends of the time steps.
    """
    turn, origin = setting.turn, setting.origin
    put_row(points, 0, _placed(row_of(path.before, i), turn, origin))
    put_row(points, 1, _placed(row_of(path.now, i), turn, origin))
    for k in range(len(path.weights)):
        point = _ZERO
        for j in range(path.weights.shape[1]):
            point = plus(point, row_of(path.controls[i], j), path.weights[k, j])
        put_row(points, k + 2, _placed(point, turn, origin))


@compiled
def _placed(point: Vector, turn: Vector, origin: Vector) -> Vector:
    """Convert a point from the machine's frame to the world frame.

    With an ``origin`` of 0, the function converts a vector.
    """
    return (
        turn[0] * point[0] + origin[0],
        turn[1] * point[1] + origin[1],
        turn[2] * point[2] + origin[2],
    )


@compiled
def _at_rest(objects: Records) -> bool:
    """Return whether all objects are at rest."""
    resting = True
    for index in range(len(objects)):
        resting = resting and objects[index]["rest"] >= AT_REST
    return resting


@compiled
def _slow(objects: Records) -> bool:
    """Return whether all objects move so slowly that they may come to rest."""
    for index in range(len(objects)):
        velocity, spin = three(objects[index]["velocity"]), three(objects[index]["spin"])
        if dot(velocity, velocity) > _SLOW**2 or dot(spin, spin) > _SLOW_SPIN**2:
            return False
    return True


def _reached(objects: Records, row: int, path: Route, i: int, setting: Setting) -> bool:
    """Return whether the lip may touch an object: compare boxes around the path and the objects."""
    turn, origin, reached = setting.turn[2], setting.origin[2], False
    for index in range(objects.shape[1]):
        near = length(row_of(setting.half, index)) + _BESIDE
        level = objects[row, index]["position"][2] + near + CUP.length
        low = turn * path.now[i, 2] + origin < level
        for j in range(path.controls.shape[1]):
            low |= turn * path.controls[i, j, 2] + origin < level
        # ``low`` is seldom true. With _beside() apart, this function is small enough to be inlined.
        reached = reached or (low and _beside(objects[row, index], near, path, i, setting))
    return reached


compilable(_reached)


@compiled
def _beside(item: Record, size: float, path: Route, i: int, setting: Setting) -> bool:
    """Return whether the box around the path overlaps an object's box along x and y."""
    near, beside = size + CUP.radius, True
    for axis in range(2):
        low, high = _range(path, i, axis, setting)
        beside = beside and low - near < item["position"][axis] < high + near
    return beside


@compiled
def _range(path: Route, i: int, axis: int, setting: Setting) -> tuple[float, float]:
    """Return the lowest and highest coordinate (m, world) of P and of the path's control points."""
    turn, origin = setting.turn[axis], setting.origin[axis]
    low = high = turn * path.now[i, axis] + origin
    for j in range(path.controls.shape[1]):
        there = turn * path.controls[i, j, axis] + origin
        low, high = min(there, low), max(there, high)
    return low, high


@compiled
def _step(
    objects: Records,
    cup: Record,
    forces: FloatArray,
    way: Way,
    on: bool,
    setting: Setting,
    work: Work,
) -> Vector:
    """Simulate a time step on one table; return the force on the platform (N, world)."""
    held, step, (bodies, contacts, polygons) = int(cup["held"]), setting.step, work
    lip, near = lip_of(way.now, cup["slide"]), length(plus(way.then, way.now, -1.0)) + _NEARBY
    first = collide_lip(objects, held, lip, near, setting, contacts)
    if first == 0 and held < 0 and cup["slide"] == 0 and _at_rest(objects):
        if cup["vacuum"] > 0 or on:
            breathe(objects, cup, way, on, _ZERO, setting)
        return _ZERO
    count = collide_objects(objects, held, setting, polygons, contacts, first)
    mass = _FREE_CUP if held < 0 else CUP_MASS + objects[held]["mass"]
    _fill(objects, cup, way, mass, setting, bodies)
    prepare(contacts, count, bodies, forces, step)
    calm, rate, speed = held < 0 and _slow(objects), cup["slide_rate"], way.then[2] - way.now[2]
    motor = Motor((speed - SPRING_GAIN * cup["slide"]) / step, mass, CUP.preload * step)
    solve(contacts, count, bodies, motor, calm)
    lip_push, touched = _read(contacts, count, first, forces, step)
    cup["slide_rate"] = bodies[0]["velocity"][2] - speed / step
    cup["slide"] += step * cup["slide_rate"]
    if cup["slide"] < 0 or (cup["slide"] < _SETTLED and abs(cup["slide_rate"]) < _STOPPED):
        cup["slide"] = cup["slide_rate"] = 0.0
    seal = _ZERO
    if held >= 0:
        seal = carry(objects[held], cup, way.then, touched, step)
    _move(objects, bodies, held, calm and still(bodies), step)
    breathe(objects, cup, way, on, seal, setting)
    x, y, z = plus(lip_push, seal, -step)
    return x / step, y / step, (z - CUP_MASS * (cup["slide_rate"] - rate)) / step


@compiled
def _fill(
    objects: Records, cup: Record, way: Way, mass: float, setting: Setting, bodies: Records
) -> None:
    """Set the masses and the initial velocities of cup and objects for the solver.

    The velocities are those at the end of the time step if no contact force and no force of the
    cup's spring acts.
    """
    step, body = setting.step, bodies[0]
    x, y, _ = plus(way.then, way.now, -1.0)
    z = (way.now[2] - way.before[2]) / step + cup["slide_rate"]
    weight = min(mass, CUP_MASS) if cup["held"] < 0 else mass
    put(body["velocity"], (x / step, y / step, z - weight / mass * GRAVITY * step))
    put(body["spin"], _ZERO)
    put(body["lightness"], (0.0, 0.0, 1 / mass))
    body["across"] = body["along"] = 0.0
    for index in range(len(objects)):
        item, body = objects[index], bodies[index + 1]
        light, third = 1 / item["mass"], axes(item["quaternion"])[2]
        p, _, r = three(setting.half[index])
        body["across"], body["along"] = 3 * light / (p * p + r * r), 1.5 * light / (p * p)
        put(body["lightness"], (light, light, light))
        put(body["axis"], third)
        put(body["velocity"], plus(three(item["velocity"]), (0.0, 0.0, -1.0), GRAVITY * step))
        spin = three(item["spin"])
        gyroscopic = step * (body["across"] / body["along"] - 1) * dot(spin, third)
        put(body["spin"], plus(spin, cross(spin, third), -gyroscopic))


@compiled
def _read(
    contacts: Records, count: int, first: int, forces: FloatArray, step: float
) -> tuple[Vector, Vector]:
    """Store all contact forces; return the impulses on the cup and on the held object, N s."""
    cup, held = _ZERO, _ZERO
    forces[:] = 0.0
    for j in range(count):
        contact = contacts[j]
        impulse = three(contact["impulse"])
        put(forces[contact["slot"]], (impulse[0] / step, impulse[1] / step, impulse[2] / step))
        if j < first:
            cup = plus(cup, impulse, -1.0)
        elif contact["b"] == 0:
            held = plus(held, impulse)
        elif contact["a"] == 0:
            held = plus(held, impulse, -1.0)
    return cup, held


@compiled
def _move(objects: Records, bodies: Records, held: int, stays: bool, step: float) -> None:
    """Move free objects at the velocities of the solver, or set them to rest if ``stays``."""
    quiet = still(bodies)
    for index in range(len(objects)):
        item, body = objects[index], bodies[index + 1]
        if index != held and stays:
            put(item["velocity"], _ZERO)
            put(item["spin"], _ZERO)
            item["rest"] = AT_REST
        elif index != held:
            velocity, (p, q, r) = three(body["velocity"]), three(body["spin"])
            put(item["position"], plus(three(item["position"]), velocity, step))
            put(item["velocity"], velocity)
            put(item["spin"], (p, q, r))
            item["rest"] = item["rest"] + 1 if quiet else 0
            turn = item["quaternion"]
            x, y, z = 0.5 * step * p, 0.5 * step * q, 0.5 * step * r
            a, b, c, d = turn[0], turn[1], turn[2], turn[3]
            e, f = a + x * d + y * c - z * b, b + y * d + z * a - x * c
            g, h = c + z * d + x * b - y * a, d - (x * a + y * b + z * c)
            size = math.sqrt((e * e + f * f) + (g * g + h * h))
            turn[0], turn[1], turn[2], turn[3] = e / size, f / size, g / size, h / size
