"""Cup on its spring, and the object that it holds by vacuum."""

from __future__ import annotations

from typing import NamedTuple

from tpm_gym.arrays import Vector, rotate
from tpm_gym.compiling import compilable, compiled
from tpm_gym.mechanism.cup import CUP, sealed
from tpm_gym.mechanism.mount import GRAVITY
from tpm_gym.simulation.analytic.contact.state import Record, Records, Setting
from tpm_gym.simulation.vacuum import CLEARANCE, Hold, Load, hold_after, holds, pressure_after
from tpm_gym.simulation.vectors import length, level_length, plus, put, three

compilable(rotate, sealed, pressure_after, holds, hold_after)

CUP_MASS = CUP.link("platform", (0.0, 0.0, 0.0)).mass
_DOWN: Vector = (0.0, 0.0, -1.0)
_EMPTY = 1e-3  # Pa; a smaller vacuum is set to zero


class Way(NamedTuple):
    """Point P before the previous time step, before this one, and after this one (m, world)."""

    before: Vector
    now: Vector
    then: Vector


@compiled
def lip_of(point: Vector, slide: float) -> Vector:
    """Return the centre of the lip (m, world) from point P (m, world) and slide (m)."""
    return point[0], point[1], point[2] + slide - CUP.length


@compiled
def carry(item: Record, cup: Record, point: Vector, touched: Vector, step: float) -> Vector:
    """Move the held object with the cup; return the cup's mean force on the object (N, world).

    Args:
        item: Held object.
        cup: Cup after the time step.
        point: Point P after the time step, m, world.
        touched: Impulse of table and other objects on the held object in the time step, N s.
        step: Time step, s.
    """
    x, y, z = plus(point, three(cup["grip"]))
    place = x, y, z + cup["slide"]
    u, v, w = plus(place, three(item["position"]), -1.0)
    velocity = u / step, v / step, w / step
    x, y, z = plus(velocity, three(item["velocity"]), -1.0)
    put(item["position"], place)
    put(item["velocity"], velocity)
    impulse = plus((x, y, z + GRAVITY * step), touched, -1 / item["mass"])
    scale = item["mass"] / step
    return scale * impulse[0], scale * impulse[1], scale * impulse[2]


@compiled
def breathe(
    objects: Records, cup: Record, way: Way, on: bool, seal: Vector, setting: Setting
) -> None:
    """Apply the vacuum law after a time step: update the vacuum, hold or release an object.

    Args:
        objects: (k,) objects; changed.
        cup: Cup; changed.
        way: Motion of point P.
        on: Whether the vacuum is on.
        seal: Force of the cup on the held object, N, world.
        setting: Constants of the simulation.
    """
    held, lip, touched = int(cup["held"]), lip_of(way.then, cup["slide"]), -1
    if on and held < 0:
        for index in range(len(objects)):
            if touched < 0 and _seals(objects[index], lip, index, setting):
                touched = index
    load = Load(seal[2], level_length(seal[0], seal[1]))
    after = hold_after(Hold(held, cup["vacuum"]), setting.step, on, load, touched)
    cup["vacuum"] = after.vacuum if after.vacuum > _EMPTY else 0.0
    cup["held"] = after.which
    if held < 0 <= after.which:
        _take(objects[after.which], cup, way.then, lip, setting.half[after.which][2])
    elif after.which < 0 <= held:
        # The velocity of the held object was the mean over the time step. The solver needs the
        # velocity at the end of the time step.
        velocity, step = objects[held]["velocity"], setting.step
        bend = plus(plus(way.then, way.now, -2.0), way.before)
        put(velocity, plus(three(velocity), bend, 0.5 / step))


@compiled
def _seals(item: Record, lip: Vector, index: int, setting: Setting) -> bool:
    """Return whether the lip can seal on the upper face of an object."""
    half, (x, y, z), turn = setting.half[index], three(item["position"]), item["quaternion"]
    away = length(plus((x, y, z), lip, -1.0))
    if away > length(three(half)) + CUP.seal_gap:
        return False
    size = (2 * half[0], 2 * half[2])
    quaternion = (turn[0], turn[1], turn[2], turn[3])
    result: bool = sealed(lip, _DOWN, (x, y, z), quaternion, size)
    return result


@compiled
def _take(item: Record, cup: Record, point: Vector, lip: Vector, half: float) -> None:
    """Hold an object where it is, but at least ``CLEARANCE`` below the lip."""
    position = three(item["position"])
    x, y, z = plus(position, point, -1.0)
    lower = max(CLEARANCE - (lip[2] - position[2] - half), 0.0)
    put(cup["grip"], (x, y, z - cup["slide"] - lower))
    put(item["spin"], (0.0, 0.0, 0.0))
    item["rest"] = 0
