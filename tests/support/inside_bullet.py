"""Hands inside PyBullet: forces, and eyes on every time step."""

from collections.abc import Callable
from typing import Any

from numpy.typing import ArrayLike

from tpm_gym.simulation import Simulation


def nothing() -> None:
    """What happens by default."""


def around_each_step(
    simulation: Simulation,
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


def push(simulation: Simulation, force: ArrayLike) -> None:
    """Apply a force (N, machine's frame) at point P of the platform in the next time step."""
    engine: Any = simulation.engine
    at = engine.robot.links[simulation.machine.mechanism.platform]
    world = simulation.machine.mount.rotate(force).tolist()
    client = engine.client
    client.applyExternalForce(*at, world, engine.truth().position, client.WORLD_FRAME)
