"""Hands inside MuJoCo: forces, and eyes on every time step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import mujoco
import numpy as np
from alone import Alone
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray
from tpm_gym.simulation.mujoco.model import object_name


def nothing() -> None:
    """What happens by default."""


@contextmanager
def around_each_step(
    simulation: Alone,
    before: Callable[[], None] = nothing,
    solved: Callable[[], None] = nothing,
    after: Callable[[], None] = nothing,
) -> Iterator[None]:
    """Let something happen in every time step: before, once its forces are known, and after it."""
    engine: Any = simulation.engine
    second_half, breathe = mujoco.mj_step2, engine._cup.breathe

    def step2(model: Any, data: Any) -> None:
        before()
        second_half(model, data)
        solved()

    def breathed(*state: Any) -> Any:
        after()
        return breathe(*state)

    with patch.object(mujoco, "mj_step2", step2), patch.object(engine._cup, "breathe", breathed):
        yield


def throw(simulation: Alone, velocity: ArrayLike, spin: float = 0.0) -> None:
    """Let the first object have a velocity, m/s, and turn about its axis, rad/s."""
    engine: Any = simulation.engine
    motion = engine.data.joint(object_name(0)).qvel
    motion[:3], motion[5] = velocity, spin
    mujoco.mj_step1(engine.model, engine.data)  # what depends on it


def push(simulation: Alone, body: str, force: ArrayLike, offset: ArrayLike = 0.0) -> None:
    """Let a force (N, world) act from now on, ``offset`` m from the body's centre of mass."""
    engine: Any = simulation.engine
    force = np.asarray(force, dtype=np.float64)
    torque = np.cross(np.broadcast_to(np.asarray(offset, dtype=np.float64), 3), force)
    engine.data.xfrc_applied[engine.model.body(body).id] = (*force, *torque)


def at_point_p(simulation: Alone) -> FloatArray:
    """Where point P is from the platform's centre of mass, m, world."""
    engine: Any = simulation.engine
    body = engine.model.body(simulation.machine.mechanism.platform).id
    offset: FloatArray = np.subtract(engine.robot.truth()[1], engine.data.xipos[body])
    return offset


def on_object(simulation: Alone) -> FloatArray:
    """Force of the contacts with the cup on the first object, N, world.

    Known where a time step is ``solved``.
    """
    engine: Any = simulation.engine
    model, data = engine.model, engine.data
    cup = model.body(simulation.machine.mechanism.tool).id
    bodies = {cup, model.body(object_name(0)).id}
    total, force = np.zeros(3), np.empty(6)
    for index, contact in enumerate(data.contact):
        first, second = model.geom_bodyid[contact.geom1], model.geom_bodyid[contact.geom2]
        if {first, second} == bodies:
            mujoco.mj_contactForce(model, data, index, force)  # from the first on the second
            world = contact.frame.reshape(3, 3).T @ force[:3]
            total += world if first == cup else -world
    return total
