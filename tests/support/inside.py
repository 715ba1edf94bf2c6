"""Hands inside PyBullet and MuJoCo: forces, velocities, contacts, and eyes on every time step.

Forces, velocities and positions are in the world. What a time step did is known where it is
``solved``; ``after`` it, positions and velocities are those of its end.
"""

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from unittest.mock import patch

import numpy as np
from alone import Alone
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray


def nothing() -> None:
    """What happens by default."""


def in_bullet(simulation: Any) -> bool:
    return hasattr(simulation.engine, "client")


def around_each_step(
    simulation: Any,
    before: Callable[[], object] = nothing,
    solved: Callable[[], object] = nothing,
    after: Callable[[], object] = nothing,
) -> ExitStack:
    """Let something happen in every time step, until what is returned is closed.

    What is pushed ``before`` a time step is pushed in this one alone.
    """
    engine = simulation.engine
    stack = ExitStack()
    if in_bullet(simulation):
        step = engine.client.stepSimulation

        def whole():
            before()
            step()
            solved()
            after()

        stack.enter_context(patch.object(engine.client, "stepSimulation", whole))
        return stack
    import mujoco

    second_half, breathe = mujoco.mj_step2, engine._cup.breathe

    def step2(model, data):
        data.xfrc_applied[:] = 0
        before()
        second_half(model, data)
        solved()

    def breathed(*state):
        after()
        return breathe(*state)

    stack.enter_context(patch.object(mujoco, "mj_step2", step2))
    stack.enter_context(patch.object(engine._cup, "breathe", breathed))
    stack.callback(engine.data.xfrc_applied.fill, 0.0)
    return stack


def push(simulation: Any, force: ArrayLike, body: int | None = None) -> None:
    """Apply a force (3,) N in the next time step: at point P, or in the middle of an object."""
    engine = simulation.engine
    force = np.asarray(force, dtype=float)
    platform = simulation.machine.mechanism.platform
    if in_bullet(simulation):
        at = engine.robot.links[platform] if body is None else (engine.bodies[body], -1)
        place = engine.robot.truth()[1] if body is None else place_of(simulation, body).tolist()
        engine.client.applyExternalForce(*at, force.tolist(), place, engine.client.WORLD_FRAME)
        return
    where = engine.model.body(platform).id if body is None else engine._scenery._bodies[body]
    place = engine.robot.truth()[1] if body is None else engine.data.xipos[where]
    torque = np.cross(np.subtract(place, engine.data.xipos[where]), force)
    engine.data.xfrc_applied[where] += (*force, *torque)


def throw(simulation: Alone, velocity: ArrayLike, spin: float = 0.0, body: int = 0) -> None:
    """Give an object a velocity, m/s, and let it turn about the vertical, rad/s."""
    engine = simulation.engine
    velocity = np.asarray(velocity, dtype=float)
    if in_bullet(simulation):
        engine.client.resetBaseVelocity(engine.bodies[body], velocity.tolist(), (0, 0, spin))
        return
    import mujoco

    first = engine._scenery._dof[body]
    engine.data.qvel[first : first + 6] = (*velocity, 0.0, 0.0, spin)
    mujoco.mj_step1(engine.model, engine.data)  # what depends on it


def place_of(simulation: Any, body: int = 0) -> FloatArray:
    """Middle (3,) of an object, m."""
    place: FloatArray = simulation.engine.read().object_position[0, body]
    return place


def slide(simulation: Any) -> float:
    """How far the cup is out, m; negative where its spring is compressed."""
    engine = simulation.engine
    if in_bullet(simulation):
        return float(engine.client.getJointState(*engine.robot.tool)[0])
    return float(engine.data.joint("cup_slide").qpos.item())


def from_cup(simulation: Any, body: int = 0) -> FloatArray:
    """Force (3,) of the cup's contacts on an object, N; a weld is none."""
    engine = simulation.engine
    if in_bullet(simulation):
        return _contact_in_bullet(engine, body, engine.robot.tool, -1)
    return _contact_in_mujoco(engine, body, engine.model.body("cup").id)


def from_table(simulation: Any, body: int = 0) -> FloatArray:
    """Force (3,) of the table on an object, N."""
    engine = simulation.engine
    if in_bullet(simulation):
        return _contact_in_bullet(engine, body, (engine._scenery.tables[body], -1), 1)
    return _contact_in_mujoco(engine, body, 0)


def _contact_in_bullet(engine: Any, body: int, other: tuple[int, int], on: int) -> FloatArray:
    # Friction is told on the first of Bullet's own pair: with ``on`` -1, that is the other body.
    points = engine.client.getContactPoints(engine.bodies[body], other[0], -1, other[1])
    parts = [(point[7], point[9]) for point in points]
    parts += [(point[k + 1], on * point[k]) for point in points for k in (10, 12)]
    return np.sum([force * np.array(way) for way, force in parts], axis=0) + np.zeros(3)


def _contact_in_mujoco(engine: Any, body: int, other: int) -> FloatArray:
    import mujoco

    model, data, force, total = engine.model, engine.data, np.empty(6), np.zeros(3)
    this = engine._scenery._bodies[body]
    for index, contact in enumerate(data.contact):
        first, second = model.geom_bodyid[contact.geom1], model.geom_bodyid[contact.geom2]
        if {first, second} == {this, other}:
            mujoco.mj_contactForce(model, data, index, force)  # from the first on the second
            world = contact.frame.reshape(3, 3).T @ force[:3]
            total += world if second == this else -world
    return total
