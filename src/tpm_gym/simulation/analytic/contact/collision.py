"""Contacts between objects, table and lip.

Objects are boxes and the lip is an upright cylinder. The normal of two bodies is the direction in
which they are farthest apart, or overlap least, among the normals of faces and the common normals
of edges (separating axes). Contacts are found up to ``NEAR`` before they close, so that the solver
can stop bodies at the surface instead of pushing them out again.
"""

from __future__ import annotations

import math

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.mechanism.cup import CUP
from tpm_gym.simulation.analytic.compiling import compiled
from tpm_gym.simulation.analytic.contact.state import (
    LIP_SLOTS,
    PAIR_SLOTS,
    TABLE_SLOTS,
    Record,
    Records,
    Setting,
)
from tpm_gym.simulation.analytic.contact.vectors import (
    Frame,
    axes,
    clip,
    cross,
    dot,
    length,
    level_length,
    plus,
    put,
    three,
)
from tpm_gym.simulation.stage import FLOOR, TABLE

__all__ = ["collide_lip", "collide_objects"]

_NEAR = 1.5e-3  # m
_FLAT = 1e-5  # m; an edge is preferred to a face where it separates by so much more
_LITTLE = 1e-9
_STEEP = 0.7
_ZERO: Vector = (0.0, 0.0, 0.0)
_UP: Vector = (0.0, 0.0, 1.0)

_Pair = tuple[tuple[int, int], float]
"""Bodies a and b, and the Coulomb coefficient between them."""


@compiled
def _add(
    contacts: Records,
    place: tuple[int, int],
    pair: _Pair,
    arms: tuple[Vector, Vector],
    normal: Vector,
    gap: float,
) -> int:
    """Write a contact to its place (number, slot) and return the new number of contacts."""
    contact = contacts[place[0]]
    contact["slot"] = place[1]
    (contact["a"], contact["b"]), contact["friction"] = pair
    put(contact["arm_a"], arms[0])
    put(contact["arm_b"], arms[1])
    put(contact["normal"], normal)
    contact["gap"] = gap
    return place[0] + 1


@compiled
def _body(index: int, held: int) -> int:
    """Return the number of the solver's body for an object."""
    return 0 if index == held else index + 1


@compiled
def _extent(frame: Frame, half: FloatArray, way: Vector) -> float:
    """Return half the width of a box along a direction, m."""
    extent = 0.0
    for k in range(3):
        extent += half[k] * abs(dot(frame[k], way))
    return extent


@compiled
def _corner(frame: Frame, a: float, b: float, c: float) -> Vector:
    """Return the world vector of components along a box's axes."""
    return plus(plus(plus(_ZERO, frame[0], a), frame[1], b), frame[2], c)


@compiled
def collide_objects(
    objects: Records,
    held: int,
    setting: Setting,
    polygons: FloatArray,
    contacts: Records,
    count: int,
) -> int:
    """Add contacts of objects with each other and with the table.

    Args:
        objects: (k,) the objects.
        held: Index of the held object; -1 for none.
        setting: Constants.
        polygons: (2, 12, 3) workspace.
        contacts: Receives the contacts.
        count: Number of contacts so far.

    Returns:
        The new number of contacts.
    """
    slot = len(objects) * (TABLE_SLOTS + LIP_SLOTS)
    for j in range(len(objects)):
        for i in range(j):
            a, b, way = objects[i], objects[j], (i, j)
            apart = length(plus(three(b["position"]), three(a["position"]), -1.0))
            if apart < length(three(setting.half[i])) + length(three(setting.half[j])) + _NEAR:
                pair = (_body(i, held), _body(j, held)), a["friction"] * b["friction"]
                place = (count, slot)
                count = _collide_boxes(a, b, way, setting.half, polygons, contacts, place, pair)
            slot += PAIR_SLOTS
    for i in range(len(objects)):
        count = _collide_table(objects[i], i, held, setting, contacts, count)
    return count


@compiled
def _collide_table(
    item: Record, index: int, held: int, setting: Setting, contacts: Records, count: int
) -> int:
    """Add the corners of an object that are near the table, or near the floor beside it."""
    (x, y, z), half, (edge_x, edge_y) = three(item["position"]), setting.half[index], setting.table
    top, rough = FLOOR.top, FLOOR.friction
    if abs(x) <= edge_x and abs(y) <= edge_y:
        top, rough = TABLE.top, TABLE.friction
    frame, height = axes(item["quaternion"]), z - top
    if height - _extent(frame, half, _UP) > _NEAR:
        return count
    pair = (-1, _body(index, held)), item["friction"] * rough
    for k in range(TABLE_SLOTS):
        a = half[0] if k & 1 else -half[0]
        b = half[1] if k & 2 else -half[1]
        c = half[2] if k & 4 else -half[2]
        gap = height + a * frame[0][2] + b * frame[1][2] + c * frame[2][2]
        if gap < _NEAR:
            arms = (_ZERO, _corner(frame, a, b, c))
            count = _add(contacts, (count, TABLE_SLOTS * index + k), pair, arms, _UP, gap)
    return count


# -- lip ------------------------------------------------------------------------------------------


@compiled
def collide_lip(
    objects: Records, held: int, lip: Vector, near: float, setting: Setting, contacts: Records
) -> int:
    """Find contacts of the lip with objects that it does not hold.

    Args:
        objects: (k,) the objects.
        held: Index of the held object; -1 for none.
        lip: Centre of the lip, m, world.
        near: Distance up to which there is a contact, m.
        setting: Constants.
        contacts: Receives the contacts.

    Returns:
        Their number.
    """
    count = 0
    for index in range(len(objects)):
        half = setting.half[index]
        x, y, z = plus(three(objects[index]["position"]), lip, -1.0)
        reach = length(three(half)) + near
        over = level_length(x, y) < reach + CUP.radius and -reach < z < reach + CUP.bellows
        if over and index != held:
            place = (count, TABLE_SLOTS * len(objects) + LIP_SLOTS * index)
            pair = (0, index + 1), CUP.friction * objects[index]["friction"]
            count = _collide_cylinder(objects[index], half, lip, near, contacts, place, pair)
    return count


@compiled
def _collide_cylinder(
    item: Record,
    half: FloatArray,
    lip: Vector,
    near: float,
    contacts: Records,
    place: tuple[int, int],
    pair: _Pair,
) -> int:
    """Add contacts of the lip with an object."""
    middle, frame = three(item["position"]), axes(item["quaternion"])
    away = plus(middle, (lip[0], lip[1], lip[2] + CUP.bellows / 2), -1.0)
    face, apart = -1, -math.inf
    for k in range(3):
        u, v, w = frame[k]
        thick = CUP.radius * level_length(u, v) + CUP.bellows / 2 * abs(w)
        gap = abs(dot(frame[k], away)) - half[k] - thick
        if gap > apart + _LITTLE:
            face, apart = k, gap
    under = lip[2] - middle[2] - _extent(frame, half, _UP)
    if under > apart + _FLAT:
        face, apart = 3, under  # the lip's own face
    point = _nearest(middle, frame, half, lip)
    x, y = point[0] - lip[0], point[1] - lip[1]
    far = level_length(x, y)
    radial = (x / max(far, _LITTLE), y / max(far, _LITTLE), 0.0)
    beside = dot(radial, away) - _extent(frame, half, radial) - CUP.radius
    if far > _LITTLE and beside > apart + _FLAT:
        face, apart = 4, beside  # the lip's side at an edge or corner
    if apart > near:
        return place[0]
    if face == 4:
        arms = (_ZERO, plus(point, middle, -1.0))
        return _add(contacts, place, pair, arms, radial, apart)
    if face == 3:
        return _press_edge(middle, frame, half, lip, contacts, place, pair)
    normal = frame[face] if dot(frame[face], away) > 0 else plus(_ZERO, frame[face], -1.0)
    if abs(normal[2]) > _STEEP:
        return _press_face(middle, frame, half, lip, near, contacts, place, pair, face, normal)
    return _push_face(middle, frame, half, lip, near, contacts, place, pair, face, normal)


@compiled
def _nearest(middle: Vector, frame: Frame, half: FloatArray, lip: Vector) -> Vector:
    """Return the point of a box that is nearest to the axis of the lip, m, world."""
    z = clip(middle[2], lip[2], lip[2] + CUP.bellows)
    point = middle
    for _ in range(3):
        out, point = plus((lip[0], lip[1], z), middle, -1.0), middle
        for k in range(3):
            point = plus(point, frame[k], clip(dot(frame[k], out), -half[k], half[k]))
        z = clip(point[2], lip[2], lip[2] + CUP.bellows)
    return point


@compiled
def _press_edge(
    middle: Vector,
    frame: Frame,
    half: FloatArray,
    lip: Vector,
    contacts: Records,
    place: tuple[int, int],
    pair: _Pair,
) -> int:
    """Add the ends of a tilted object's uppermost edge below the lip."""
    low, level = 0, math.inf
    for k in range(3):
        if abs(half[k] * frame[k][2]) < level:
            low, level = k, abs(half[k] * frame[k][2])
    ends = (
        math.copysign(half[0], frame[0][2]),
        math.copysign(half[1], frame[1][2]),
        math.copysign(half[2], frame[2][2]),
    )
    top = _corner(frame, ends[0], ends[1], ends[2])
    along = plus(_ZERO, frame[low], -2 * ends[low])
    x, y = middle[0] + top[0] - lip[0], middle[1] + top[1] - lip[1]
    # |(x, y) + t along| <= radius
    a, b = along[0] ** 2 + along[1] ** 2, x * along[0] + y * along[1]
    root = b * b - a * (x * x + y * y - CUP.radius**2)
    if root < 0 or a < _LITTLE:
        return place[0]
    count, slot = place
    for sign in (-1.0, 1.0):
        arm = plus(top, along, clip((-b + sign * math.sqrt(root)) / a, 0.0, 1.0))
        gap = lip[2] - middle[2] - arm[2]
        count = _add(contacts, (count, slot), pair, (_ZERO, arm), (0.0, 0.0, -1.0), gap)
        slot += 1
    return count


@compiled
def _press_face(
    middle: Vector,
    frame: Frame,
    half: FloatArray,
    lip: Vector,
    near: float,
    contacts: Records,
    place: tuple[int, int],
    pair: _Pair,
    face: int,
    normal: Vector,
) -> int:
    """Add four points of the rim on an object's upper face, those outside moved to its edge."""
    level = level_length(normal[0], normal[1])
    first = (face + 1) % 3
    u, v = frame[first][0], frame[first][1]
    if level > 1e-4:
        u, v = normal[0], normal[1]
    size = level_length(u, v)
    u, v = CUP.radius * u / size, CUP.radius * v / size
    count, slot = place
    for a, b in ((u, v), (-u, -v), (-v, u), (v, -u)):
        arm = plus((lip[0] + a, lip[1] + b, lip[2]), middle, -1.0)
        for k in (first, (face + 2) % 3):
            inside = dot(frame[k], arm)
            arm = plus(arm, frame[k], clip(inside, -half[k], half[k]) - inside)
        gap = -dot(normal, (arm[0], arm[1], lip[2] - middle[2])) - half[face]
        if gap < near:
            count = _add(contacts, (count, slot), pair, (_ZERO, arm), normal, gap)
        slot += 1
    return count


@compiled
def _push_face(
    middle: Vector,
    frame: Frame,
    half: FloatArray,
    lip: Vector,
    near: float,
    contacts: Records,
    place: tuple[int, int],
    pair: _Pair,
    face: int,
    normal: Vector,
) -> int:
    """Add the ends of the line on which the lip's side meets a side of an object."""
    size = level_length(normal[0], normal[1])
    x = lip[0] + CUP.radius * normal[0] / size
    y = lip[1] + CUP.radius * normal[1] / size
    foot = plus((x, y, lip[2]), middle, -1.0)
    low, high = 0.0, CUP.bellows
    for k in ((face + 1) % 3, (face + 2) % 3):
        rise, at = frame[k][2], dot(frame[k], foot)
        if abs(rise) > 1e-6:
            one, other = (-half[k] - at) / rise, (half[k] - at) / rise
            low, high = max(low, min(one, other)), min(high, max(one, other))
    if low > high:
        low = high = clip(0.5 * (low + high), 0.0, CUP.bellows)
    count, slot = place
    for k in range(2):
        arm = plus(foot, _UP, high if k else low)
        gap = -dot(normal, arm) - half[face]
        if gap < near:
            count = _add(contacts, (count, slot + k), pair, (_ZERO, arm), normal, gap)
    return count


# -- two objects ----------------------------------------------------------------------------------


@compiled
def _collide_boxes(
    one: Record,
    two: Record,
    index: tuple[int, int],
    halves: FloatArray,
    polygons: FloatArray,
    contacts: Records,
    place: tuple[int, int],
    pair: _Pair,
) -> int:
    """Add contacts of two objects."""
    frames = axes(one["quaternion"]), axes(two["quaternion"])
    away = plus(three(two["position"]), three(one["position"]), -1.0)
    face, apart = 0, -math.inf
    for k in range(6):
        way = frames[k // 3][k % 3]
        gap = abs(dot(way, away)) - _widths(frames, halves, index, way)
        if gap > apart + _LITTLE:
            face, apart = k, gap
    if apart > _NEAR:
        return place[0]
    best, edge = _ZERO, -1
    for k in range(9):
        way = cross(frames[0][k // 3], frames[1][k % 3])
        size = length(way)
        if size > 1e-3:
            way = plus(_ZERO, way, math.copysign(1 / size, dot(way, away)))
            gap = dot(way, away) - _widths(frames, halves, index, way)
            if gap > apart + _FLAT:
                best, edge, apart = way, k, gap
    if apart > _NEAR:
        return place[0]
    if edge >= 0:
        arms = _edges(frames, halves, index, away, best, edge)
        return _add(contacts, place, pair, arms, best, apart)
    return _clip_faces(frames, halves, index, away, face, polygons, contacts, place, pair)


@compiled
def _widths(
    frames: tuple[Frame, Frame], halves: FloatArray, index: tuple[int, int], way: Vector
) -> float:
    """Return half the widths of two boxes along a direction, in sum, m."""
    return _extent(frames[0], halves[index[0]], way) + _extent(frames[1], halves[index[1]], way)


@compiled
def _edges(
    frames: tuple[Frame, Frame],
    halves: FloatArray,
    index: tuple[int, int],
    away: Vector,
    normal: Vector,
    edge: int,
) -> tuple[Vector, Vector]:
    """Return the arms to the point at which two edges cross, m."""
    arms, ways = (_ZERO, _ZERO), (frames[0][edge // 3], frames[1][edge % 3])
    a, b = _ZERO, _ZERO
    for k in range(3):
        if k != edge // 3:
            sign = math.copysign(halves[index[0], k], dot(frames[0][k], normal))
            a = plus(a, frames[0][k], sign)
        if k != edge % 3:
            sign = math.copysign(halves[index[1], k], -dot(frames[1][k], normal))
            b = plus(b, frames[1][k], sign)
    between = plus(plus(away, b), a, -1.0)
    u, v, w = dot(ways[0], ways[1]), dot(ways[0], between), dot(ways[1], between)
    s = (v - u * w) / (1 - u * u)
    arms = plus(a, ways[0], s), plus(b, ways[1], u * s - w)
    return arms


@compiled
def _clip_faces(
    frames: tuple[Frame, Frame],
    halves: FloatArray,
    index: tuple[int, int],
    away: Vector,
    face: int,
    polygons: FloatArray,
    contacts: Records,
    place: tuple[int, int],
    pair: _Pair,
) -> int:
    """Add the corners of the overlap of two faces; ``face`` numbers the axes of both boxes."""
    flip = face >= 3
    # From the box with the face that is the plane to the other one
    sign = -1.0 if flip else 1.0
    plane, other = (frames[1], frames[0]) if flip else (frames[0], frames[1])
    half = halves[index[1]] if flip else halves[index[0]]
    size = halves[index[0]] if flip else halves[index[1]]
    axis = face % 3
    normal = plus(_ZERO, plane[axis], math.copysign(1.0, sign * dot(plane[axis], away)))
    # The face of the other box that is most opposite to it
    facing, most = 0, -1.0
    for k in range(3):
        if abs(dot(other[k], normal)) > most + _LITTLE:
            facing, most = k, abs(dot(other[k], normal))
    to = plus(_ZERO, away, sign)
    p, q = (facing + 1) % 3, (facing + 2) % 3
    out = math.copysign(size[facing], -dot(other[facing], normal))
    middle = plus(to, other[facing], out)
    for k in range(4):
        a = size[p] if k in (0, 3) else -size[p]
        b = size[q] if k < 2 else -size[q]
        put(polygons[0, k], plus(plus(middle, other[p], a), other[q], b))
    number, at = 4, 0
    for k in range(4):
        axis_k = (axis + 1 + k // 2) % 3
        side = plus(_ZERO, plane[axis_k], 1.0 if k % 2 else -1.0)
        number = _cut(polygons[at], polygons[1 - at], number, side, half[axis_k])
        at = 1 - at
    count, slot = place
    for k in range(min(number, PAIR_SLOTS)):
        point = three(polygons[at, k])
        gap = dot(normal, point) - half[axis]
        if gap < _NEAR:
            rest = plus(point, to, -1.0)
            arms = (rest, point) if flip else (point, rest)
            count = _add(contacts, (count, slot + k), pair, arms, plus(_ZERO, normal, sign), gap)
    return count


@compiled
def _cut(points: FloatArray, kept: FloatArray, number: int, side: Vector, edge: float) -> int:
    """Keep the part of a polygon up to a distance along a direction; return its corners' number."""
    left = 0
    for k in range(number):
        here, there = three(points[k]), three(points[(k + 1) % number])
        a, b = dot(side, here) - edge, dot(side, there) - edge
        if a <= 0:
            put(kept[left], here)
            left += 1
        if (a <= 0) != (b <= 0):
            put(kept[left], plus(here, plus(there, here, -1.0), a / (a - b)))
            left += 1
    return left
