"""Replay of the same actions in each engine: loops, platform, torques, block, energy, theory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import tpm_gym  # noqa: F401  (registers the environments)
from tpm_gym.arrays import FloatArray
from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.simulation.engine import spline_weights
from tpm_gym.simulation.randomisation import Plant
from tpm_gym.simulation.settings import count_steps
from tpm_gym.simulation.simulation import Simulation
from tpm_gym.simulation.state import Scene
from tpm_gym.tasks import Expert
from tpm_gym.tasks.motion import hanging

REACH, PICK = "TPMReach-v0", "TPMPickAndPlace-v0"
SEED = 3_000_000
"""Seed of the first episode; no training, selection or test uses it."""
STEPS = 50
FALL = 4
"""Control periods of a fall with the motors off."""


@dataclass(frozen=True)
class Motion:
    """Actions for all engines.

    Attributes:
        name: Name in the table.
        env_id: Environment.
        actions: An array (steps, action size) for each episode; episode i is reset with SEED + i.
        free: Whether nothing is touched, so that theory has the torques.
    """

    name: str
    env_id: str
    actions: tuple[NDArray[Any], ...]
    free: bool


@dataclass(frozen=True)
class Trace:
    """Results of a motion, a row for each control step of all episodes.

    Attributes:
        gap: (n,) m, largest loop gap.
        apart: (n,) m, distance of the platform from the forward kinematics of the encoders.
        torque: (n, 3) N m, in the last time step.
        theory: (n, 3) N m, from closed-form dynamics at the references of this time step; empty if
            the motion is not free.
        block: (episodes, 3) m, final position of the block; empty without a block.
    """

    gap: FloatArray
    apart: FloatArray
    torque: FloatArray
    theory: FloatArray
    block: FloatArray


def motions(episodes: int) -> list[Motion]:
    """Return the five motions: three with nothing to touch, and two with the block."""
    return [
        Motion("expert, reaching", REACH, _recorded(REACH, episodes, _expert), free=True),
        Motion("random", REACH, _drawn(episodes, hold=1), free=True),
        Motion("fast", REACH, _drawn(episodes, hold=8), free=True),
        Motion("expert, with the block", PICK, _recorded(PICK, episodes, _expert), free=False),
        Motion("pressing", PICK, _recorded(PICK, episodes, _press), free=False),
    ]


def _drawn(episodes: int, hold: int) -> tuple[NDArray[Any], ...]:
    """Sample uniform actions, or actions at full speed that are held for some steps."""
    rng = np.random.default_rng(SEED + hold)
    drawn = rng.uniform(-1.0, 1.0, (episodes, -(-STEPS // hold), 3))
    if hold > 1:
        drawn = np.sign(drawn)
    return tuple(np.repeat(drawn, hold, axis=1)[:, :STEPS])


Actions = Callable[[Any, dict[str, Any]], Iterator[NDArray[Any]]]


def _recorded(env_id: str, episodes: int, actions: Actions) -> tuple[NDArray[Any], ...]:
    """Record ``actions`` in PyBullet."""
    recorded = []
    with closing(gym.make(env_id)) as env:
        for episode in range(episodes):
            observation, _ = env.reset(seed=SEED + episode)
            rows = []
            for _, action in zip(range(STEPS), actions(env, observation), strict=False):
                rows.append(action)
                observation.update(env.step(action)[0])
            recorded.append(np.array(rows))
    return tuple(recorded)


def _expert(env: Any, observation: dict[str, Any]) -> Iterator[NDArray[Any]]:
    expert = Expert(env)
    expert.reset(observation)
    while True:
        yield expert.act(observation)


def _press(env: Any, observation: dict[str, Any]) -> Iterator[NDArray[Any]]:
    """Yield actions that press the block with the spring of the cup and push it, without vacuum."""
    inner = env.unwrapped
    to_paper, block = inner.machine.mount.to_paper, inner.task.scene.objects[0]
    top = inner.state.object_position[0] + hanging(block)
    for offset in ((0, 0, 0.03), (0, 0, -0.004), (0.06, 0, -0.004), (0.06, 0.01, -0.004)):
        wanted = inner.machine.region.project(to_paper(top + offset))
        for _ in range(12):
            current = to_paper(inner.state.command)
            yield np.array([*inner.control.action(wanted, current), -1.0])


def follow(motion: Motion, engine: str, drive: str = "ideal") -> Trace:
    """Replay a motion in an engine."""
    rows: list[tuple[FloatArray, ...]] = []
    theory: list[FloatArray] = []
    blocks: list[FloatArray] = []
    with closing(gym.make(motion.env_id, engine=engine, drive=drive)) as env:
        inner: Any = env.unwrapped
        for episode, actions in enumerate(motion.actions):
            env.reset(seed=SEED + episode)
            commands = [inner.state.command] * 2
            for action in actions:
                env.step(action)
                state = inner.state
                commands = [*commands[-2:], state.command]
                apart = np.linalg.norm(state.fk_position - state.platform_position)
                rows.append((state.closure_error, apart, *state.torque))
                if motion.free:
                    theory.append(torque_by_theory(inner, np.array(commands)))
            blocks.extend(inner.state.object_position)
    table = np.array(rows)
    return Trace(table[:, 0], table[:, 1], table[:, 2:], np.array(theory), np.array(blocks))


def torque_by_theory(inner: Any, commands: FloatArray) -> FloatArray:
    """Compute torques (3,) N m in the last time step of a control period by closed-form dynamics.

    Velocities are backward differences of the references, as in the engines.

    Args:
        inner: The environment.
        commands: The last three commands (3, 3) m, world.
    """
    step, machine = inner.simulation.engine.time_step, inner.machine
    weights = spline_weights(count_steps(inner.task.control_period, step))
    points = weights[-3:] @ machine.mount.to_paper(commands)
    before, at, after = machine.inverse(points)
    rate, next_rate = (at - before) / step, (after - at) / step
    torque: FloatArray = machine.dynamics.torque(at, rate, (next_rate - rate) / step)
    return torque


def energy_lost(engine: str) -> float:
    """Measure the share of the potential energy that is lost in a fall with the motors off."""
    machine = PAPER_TPM
    simulation = Simulation(Scene(), machine=machine, engine=engine)
    try:
        theta = machine.inverse(machine.home)
        plant = Plant(motor_strength=(0.0, 0.0, 0.0))
        start = machine.dynamics.energy(theta, np.zeros(3))
        simulation.reset(np.array([0]), theta, plants=[plant])
        for _ in range(FALL):
            simulation.move(np.array([machine.home]), np.array([False]))
        state = simulation.state().take(0)
    finally:
        simulation.close()
    end = machine.dynamics.energy(state.theta, state.theta_dot)
    return float((start.potential - sum(end)) / (start.potential - end.potential))
