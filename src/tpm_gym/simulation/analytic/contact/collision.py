"""Detection of contacts between objects, table and lip.

Objects are boxes, and the lip is an upright cylinder. The contact normal of two bodies is the
direction of their largest gap or smallest overlap. Candidates are the normals of faces and the
common normals of two edges (separating axes). Contacts are detected before the bodies touch, so
that the solver can stop the bodies at the surface and no penetration has to be removed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.compiling import compiled
from tpm_gym.mechanism.cup import CUP
from tpm_gym.simulation.analytic.contact.state import (
    LIP_SLOTS,
    PAIR_SLOTS,
    TABLE_SLOTS,
    Record,
    Records,
    Setting,
)
from tpm_gym.simulation.stage import FLOOR, TABLE
from tpm_gym.simulation.vectors import (
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

_NEAR = 1.5e-3  # m; largest gap of a contact between objects, or between object and table
_FLAT = 1e-5  # m; an edge's normal replaces a face's normal if its gap is larger by more than this
_LITTLE = 1e-9  # rounding error
_STEEP = 0.7  # smallest vertical component of the normal of an upper or lower face
_ZERO: Vector = (0.0, 0.0, 0.0)
_UP: Vector = (0.0, 0.0, 1.0)

_Place = tuple[int, int]
"""Two indices of a contact: in the list of contacts, and in the stored forces (its slot)."""
_Pair = tuple[tuple[int, int], float]
"""Indices of the bodies a and b, and the Coulomb coefficient between them."""


class _Box(NamedTuple):
    """Shape of an object: centre (m, world), axes, half edge lengths (m)."""

    middle: Vector
    frame: Frame
    half: Vector


@compiled
def _two(a: int, b: int) -> tuple[int, int]:
    """Return a pair of integers; a literal constant would make Numba compile functions again."""
    return 1 * a, 1 * b


@compiled
def _box(item: Record, half: FloatArray) -> _Box:
    """Return the shape of an object."""
    return _Box(three(item["position"]), axes(item["quaternion"]), three(half))


@compiled
def _extent(box: _Box, way: Vector) -> float:
    """Return half the width (m) of a box along a direction."""
    (u, v, w), (p, q, r) = box.frame, box.half
    return p * abs(dot(u, way)) + q * abs(dot(v, way)) + r * abs(dot(w, way))


@compiled
def _inner(box: _Box, a: float, b: float, c: float) -> Vector:
    """Convert components along a box's axes to a vector in the world frame."""
    return plus(plus(plus(_ZERO, box.frame[0], a), box.frame[1], b), box.frame[2], c)


@compiled
def _add(
    contacts: Records, place: _Place, pair: _Pair, arms: Frame, normal: Vector, gap: float
) -> int:
    """Write a contact; return the new number of contacts.

    The first two rows of ``arms`` are the lever arms (m) of the contact on bodies a and b. They
    become ``arm_a`` and ``arm_b``; the third row is not used.
    """
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
    """Return the index of the solver's body for an object."""
    return 0 if index == held else index + 1


@compiled
def collide_objects(
    objects: Records,
    held: int,
    setting: Setting,
    polygons: FloatArray,
    contacts: Records,
    count: int,
) -> int:
    """Add contacts of objects with each other and with the table; return the number of contacts.

    Args:
        objects: (k,) objects.
        held: Index of the held object; -1 for none.
        setting: Constants of the simulation.
        polygons: (2, 12, 3) m, scratch memory.
        contacts: Output.
        count: Number of contacts at the call.
    """
    slot = len(objects) * (TABLE_SLOTS + LIP_SLOTS)
    for j in range(len(objects)):
        two = _box(objects[j], setting.half[j])
        for i in range(j):
            one = _box(objects[i], setting.half[i])
            reach = length(one.half) + length(two.half) + _NEAR
            if length(plus(two.middle, one.middle, -1.0)) < reach:
                friction = objects[i]["friction"] * objects[j]["friction"]
                pair = _two(_body(i, held), _body(j, held)), friction
                count = _collide_boxes(one, two, polygons, contacts, (count, slot), pair)
            slot += PAIR_SLOTS
    for i in range(len(objects)):
        box, friction = _box(objects[i], setting.half[i]), objects[i]["friction"]
        count = _collide_table(
            box, setting, contacts, (count, TABLE_SLOTS * i), (_body(i, held), friction)
        )
    return count


@compiled
def _collide_table(
    box: _Box, setting: Setting, contacts: Records, place: _Place, body: tuple[int, float]
) -> int:
    """Add contacts of a box's corners with the table or belt.

    If the box's centre is over neither of them, add contacts with the floor instead.
    """
    (x, y, z), (count, slot), (low, high, edge) = box.middle, place, setting.table
    over = low <= x <= high and abs(y) <= edge
    height = z - (TABLE.top if over else FLOOR.top)
    friction, belt = body[1] * (TABLE.friction if over else FLOOR.friction), len(setting.half) + 1
    if height - _extent(box, _UP) > _NEAR:
        return count
    for k in range(TABLE_SLOTS):
        p, q, r = box.half
        arm = _inner(box, p if k & 1 else -p, q if k & 2 else -q, r if k & 4 else -r)
        if height + arm[2] < _NEAR:
            arms, top = (_ZERO, arm, _ZERO), belt if over and x + arm[0] < setting.belt_end else -1
            pair = _two(top, body[0]), friction
            count = _add(contacts, (count, slot + k), pair, arms, _UP, height + arm[2])
    return count


# -- lip ------------------------------------------------------------------------------------------


@compiled
def collide_lip(
    objects: Records, held: int, lip: Vector, near: float, setting: Setting, contacts: Records
) -> int:
    """Find contacts of the lip with all objects except the held object; return their number.

    Args:
        objects: (k,) objects.
        held: Index of the held object; -1 for none.
        lip: Centre of the lip, m, world.
        near: Largest gap of a contact, m.
        setting: Constants of the simulation.
        contacts: Output.
    """
    count = 0
    for i in range(len(objects)):
        x, y, z = plus(three(objects[i]["position"]), lip, -1.0)
        reach = length(three(setting.half[i])) + near
        over = level_length(x, y) < reach + CUP.radius and -reach < z < reach + CUP.bellows
        if over and i != held:
            place = _two(count, TABLE_SLOTS * len(objects) + LIP_SLOTS * i)
            pair = _two(0, i + 1), CUP.friction * objects[i]["friction"]
            box = _box(objects[i], setting.half[i])
            count = _collide_cylinder(box, lip, near, contacts, place, pair)
    return count


@compiled
def _collide_cylinder(
    box: _Box, lip: Vector, near: float, contacts: Records, place: _Place, pair: _Pair
) -> int:
    """Add the contacts of the lip with an object."""
    under = lip[2] - box.middle[2] - _extent(box, _UP)
    if under > near:
        return place[0]
    away = plus(box.middle, (lip[0], lip[1], lip[2] + CUP.bellows / 2), -1.0)
    face, apart = -1, -math.inf
    for k in range(3):
        u, v, w = box.frame[k]
        thick = CUP.radius * level_length(u, v) + CUP.bellows / 2 * abs(w)
        gap = abs(dot(box.frame[k], away)) - box.half[k] - thick
        if gap > apart + _LITTLE:
            face, apart = k, gap
    if under > apart + _FLAT:
        face, apart = 3, under  # lower face of the lip
    point = _nearest(box, lip)
    x, y = point[0] - lip[0], point[1] - lip[1]
    far = max(level_length(x, y), _LITTLE)
    radial = (x / far, y / far, 0.0)
    beside = dot(radial, away) - _extent(box, radial) - CUP.radius
    if far > _LITTLE and beside > apart + _FLAT:
        face, apart = 4, beside  # side of the lip, at an edge or corner of the object
    if apart > near:
        return place[0]
    if face == 4:
        arms = _ZERO, plus(point, box.middle, -1.0), _ZERO
        return _add(contacts, place, pair, arms, radial, apart)
    if face == 3:
        return _press_edge(box, lip, contacts, place, pair)
    normal = plus(_ZERO, box.frame[face], math.copysign(1.0, dot(box.frame[face], away)))
    return _touch_face(box, (face, normal), lip, near, contacts, place, pair)


@compiled
def _nearest(box: _Box, lip: Vector) -> Vector:
    """Return the point of a box that is nearest to the lip's axis (m, world)."""
    point, (p, q, r) = box.middle, box.half
    for _ in range(3):
        z = clip(point[2], lip[2], lip[2] + CUP.bellows)
        out = plus((lip[0], lip[1], z), box.middle, -1.0)
        a, b, c = dot(box.frame[0], out), dot(box.frame[1], out), dot(box.frame[2], out)
        point = plus(box.middle, _inner(box, clip(a, -p, p), clip(b, -q, q), clip(c, -r, r)))
    return point


@compiled
def _press_edge(box: _Box, lip: Vector, contacts: Records, place: _Place, pair: _Pair) -> int:
    """Add contacts of the lip with the uppermost edge of a tilted object.

    The contacts are at the two ends of the part of the edge that is below the lip.
    """
    (u, v, w), (p, q, r), low = box.frame, box.half, 0
    for k in range(1, 3):
        if box.half[k] * abs(box.frame[k][2]) < box.half[low] * abs(box.frame[low][2]):
            low = k
    ends = math.copysign(p, u[2]), math.copysign(q, v[2]), math.copysign(r, w[2])
    top, along = _inner(box, *ends), plus(_ZERO, box.frame[low], -2 * ends[low])
    x, y = box.middle[0] + top[0] - lip[0], box.middle[1] + top[1] - lip[1]
    # Solve |(x, y) + t along| = radius for t, the fraction of the edge.
    a, b = along[0] ** 2 + along[1] ** 2, x * along[0] + y * along[1]
    root = b * b - a * (x * x + y * y - CUP.radius**2)
    count, slot = place
    if root > 0 and a > _LITTLE:
        for k in range(2):
            t = (-b + math.copysign(math.sqrt(root), k - 0.5)) / a
            arm = plus(top, along, clip(t, 0.0, 1.0))
            gap, arms = lip[2] - box.middle[2] - arm[2], (_ZERO, arm, _ZERO)
            count = _add(contacts, (count, slot + k), pair, arms, (0.0, 0.0, -1.0), gap)
    return count


@compiled
def _touch_face(
    box: _Box,
    face: tuple[int, Vector],
    lip: Vector,
    near: float,
    contacts: Records,
    place: _Place,
    pair: _Pair,
) -> int:
    """Add the contact points of the lip on a face of an object.

    On an upper face, these are four points of the rim; points outside are moved to the face's edge.
    On a side face, these are the ends of the line in which the side of the lip touches the face.
    """
    (which, normal), (count, slot) = face, place
    first, second, steep = (which + 1) % 3, (which + 2) % 3, abs(normal[2]) > _STEEP
    u, v = normal[0], normal[1]
    if steep and level_length(u, v) < 1e-4:
        u, v = box.frame[first][0], box.frame[first][1]
    size = level_length(u, v) / CUP.radius
    u, v = u / size, v / size
    for k in range(4 if steep else 2):
        arm = plus((lip[0] + u, lip[1] + v, lip[2]), box.middle, -1.0)
        if steep:
            for axis in (first, second):
                inside = dot(box.frame[axis], arm)
                inside -= clip(inside, -box.half[axis], box.half[axis])
                arm = plus(arm, box.frame[axis], -inside)
            gap = -dot(normal, (arm[0], arm[1], lip[2] - box.middle[2])) - box.half[which]
            u, v = (v, -u) if k == 1 else (-u, -v)
        else:
            low, high = _overlap(box, first, second, arm)
            arm = plus(arm, _UP, high if k else low)
            gap = -dot(normal, arm) - box.half[which]
        if gap < near:
            count = _add(contacts, _two(count, slot + k), pair, (_ZERO, arm, _ZERO), normal, gap)
    return count


@compiled
def _overlap(box: _Box, first: int, second: int, foot: Vector) -> tuple[float, float]:
    """Return the lowest and highest height (m) at which the lip's side touches a side face.

    Args:
        box: Object.
        first: Index of one of the two axes of the object that are parallel to the face.
        second: Index of the other axis.
        foot: Point of the lip's rim, relative to the object's centre, m; the heights are above this
            point.
    """
    low, high = 0.0, CUP.bellows
    for k in (first, second):
        rise, at, half = box.frame[k][2], dot(box.frame[k], foot), box.half[k]
        if abs(rise) > 1e-6:
            one, other = (-half - at) / rise, (half - at) / rise
            low, high = max(low, min(one, other)), min(high, max(one, other))
    if low > high:
        low = high = clip(0.5 * (low + high), 0.0, CUP.bellows)
    return low, high


# -- two objects ----------------------------------------------------------------------------------


@compiled
def _collide_boxes(
    one: _Box, two: _Box, polygons: FloatArray, contacts: Records, place: _Place, pair: _Pair
) -> int:
    """Add the contacts of two objects."""
    away = plus(two.middle, one.middle, -1.0)
    face, apart = 0, -math.inf
    for k in range(6):
        way = one.frame[k] if k < 3 else two.frame[k - 3]
        gap = abs(dot(way, away)) - _extent(one, way) - _extent(two, way)
        if gap > apart + _LITTLE:
            face, apart = k, gap
    normal, edge = _ZERO, -1
    for k in range(9):
        way = cross(one.frame[k // 3], two.frame[k % 3])
        size = length(way)
        if size > 1e-3:
            way = plus(_ZERO, way, math.copysign(1 / size, dot(way, away)))
            gap = dot(way, away) - _extent(one, way) - _extent(two, way)
            if gap > apart + _FLAT:
                normal, edge, apart = way, k, gap
    if apart > _NEAR:
        return place[0]
    if edge >= 0:
        arms = _cross_edges(one, two, normal, edge // 3, edge % 3)
        return _add(contacts, place, pair, arms, normal, apart)
    plane, other, sign = (one, two, 1.0) if face < 3 else (two, one, -1.0)
    return _clip_face(plane, other, face % 3, sign, polygons, contacts, place, pair)


@compiled
def _cross_edges(one: _Box, two: _Box, normal: Vector, i: int, j: int) -> Frame:
    """Find the points at which an edge of ``one`` and an edge of ``two`` are nearest to each other.

    The edges are parallel to axis i of ``one`` and to axis j of ``two``.

    Returns:
        Vector (m) from the centre of ``one`` to the point on its edge, vector from the centre of
        ``two`` to the point on its edge, and a zero vector.
    """
    a, b, (p, q) = one.middle, two.middle, (one.frame[i], two.frame[j])
    for k in range(3):
        if k != i:
            sign = math.copysign(one.half[k], dot(one.frame[k], normal))
            a = plus(a, one.frame[k], sign)
        if k != j:
            sign = math.copysign(two.half[k], dot(two.frame[k], normal))
            b = plus(b, two.frame[k], -sign)
    between = plus(b, a, -1.0)
    u, v, w = dot(p, q), dot(p, between), dot(q, between)
    t = (v - u * w) / (1 - u * u)
    a, b = plus(a, p, t), plus(b, q, u * t - w)
    return plus(a, one.middle, -1.0), plus(b, two.middle, -1.0), _ZERO


@compiled
def _clip_face(
    plane: _Box,
    other: _Box,
    face: int,
    sign: float,
    polygons: FloatArray,
    contacts: Records,
    place: _Place,
    pair: _Pair,
) -> int:
    """Add contacts at the corners of the overlap of two faces that face each other.

    One face belongs to the box ``plane`` and is normal to axis ``face`` of this box. The other face
    belongs to the box ``other``. ``sign`` is 1 if ``plane`` is body a of the pair, and -1 if
    ``plane`` is body b.
    """
    away, facing = plus(other.middle, plane.middle, -1.0), 0
    normal = plus(_ZERO, plane.frame[face], math.copysign(1.0, dot(plane.frame[face], away)))
    for k in range(1, 3):
        most = abs(dot(other.frame[facing], normal)) + _LITTLE
        facing = k if abs(dot(other.frame[k], normal)) > most else facing
    p, q = (facing + 1) % 3, (facing + 2) % 3
    out = math.copysign(other.half[facing], -dot(other.frame[facing], normal))
    for k in range(4):
        point = plus(away, other.frame[facing], out)
        point = plus(point, other.frame[p], other.half[p] if k in (0, 3) else -other.half[p])
        put(polygons[0, k], plus(point, other.frame[q], other.half[q] if k < 2 else -other.half[q]))
    number = 4
    for k in range(4):
        axis = (face + 1 + k // 2) % 3
        side = plus(_ZERO, plane.frame[axis], 1.0 if k % 2 else -1.0)
        number = _cut(polygons[k % 2], polygons[1 - k % 2], number, side, plane.half[axis])
    count, slot = place
    for k in range(min(number, PAIR_SLOTS)):
        point = three(polygons[0, k])
        gap, rest = dot(normal, point) - plane.half[face], plus(point, away, -1.0)
        arms = (point, rest, _ZERO) if sign > 0 else (rest, point, _ZERO)
        if gap < _NEAR:
            count = _add(contacts, (count, slot + k), pair, arms, plus(_ZERO, normal, sign), gap)
    return count


@compiled
def _cut(points: FloatArray, kept: FloatArray, number: int, side: Vector, edge: float) -> int:
    """Keep the part of a polygon with coordinates up to ``edge`` (m) along the direction ``side``.

    Write the corners of this part to ``kept``; return their number.
    """
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
