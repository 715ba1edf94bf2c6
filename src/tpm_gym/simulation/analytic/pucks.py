"""Objects on tables, cups above them, and the vacuum between, for many machines at once.

The law of contact is PyBullet's, whose numbers this module takes: velocities first, then positions;
no restitution; what has gone into something comes out by a share of its depth in each time step;
friction of a standing block as its direct solver has it.

Arrays have components first and rows last. Rows that nothing happens to cost nothing, those that
are carried freely are computed for all time steps at once, the others step by step: standing and
flat (:mod:`.shoving`) as long as they do, else in any posture (:mod:`.tumbling`). All of it is
elementwise, so that a row has the same bits alone and among others.

What is left out: what stands exactly on the table sinks no 0.16 mm in the first time steps, as it
does in PyBullet; an open lip that is dragged over the top face neither drags nor tips a standing
block; a block stands until its middle is beyond the table's edge, and then falls as it is, past the
table; one that is held askew is pressed on the table by the middle of its bottom; only block and
lip touch, not the stem and the platform; lip and block touch in one point.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray, IntArray
from tpm_gym.mechanism.cup import CUP, sealed
from tpm_gym.mechanism.mount import GRAVITY
from tpm_gym.simulation.analytic.shoving import Side, Standing, Strengths, shove, side_of
from tpm_gym.simulation.analytic.tumbling import (
    ROUNDING,
    SEEN_BY_LIP,
    SLOP,
    Body,
    Lip,
    axes,
    least_rise,
    tumble,
)
from tpm_gym.simulation.stage import FLOOR, TABLE
from tpm_gym.simulation.state import Block
from tpm_gym.simulation.vacuum import hold_each_after, holds, pressure_after

__all__ = ["Pucks"]

_SPRING = 0.8  # share of the cup's way back that a time step leaves of it
_SEAT = 2e-5  # m; distance of lip and face in a seal
_SETTLED = 1e-6  # m, and m/s: less is none
_SHALLOW = 2e-4  # m; what stands and is no deeper is at rest
_DEEP = 2 * ROUNDING  # m; a lip that is less below the top face comes out there
_SLOW, _LAZY = 5e-3, 0.3  # m/s, rad/s: what nearly stands, or lies, and is slower comes to rest
_LEVEL = 1e-5  # square of the sine of half the angle by which it nearly stands
_ABOUT_Z = np.array([0.0, 0.0, 1.0, 1.0])
_LANDING = 3 * GRAVITY  # m/s^2; then the engine does not know yet where it slips, and has a box
_TURNING = 3.0  # a corner's distance over the radius of gyration of a square, squared
_NEAR = 0.005  # m; around what the lip may touch

_CUP_MASS = CUP.link("platform", (0.0, 0.0, 0.0)).mass
_DOWN = (0.0, 0.0, -1.0)

# Rows of the table of numbers
_POSITION, _VELOCITY, _TURN = slice(0, 3), slice(3, 6), slice(6, 10)
_SPIN, _GRIP, _SLIDE, _VACUUM = slice(10, 13), slice(13, 16), 16, 17
_NORMAL = slice(18, 21)  # of the last contact with the lip, if it was the last time step's
_COLUMNS = 21


class Pucks:
    """One object on each of n robots' tables, and the vacuum in each cup.

    Args:
        block: What the objects are; None for none.
        count: n.
        time_step: s.
        table: Half edges of the tables along x and y, m.
    """

    def __init__(
        self,
        block: Block | None,
        count: int,
        time_step: float,
        table: tuple[float, float] = (np.inf, np.inf),
    ) -> None:
        """Objects in the middle of their tables."""
        self._block, self._time_step, self._table = block, time_step, table
        self._numbers = np.arange(count)
        self._state = np.zeros((_COLUMNS, count))
        self._held = np.zeros(count, dtype=bool)
        self._still = np.zeros(count, dtype=bool)
        self._mass = np.full(count, block.mass if block else 0.0)
        self._rough = np.full(count, block.friction if block else 0.0)
        if block is not None:
            middle = np.zeros((count, 3)) + (0.0, 0.0, block.height / 2)
            self.place(slice(None), middle)

    def alter(
        self, rows: slice | IntArray, mass_factor: FloatArray, friction_factor: FloatArray
    ) -> None:
        """Make objects (r,) times as heavy and as rough as nominal."""
        if self._block is not None:
            self._mass[rows] = self._block.mass * mass_factor
            self._rough[rows] = self._block.friction * friction_factor

    def place(self, rows: slice | IntArray, positions: FloatArray) -> None:
        """Let go, empty the cups, and put objects upright and at rest.

        Args:
            rows: Which.
            positions: (r, 3) m, world, of their centres.
        """
        self._state[:, rows] = 0.0
        self._state[_POSITION, rows] = np.asarray(positions).T
        self._state[_TURN.stop - 1, rows] = 1.0
        self._held[rows] = self._still[rows] = False

    def advance(self, rows: slice | IntArray, path: FloatArray, on: BoolArray) -> FloatArray:
        """Run K time steps.

        Args:
            rows: r of the machines.
            path: (K + 2, 3, r) m, world: point P before the last time step, now, and after each
                time step to come.
            on: (r,) whether the vacuum is on.

        Returns:
            (K, 3, r) N, world: what cup and object do to the platform in each time step, beside
            the weight and inertia of the cup at rest in it.
        """
        force = np.zeros((len(path) - 2, *path.shape[1:]))
        if self._block is None:
            return force
        number = self._numbers[rows]
        held = self._held[rows]
        awake = ~self._still[rows] | (self._state[_VACUUM, rows] > 0) | held
        busy = awake | self._reached(rows, path)
        carried = np.flatnonzero(held)
        if len(carried):
            which = number[carried]
            done = self._carry(which, path, on, carried, force)
            busy[carried[done]] = False
        loose = np.flatnonzero(busy)
        if len(loose):
            force[:, :, loose] = self._run(number[loose], path[:, :, loose], on[loose])
        return force

    def carried(self, rows: slice | IntArray) -> FloatArray:
        """What the cups hold, (r,) kg."""
        return np.where(self._held[rows], self._mass[rows], 0.0)

    def report(self) -> dict[str, Any]:
        """The entries of a :class:`~tpm_gym.simulation.state.State` about objects, rows first."""
        some = self._block is not None
        count = len(self._numbers)

        def rows(part: slice) -> FloatArray:
            columns = self._state[part].T
            return columns[:, None, :].copy() if some else np.empty((count, 0, columns.shape[1]))

        turn = self._state[_TURN]
        axis = _axis(turn).T[:, None, :].copy() if some else np.empty((count, 0, 3))
        return {
            "object_position": rows(_POSITION),
            "object_quaternion": rows(_TURN),
            "object_axis": axis,
            "object_velocity": rows(_VELOCITY),
            "object_angular_velocity": rows(_SPIN),
            "held": np.where(self._held, 0, -1),
            "vacuum": self._state[_VACUUM].copy(),
        }

    def save(self, rows: slice | IntArray) -> Any:
        """Take down everything that the next steps of rows depend on."""
        parts = (self._state, self._held, self._still, self._mass, self._rough)
        return tuple(part[..., rows].copy() for part in parts)

    def restore(self, rows: slice | IntArray, data: Any) -> None:
        """Go back to what :meth:`save` returned."""
        parts = (self._state, self._held, self._still, self._mass, self._rough)
        for part, saved in zip(parts, data, strict=True):
            part[..., rows] = saved

    # -- which rows ---------------------------------------------------------------------------

    def _reached(self, rows: slice | IntArray, path: FloatArray) -> BoolArray:
        """(r,) whether the lip may come to touch the object."""
        assert self._block is not None
        width, height = self._block.width, self._block.height
        x, y, z = self._state[_POSITION, rows]
        size = np.hypot(np.hypot(width, width), height) / 2
        lowest = path[1:, 2].min(axis=0) - CUP.length
        upright = ~self._state[_TURN.start : _TURN.start + 2, rows].any(axis=0)
        reached: BoolArray = lowest < z + np.where(upright, height / 2, size) + _NEAR
        some = np.flatnonzero(reached)
        if len(some):
            near = size + CUP.radius + _NEAR
            for place, along in ((x, path[1:, 0]), (y, path[1:, 1])):
                way, middle = along[:, some], place[some]
                meets = (way.min(axis=0) < middle + near) & (way.max(axis=0) > middle - near)
                reached[some] &= meets
        return reached

    # -- carried through the air, all time steps at once -----------------------------------------

    def _carry(
        self,
        which: IntArray,
        path: FloatArray,
        on: BoolArray,
        columns: IntArray,
        force: FloatArray,
    ) -> BoolArray:
        """Move what is held and stays so, clear of the table; whether that was so."""
        assert self._block is not None
        step, state = self._time_step, self._state[:, which]
        way = path[:, :, columns]
        moved = (way[1:] - way[:-1]) / step
        load = (moved[1:] - moved[:-1]) / step
        load[:, 2] += GRAVITY
        load *= self._mass[which]
        vacuum = np.empty_like(load[:, 0])
        safe: BoolArray = on[columns] & (state[_SLIDE] == 0.0)
        grip = state[_GRIP]
        lowest = way[2:, 2].min(axis=0) + grip[2] - self._block.height / 2
        safe &= lowest > 0
        # The first force is that of the object's own velocity, which a new seal has to change.
        safe &= (np.abs(state[_VELOCITY] - moved[0]) < 1e-9).all(axis=0)
        last = state[_VACUUM]
        for now in vacuum:
            now[:] = last = pressure_after(last, step, True)
        shear = np.sqrt(load[:, 0] * load[:, 0] + load[:, 1] * load[:, 1])
        safe &= holds(vacuum, (load[:, 2], shear)).all(axis=0)
        kept = which[safe]
        self._state[_POSITION, kept] = (way[-1] + grip)[:, safe]
        self._state[_VELOCITY, kept] = moved[-1][:, safe]
        self._state[_VACUUM, kept] = last[safe]
        force[:, :, columns[safe]] = -load[:, :, safe]
        return safe

    # -- everything else, step by step ---------------------------------------------------------

    def _run(self, which: IntArray, path: FloatArray, on: BoolArray) -> FloatArray:
        """The time steps of some machines (r,), one by one; the force (K, 3, r)."""
        state, held = self._state[:, which], self._held[which]
        mass, rough = self._mass[which], self._rough[which]
        still = np.zeros(len(which), dtype=bool)
        force = np.zeros((len(path) - 2, *path.shape[1:]))
        for k, step_force in enumerate(force):
            load = np.zeros((2, len(which)))
            fixed, free = np.flatnonzero(held), np.flatnonzero(~held)
            points = path[k : k + 3]
            if len(fixed):
                part = state[:, fixed]
                step_force[:, fixed], load[:, fixed] = self._move_held(
                    part, points[:, :, fixed], mass[fixed], rough[fixed]
                )
                state[:, fixed] = part
            if len(free):
                turn, spin = state[_TURN, free], state[_SPIN, free]
                flat = (turn[0] == 0) & (turn[1] == 0) & (spin[0] == 0) & (spin[1] == 0)
                upright, other = free[flat], free[~flat]
                if len(upright):
                    part = state[:, upright]
                    its_force, its_rest, tips = self._move_flat(
                        part, points[:, :, upright], mass[upright], rough[upright]
                    )
                    stays = ~tips
                    other = np.concatenate([other, upright[tips]])
                    upright = upright[stays]
                    state[:, upright] = part[:, stays]
                    step_force[:, upright] = its_force[:, stays]
                    still[upright] = its_rest[stays]
                if len(other):
                    part = state[:, other]
                    step_force[:, other], still[other] = self._move_any(
                        part, points[:, :, other], mass[other], rough[other]
                    )
                    state[:, other] = part
            held = self._hold(state, held, path[k + 2], on, load)
            still &= ~held
        self._state[:, which], self._held[which], self._still[which] = state, held, still
        return force

    def _move_held(
        self, state: FloatArray, path: FloatArray, mass: FloatArray, rough: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """A time step of objects in the cup; the force (3, r) and the seal's load (2, r)."""
        assert self._block is not None
        step = self._time_step
        position, slide = state[_POSITION], _SPRING * state[_SLIDE]
        there = path[2] + state[_GRIP]
        there[2] += slide
        least = position[2] + least_rise(self._gap(position))
        pushed = np.maximum(least - there[2], 0.0)
        there[2] += pushed
        slide = slide + pushed
        velocity = (there - position) / step
        total = (velocity - state[_VELOCITY]) / step
        total[2] += GRAVITY
        seal = mass * total
        pressed = pushed > 0
        spring = CUP.preload + _CUP_MASS * total[2]
        normal = pressed * np.maximum(spring + seal[2], 0.0)
        speed = _level_length(velocity)
        seal[:2] += rough * normal * velocity[:2] / np.maximum(speed, _SETTLED)
        seal[2] -= normal
        force = -seal
        force[2] = np.where(pressed, self._spring(path), force[2])
        state[_POSITION], state[_VELOCITY], state[_SPIN] = there, velocity, 0.0
        state[_SLIDE] = np.where(slide < _SETTLED, 0.0, slide)
        return force, np.stack([seal[2], _level_length(seal)])

    def _move_flat(
        self, state: FloatArray, path: FloatArray, mass: FloatArray, rough: FloatArray
    ) -> tuple[FloatArray, BoolArray, BoolArray]:
        """A time step of upright objects; the force (3, r), which lie still, and which tip.

        What happens to those that tip is of no use.
        """
        assert self._block is not None
        step, half, width = self._time_step, self._block.height / 2, self._block.width
        position, velocity = state[_POSITION], state[_VELOCITY]
        falling = velocity[2] - GRAVITY * step
        velocity[2] = np.maximum(falling, least_rise(self._gap(position)) / step)
        carried = velocity[2] - falling
        # The lip: beside or above, as it was, else by the shorter way out
        moved, slide = path[2] - path[1], state[_SLIDE]
        moved[2] -= (1 - _SPRING) * slide
        overlap = position[2] + half + CUP.length - path[1, 2] - slide
        side = side_of(path[1, :2] - position[:2], state[_TURN], overlap, width / 2)
        known, deep = _level_length(state[_NORMAL]) > 0.5, overlap > _DEEP
        beside = (side.away > 0) | (deep & (known | (side.away >= _DEEP - overlap)))
        apart = least_rise(-overlap, SEEN_BY_LIP) - moved[2] + velocity[2] * step
        excess = np.where(beside, 0.0, np.maximum(apart, 0.0))
        pressed = excess > 0
        slide = _SPRING * slide + excess
        force = np.zeros_like(position)
        force[2] = np.where(pressed, self._spring(path), 0.0)
        normal = carried + pressed * CUP.preload * step / mass
        shoved = np.flatnonzero(beside & (overlap > 0) & (side.gap < SEEN_BY_LIP))
        tips, moves = pressed & (carried == 0), (velocity != 0)[:2].any(axis=0)
        done = None
        if len(shoved):
            spin = state[_SPIN][2, shoved]
            done = shove(
                Side(*(part[..., shoved] for part in side)),
                Standing(velocity[:, shoved], spin, state[_TURN][:, shoved]),
                moved[:, shoved] / step,
                Strengths(normal[shoved], CUP.preload * step / mass[shoved], rough[shoved]),
                (width, 2 * half),
                2 * half - 0.5 * overlap[shoved],
                step,
            )
        moves |= state[_SPIN][2] != 0
        _slow_down(state, rough * normal, carried > _LANDING * step, width)
        state[_NORMAL] = 0.0
        if done is not None:
            velocity[:2, shoved], state[_SPIN.start + 2, shoved] = done.velocity, done.turning
            force[:2, shoved] = -mass[shoved] * done.impulse / step
            aloft = (done.impulse != 0).any(axis=0) & (carried[shoved] == 0)
            tips[shoved] = done.tips | aloft
            state[_NORMAL.start : _NORMAL.stop - 1, shoved] = side.normal[:, shoved]
        position += velocity * step
        _yaw(state[_TURN], state[_SPIN][2] * step)
        state[_SLIDE] = np.where(slide < _SETTLED, 0.0, slide)
        rests = (carried > 0) & ~moves & ~pressed & (state[_SLIDE] == 0)
        return force, self._come_to_rest(state, rests), tips

    def _come_to_rest(self, state: FloatArray, rests: BoolArray) -> BoolArray:
        """Which of the upright objects that could rest do, and bring these to their level."""
        gap = self._gap(state[_POSITION])
        rests &= (gap > -_SHALLOW) & (gap <= 0) & (state[_NORMAL] == 0).all(axis=0)
        state[_POSITION][2] -= np.where(rests, gap + SLOP, 0.0)
        state[_VELOCITY][2] = np.where(rests, 0.0, state[_VELOCITY][2])
        return rests

    def _spring(self, path: FloatArray) -> FloatArray:
        """Force (r,) N on the platform of a cup that is pushed back and bears its own weight."""
        lift = path[2, 2] - 2 * path[1, 2] + path[0, 2]
        force: FloatArray = CUP.preload + _CUP_MASS * (GRAVITY + lift / self._time_step**2)
        return force

    def _move_any(
        self, state: FloatArray, path: FloatArray, mass: FloatArray, rough: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """A time step of objects in any posture; the force (3, r), and which lie still."""
        assert self._block is not None
        step, slide = self._time_step, state[_SLIDE]
        half = (self._block.width / 2, self._block.width / 2, self._block.height / 2)
        point, lip = path[1].copy(), (path[2] - path[1]) / step
        point[2] += slide - CUP.length
        lip[2] -= (1 - _SPRING) * slide / step
        body = Body(state[_POSITION], state[_VELOCITY], state[_TURN], state[_SPIN])
        level = self._level(body.position)
        after, pushed, impulse, normal = tumble(
            body, Lip(point, lip, state[_NORMAL]), level, mass, rough, half, step
        )
        slide = _SPRING * slide + pushed
        state[_SLIDE], state[_NORMAL] = np.where(slide < _SETTLED, 0.0, slide), normal
        state[_POSITION], state[_VELOCITY], state[_TURN], state[_SPIN] = after
        force = -impulse / step
        force[2] = np.where(pushed > 0, self._spring(path), force[2])
        return force, self._settle(state)

    def _settle(self, state: FloatArray) -> BoolArray:
        """Stand upright what nearly does, and find what lies still."""
        assert self._block is not None
        turn, spin, velocity = state[_TURN], state[_SPIN], state[_VELOCITY]
        alone = (state[_NORMAL] == 0).all(axis=0) & (state[_SLIDE] == 0)
        slow: BoolArray = (np.abs(spin[:2]) < _LAZY).all(axis=0) & (np.abs(velocity[2]) < _SLOW)
        if not slow.any():
            return slow
        down = self._gap(state[_POSITION])
        upright = (turn[0] * turn[0] + turn[1] * turn[1] < _LEVEL) & (np.abs(down) < _SHALLOW)
        upright &= slow
        length = np.where(upright, np.sqrt(turn[2] * turn[2] + turn[3] * turn[3]), 1.0)
        state[_TURN] = np.where(upright, turn * _ABOUT_Z[:, None], turn) / length
        state[_SPIN] = np.where(upright, spin * _ABOUT_Z[:3, None], spin)
        lies: BoolArray = alone & ~upright & (np.abs(velocity) < _SLOW).all(axis=0)
        lies &= (np.abs(spin) < _LAZY).all(axis=0)
        frame = axes(turn)
        lies &= np.abs(frame[:, 2]).max(axis=0) > 1 - _LEVEL
        state[_VELOCITY.start : _VELOCITY.stop] = np.where(lies, 0.0, state[_VELOCITY])
        state[_SPIN] = np.where(lies, 0.0, state[_SPIN])
        return lies

    def _level(self, position: FloatArray) -> FloatArray:
        """Height of what is below, m."""
        edge_x, edge_y = self._table
        over = (np.abs(position[0]) <= edge_x) & (np.abs(position[1]) <= edge_y)
        level: FloatArray = np.where(over, TABLE.top, FLOOR.top)
        return level

    def _gap(self, position: FloatArray) -> FloatArray:
        """Height of the bottom face over what is below, m."""
        assert self._block is not None
        gap: FloatArray = position[2] - self._block.height / 2 - self._level(position)
        return gap

    def _hold(
        self,
        state: FloatArray,
        held: BoolArray,
        point: FloatArray,
        on: BoolArray,
        load: FloatArray,
    ) -> BoolArray:
        """Hold on, drop, or take what the lip lies on, after a time step; what is held now."""
        assert self._block is not None
        size = (self._block.width, self._block.height)
        position, slide = state[_POSITION], state[_SLIDE]
        lip = np.stack([point[0], point[1], point[2] + slide - CUP.length])
        touched = np.zeros_like(held)
        far = (np.abs(lip - position) > np.hypot(*size) + CUP.seal_gap).any(axis=0)
        some = np.flatnonzero(on & ~held & ~far)
        if len(some):
            there, turn = position[:, some], state[_TURN][:, some]
            touched[some] = sealed(lip[:, some], _DOWN, there, turn, size)
        after, state[_VACUUM] = hold_each_after(
            held, state[_VACUUM], self._time_step, on, (load[0], load[1]), touched
        )
        state[_VACUUM] = np.where(state[_VACUUM] < 1e-3, 0.0, state[_VACUUM])
        taken = np.flatnonzero(after & ~held)
        if len(taken):
            grip = position[:, taken] - point[:, taken]
            above = lip[2][taken] - position[2, taken] - size[1] / 2
            grip[2] -= slide[taken] + np.maximum(_SEAT - above, 0.0)
            state[_GRIP, taken] = grip
        return after


def _axis(turn: FloatArray) -> FloatArray:
    """The block's own z axis (3, r) in the world."""
    x, y, z, w = turn
    axis: FloatArray = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    return axis


def _level_length(vector: FloatArray) -> FloatArray:
    """Length of the level part of vectors (3, r)."""
    length: FloatArray = np.sqrt(vector[0] * vector[0] + vector[1] * vector[1])
    return length


def _slow_down(state: FloatArray, most: FloatArray, landed: BoolArray, width: float) -> None:
    """Let the table take impulses of at most ``most`` (m/s), by the mass, from what slides.

    Turning counts by the speed of the corners, and their friction acts so much more on it.
    """
    velocity, turning = state[_VELOCITY], state[_SPIN][2]
    squares = velocity[0] * velocity[0] + velocity[1] * velocity[1]
    speed = np.sqrt(squares + 0.5 * width**2 * turning * turning)
    taken = most / np.maximum(speed, _SETTLED)
    bound = most * np.sqrt(0.5)
    boxed = velocity[:2] - np.minimum(np.maximum(velocity[:2], -bound), bound)
    velocity[:2] = np.where(landed, boxed, velocity[:2] * np.maximum(1 - taken, 0.0))
    turning *= np.maximum(1 - _TURNING * taken, 0.0)


def _yaw(turn: FloatArray, angle: FloatArray) -> None:
    """Turn upright blocks (in place) by small angles."""
    z, w = turn[2] + 0.5 * angle * turn[3], turn[3] - 0.5 * angle * turn[2]
    length = np.sqrt(z * z + w * w)
    turn[2], turn[3] = z / length, w / length
