"""An object on a table, a cup above it, and the vacuum between, a time step at a time.

The law of contact is PyBullet's, whose numbers this module takes: velocities first, then positions;
no restitution; what has gone into something comes out by a share of its depth in each time step;
friction of a standing block as its direct solver has it.

An object is held, stands (:mod:`.shoving`) as long as it does, or is in any posture
(:mod:`.tumbling`).

What is left out: what stands exactly on the table sinks no 0.16 mm in the first time steps, as it
does in PyBullet; an open lip that is dragged over the top face does not turn a standing block; a
block stands until its middle is beyond the table's edge, and then falls as it is, past the
table; one that is held askew is pressed on the table by the middle of its bottom; only block and
lip touch, not the stem and the platform; lip and block touch in one point.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from tpm_gym.arrays import BoolArray, FloatArray, IntArray, Vector
from tpm_gym.mechanism.cup import CUP, sealed
from tpm_gym.mechanism.mount import GRAVITY
from tpm_gym.simulation.analytic.body import (
    CHANGED,
    GRIP,
    HELD,
    LET_GO,
    MASS,
    NORMAL,
    ROUGH,
    ROUNDING,
    SEEN_BY_LIP,
    SETTLED,
    SLIDE,
    SLOP,
    SPIN,
    SPRING,
    STILL,
    TAKEN,
    TAKEN_PRESSED,
    TURN,
    UNKNOWN_SLIP,
    VACUUM,
    VX,
    VY,
    VZ,
    Setting,
    X,
    Y,
    Z,
    axes,
    clip,
    least_rise,
    level_length,
    plus,
    put,
    three,
)
from tpm_gym.simulation.analytic.compiling import SOURCES, compiled, kept
from tpm_gym.simulation.analytic.shoving import drags_over, shove, side_of
from tpm_gym.simulation.analytic.tumbling import tumble
from tpm_gym.simulation.stage import FLOOR, TABLE
from tpm_gym.simulation.vacuum import CLEARANCE, Hold, Load, hold_after

__all__ = ["advance"]

_SHALLOW = 2e-4  # m; what stands and is no deeper is at rest
_DEEP = 2 * ROUNDING  # m; a lip that is less below the top face comes out there
_SLOW, _LAZY = 5e-3, 0.3  # m/s, rad/s: what nearly stands, or lies, and is slower comes to rest
_LEVEL = 1e-5  # square of the sine of half the angle by which it nearly stands
_LANDING = 3 * GRAVITY  # m/s^2; then the engine does not know yet where it slips, and has a box
_TURNING = 3.0  # a corner's distance over the radius of gyration of a square, squared
_NEAR = 0.005  # m; around what the lip may touch
_BESIDE_LIP = 0.94  # of the table's friction along an axis, beside what the lip rubbed off it
_NONE: Vector = (0.0, 0.0, 0.0)
_DOWN: Vector = (0.0, 0.0, -1.0)

_CUP_MASS = CUP.link("platform", _NONE).mass


class Way(NamedTuple):
    """Point P a time step ago, now, and after the time step, m, world."""

    before: Vector
    now: Vector
    then: Vector


@kept
def advance(
    table: FloatArray,
    rows: IntArray,
    path: FloatArray,
    on: BoolArray,
    setting: Setting,
    force: FloatArray,
    sources: str = SOURCES,
) -> None:
    """Run K time steps of some objects.

    Args:
        table: All objects (n, c), as in :mod:`.body`; changed.
        rows: (r,) which of them.
        path: (K + 2, 3, r) m, world: point P before the last time step, now, and after each time
            step to come.
        on: (r,) whether the vacuum is on.
        setting: What is the same for all.
        force: (K, 3, r) N, world: what cup and object do to the platform; written
            where it is not zero.
        sources: What keeps the compiled function, and nothing else.
    """
    for i in range(len(rows)):
        row, points = table[rows[i]], path[:, :, i]
        if row[STILL] and row[VACUUM] == 0 and not _reached(row, points, setting.half):
            continue
        for k in range(len(force)):
            way = Way(three(points[k], 0), three(points[k + 1], 0), three(points[k + 2], 0))
            force[k, 0, i], force[k, 1, i], force[k, 2, i] = _step(row, way, on[i], setting)


@compiled
def _reached(row: FloatArray, path: FloatArray, half: Vector) -> bool:
    """Whether the lip may come to touch an object at rest."""
    size = math.sqrt(half[0] * half[0] + half[1] * half[1] + half[2] * half[2])
    upright = row[TURN] == 0 and row[TURN + 1] == 0
    top = row[Z] + (half[2] if upright else size) + _NEAR
    near = size + CUP.radius + _NEAR
    low, lowest, highest = math.inf, (math.inf, math.inf), (-math.inf, -math.inf)
    for k in range(1, len(path)):
        x, y, low = path[k, 0], path[k, 1], min(low, path[k, 2])
        lowest = min(lowest[0], x), min(lowest[1], y)
        highest = max(highest[0], x), max(highest[1], y)
    if not low - CUP.length < top:
        return False
    meets_x: bool = lowest[0] < row[X] + near and highest[0] > row[X] - near
    meets_y: bool = lowest[1] < row[Y] + near and highest[1] > row[Y] - near
    return meets_x and meets_y


@compiled
def _step(row: FloatArray, way: Way, on: bool, setting: Setting) -> Vector:
    """A time step of an object; the force on the platform."""
    load, held, pressed = Load(0.0, 0.0), row[HELD], row[SLIDE] > 0
    if held:
        force, load = _move_held(row, way, setting)
    else:
        flat = not (row[TURN] or row[TURN + 1] or row[SPIN] or row[SPIN + 1])
        force, tips = _move_flat(row, way, setting) if flat else (_NONE, True)
        if tips:
            force = _move_any(row, way, setting)
    _hold(row, way.then, on, load, setting)
    row[CHANGED] = 0.0
    if row[HELD] != held:
        row[CHANGED] = LET_GO if held else TAKEN_PRESSED if pressed else TAKEN
    return force


@compiled
def _move_held(row: FloatArray, way: Way, setting: Setting) -> tuple[Vector, Load]:
    """A time step of an object in the cup; the force, and the seal's load (tension, shear)."""
    step, slide, mass = setting.step, SPRING * row[SLIDE], row[MASS]
    x, y, z = plus(way.then, three(row, GRIP))
    z += slide
    pushed = max(row[Z] + least_rise(_gap(row, setting)) - z, 0.0)
    z, slide = z + pushed, slide + pushed
    u, v, w = (x - row[X]) / step, (y - row[Y]) / step, (z - row[Z]) / step
    lift = (w - row[VZ]) / step + GRAVITY
    a, b, c = mass * ((u - row[VX]) / step), mass * ((v - row[VY]) / step), mass * lift
    pressed = pushed > 0
    if pressed:
        normal = max(CUP.preload + _CUP_MASS * lift + c, 0.0)
        east, north = _drag(row, u, v)
        most = row[ROUGH] * normal
        a, b, c = a + most * east, b + most * north, c - normal
    put(row, X, (x, y, z))
    put(row, VX, (u, v, w))
    put(row, SPIN, _NONE)
    row[SLIDE] = 0.0 if slide < SETTLED else slide
    return (-a, -b, _spring(way, step) if pressed else -c), Load(c, level_length(a, b))


@compiled
def _drag(row: FloatArray, u: float, v: float) -> tuple[float, float]:
    """The table's friction, east and north, on what is held and slides, by what it can be.

    In the first time step the engine does not know yet where it will slip, and has a box.
    """
    if row[CHANGED]:
        share = _BESIDE_LIP if row[CHANGED] == TAKEN_PRESSED else UNKNOWN_SLIP
        return share * clip(u / SETTLED, -1.0, 1.0), share * clip(v / SETTLED, -1.0, 1.0)
    speed = max(level_length(u, v), SETTLED)
    return u / speed, v / speed


@compiled
def _move_flat(row: FloatArray, way: Way, setting: Setting) -> tuple[Vector, bool]:
    """A time step of an upright object; the force, and whether it tips: then nothing has moved."""
    step, mass, (width, _, half) = setting.step, row[MASS], setting.half
    falling = row[VZ] - GRAVITY * step
    rising = max(falling, least_rise(_gap(row, setting)) / step)
    carried = rising - falling
    # The lip: beside or above, as it was, else by the shorter way out
    lip, slide = plus(way.then, way.now, -1.0), row[SLIDE]
    lip = (lip[0], lip[1], lip[2] - (1 - SPRING) * slide)
    overlap = row[Z] + half + CUP.length - way.now[2] - slide
    side = side_of(row, way.now[0], way.now[1], overlap, width)
    known, deep = level_length(row[NORMAL], row[NORMAL + 1]) > 0.5, overlap > _DEEP
    beside = side.away > 0 or (deep and (known or side.away >= _DEEP - overlap))
    excess = max(least_rise(-overlap, SEEN_BY_LIP) - lip[2] + rising * step, 0.0)
    # What was let go is a hair off the lip, and the engine sees them touch a time step later
    pressed = excess > 0 and not (beside or row[CHANGED] == LET_GO)
    excess, press = (excess, CUP.preload * step / mass) if pressed else (0.0, 0.0)
    weight = carried + press
    shoved = beside and overlap > 0 and side.gap < SEEN_BY_LIP
    moved = row[VX] != 0 or row[VY] != 0 or row[SPIN + 2] != 0
    force_x = force_y = 0.0
    if shoved:
        fallen, row[VZ] = row[VZ], rising
        speed = (lip[0] / step, lip[1] / step, lip[2] / step)
        done = shove(row, side, speed, weight, 2 * half - 0.5 * overlap, setting.half, step)
        if done.tips or ((done.push[0] != 0 or done.push[1] != 0) and carried == 0):
            row[VZ] = fallen
            return _NONE, True
        row[VX], row[VY], row[SPIN + 2] = done.vx, done.vy, done.spin
        force_x, force_y = -mass * done.push[0] / step, -mass * done.push[1] / step
    elif pressed and (carried == 0 or _tips(row, way.now, lip, (press, carried), setting)):
        return _NONE, True
    else:
        if pressed and moved:
            _take_along(row, (lip[0] / step, lip[1] / step), press, row[ROUGH] * weight)
        _slow_down(row, row[ROUGH] * weight, carried > _LANDING * step, 2 * width)
    row[VZ] = rising
    put(row, NORMAL, (side.nx, side.ny, 0.0) if shoved else _NONE)
    put(row, X, plus(three(row, X), three(row, VX), step))
    _yaw(row, row[SPIN + 2] * step)
    slide = SPRING * slide + excess
    row[SLIDE] = 0.0 if slide < SETTLED else slide
    rests = carried > 0 and not (moved or pressed or shoved) and row[SLIDE] == 0
    gap = _gap(row, setting)
    rests = rests and -_SHALLOW < gap <= 0
    if rests:
        row[Z], row[VZ] = row[Z] - (gap + SLOP), 0.0
    row[STILL] = rests
    return (force_x, force_y, _spring(way, step) if pressed else 0.0), False


@compiled
def _tips(
    row: FloatArray, place: Vector, moved: Vector, impulses: tuple[float, float], setting: Setting
) -> bool:
    """Whether a lip that presses on the top face tips the block, as it moves by so much (m).

    The impulses are those of the lip and of the table without it, by the mass, m/s.
    """
    step, (press, carried) = setting.step, impulses
    slip = (moved[0] - row[VX] * step, moved[1] - row[VY] * step, 0.0)
    return drags_over(row, place, slip, press, carried, setting.half)


@compiled
def _spring(way: Way, step: float) -> float:
    """Force (N) on the platform of a cup that is pushed back and bears its own weight."""
    lift = way.then[2] - 2 * way.now[2] + way.before[2]
    return CUP.preload + _CUP_MASS * (GRAVITY + lift / step**2)


@compiled
def _take_along(row: FloatArray, lip: tuple[float, float], press: float, table: float) -> None:
    """Let a lip (m/s) that presses take along what slides, of which the table takes its own."""
    left = max(1 - table / max(level_length(row[VX], row[VY]), SETTLED), 0.0)
    x, y = lip[0] - left * row[VX], lip[1] - left * row[VY]
    share = min(CUP.friction * row[ROUGH] * press / max(level_length(x, y), SETTLED), 1.0)
    row[VX], row[VY] = row[VX] + share * x, row[VY] + share * y


@compiled
def _slow_down(row: FloatArray, most: float, landed: bool, width: float) -> None:
    """Let the table take an impulse of at most ``most`` (m/s), by the mass, from what slides.

    Turning counts by the speed of the corners, and their friction acts so much more on it.
    """
    x, y, turning = row[VX], row[VY], row[SPIN + 2]
    speed = math.sqrt(x * x + y * y + 0.5 * width**2 * turning * turning)
    taken = most / max(speed, SETTLED)
    if landed:
        bound = most * UNKNOWN_SLIP
        row[VX], row[VY] = x - clip(x, -bound, bound), y - clip(y, -bound, bound)
    else:
        row[VX], row[VY] = x * max(1 - taken, 0.0), y * max(1 - taken, 0.0)
    row[SPIN + 2] = turning * max(1 - _TURNING * taken, 0.0)


@compiled
def _yaw(row: FloatArray, angle: float) -> None:
    """Turn an upright block by a small angle."""
    z, w = row[TURN + 2], row[TURN + 3]
    z, w = z + 0.5 * angle * w, w - 0.5 * angle * z
    length = math.sqrt(z * z + w * w)
    row[TURN + 2], row[TURN + 3] = z / length, w / length


@compiled
def _move_any(row: FloatArray, way: Way, setting: Setting) -> Vector:
    """A time step of an object in any posture; the force."""
    step, slide = setting.step, row[SLIDE]
    lip = (way.now[0], way.now[1], way.now[2] + slide - CUP.length)
    moved = plus(way.then, way.now, -1.0)
    speed = (moved[0] / step, moved[1] / step, moved[2] / step - (1 - SPRING) * slide / step)
    push = tumble(row, lip, speed, _level(row, setting), setting.half, step)
    slide = SPRING * slide + push.back
    row[SLIDE] = 0.0 if slide < SETTLED else slide
    put(row, NORMAL, push.normal)
    row[STILL] = _settle(row, setting)
    x, y, z = push.impulse
    return -x / step, -y / step, _spring(way, step) if push.back > 0 else -z / step


@compiled
def _settle(row: FloatArray, setting: Setting) -> bool:
    """Stand upright what nearly does, and whether it lies still."""
    lazy = abs(row[SPIN]) < _LAZY and abs(row[SPIN + 1]) < _LAZY
    if not (lazy and abs(row[VZ]) < _SLOW):
        return False
    a, b, c, d = row[TURN], row[TURN + 1], row[TURN + 2], row[TURN + 3]
    if a * a + b * b < _LEVEL and abs(_gap(row, setting)) < _SHALLOW:
        length = level_length(c, d)
        put(row, TURN, (0.0, 0.0, c / length))
        row[TURN + 3] = d / length
        row[SPIN] = row[SPIN + 1] = 0.0
        return False
    touched = row[NORMAL] or row[NORMAL + 1] or row[NORMAL + 2] or row[SLIDE]
    slow = abs(row[VX]) < _SLOW and abs(row[VY]) < _SLOW and abs(row[SPIN + 2]) < _LAZY
    flat = 0.0
    for axis in axes(row):
        flat = max(flat, abs(axis[2]))
    if touched or not slow or not flat > 1 - _LEVEL:
        return False
    put(row, VX, _NONE)
    put(row, SPIN, _NONE)
    return True


@compiled
def _level(row: FloatArray, setting: Setting) -> float:
    """Height of what is below, m."""
    edge_x, edge_y = setting.table
    return TABLE.top if abs(row[X]) <= edge_x and abs(row[Y]) <= edge_y else FLOOR.top


@compiled
def _gap(row: FloatArray, setting: Setting) -> float:
    """Height of the bottom face over what is below, m."""
    gap: float = row[Z] - setting.half[2] - _level(row, setting)
    return gap


@compiled
def _hold(row: FloatArray, point: Vector, on: bool, load: Load, setting: Setting) -> None:
    """Hold on, drop, or take what the lip lies on, after a time step."""
    width, _, height = setting.half
    lip = (point[0], point[1], point[2] + row[SLIDE] - CUP.length)
    touched = -1
    if on and not row[HELD]:
        turn = (row[TURN], row[TURN + 1], row[TURN + 2], row[TURN + 3])
        if sealed(lip, _DOWN, three(row, X), turn, (2 * width, 2 * height)):
            touched = 0
    hold = Hold(0 if row[HELD] else -1, row[VACUUM])
    after = hold_after(hold, setting.step, on, load, touched)
    row[VACUUM] = 0.0 if after.vacuum < 1e-3 else after.vacuum
    if after.which == 0 and not row[HELD]:
        above = lip[2] - row[Z] - height
        x, y, z = plus(three(row, X), point, -1.0)
        put(row, GRIP, (x, y, z - (row[SLIDE] + max(CLEARANCE - above, 0.0))))
    row[HELD] = after.which == 0
    if row[HELD]:
        row[STILL] = 0.0
