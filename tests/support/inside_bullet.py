"""Hands inside PyBullet: forces, and eyes on every time step."""

from collections.abc import Callable
from typing import Any

from alone import Alone
from numpy.typing import ArrayLike


def nothing() -> None:
    """What happens by default."""


def around_each_step(
    simulation: Alone,
    before: Callable[[], None] = nothing,
    after: Callable[[], None] = nothing,
) -> Callable[[], None]:
    """Let something happen around every time step of the engine; returns what ends it."""
    client: Any = simulation.engine.client
    step = client.stepSimulation

    def wrapped() -> None:
        before()
        step()
        after()

    def end() -> None:
        client.stepSimulation = step

    client.stepSimulation = wrapped
    return end


def push(simulation: Alone, force: ArrayLike) -> None:
    """Apply a force (N, machine's frame) at point P of the platform in the next time step."""
    engine: Any = simulation.engine
    at = engine.robot.links[simulation.machine.mechanism.platform]
    world = simulation.machine.mount.rotate(force).tolist()
    client = engine.client
    client.applyExternalForce(*at, world, engine.robot.truth()[1], client.WORLD_FRAME)
