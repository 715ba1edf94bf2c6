"""The same actions in every engine: loops, platform, torques, puck, energy, beside theory."""

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
from tpm_gym.simulation.randomisation import Plant
from tpm_gym.simulation.simulation import Simulation, spline_weights
from tpm_gym.simulation.state import CONTROL_PERIOD, Scene
from tpm_gym.tasks import Expert
from tpm_gym.tasks.motion import hanging

REACH, PICK = "TPMReach-v0", "TPMPickAndPlace-v0"
SEED = 3_000_000
"""Of the first episode: neither trained, nor selected, nor tested on."""
STEPS = 50
FALL = 4
"""Control periods for which the mechanism falls with its motors off."""


@dataclass(frozen=True)
class Motion:
    """Actions to be repeated in every engine.

    Attributes:
        name: What it is called in the table.
        env_id: Where.
        actions: An array (steps, action size) an episode; episode i is reset with SEED + i.
        free: Whether nothing is touched, so that theory knows the torques.
    """

    name: str
    env_id: str
    actions: tuple[NDArray[Any], ...]
    free: bool


@dataclass(frozen=True)
class Trace:
    """What came of a motion; one row for each control step, of all episodes in turn.

    Attributes:
        gap: (n,) m, the largest loop gap.
        apart: (n,) m, platform against forward kinematics of the encoders.
        torque: (n, 3) N m, in the last time step.
        theory: (n, 3) N m, closed form at the references of that time step; empty if not free.
        puck: (episodes, 3) m, where the puck ended; empty without one.
    """

    gap: FloatArray
    apart: FloatArray
    torque: FloatArray
    theory: FloatArray
    puck: FloatArray


def motions(episodes: int) -> list[Motion]:
    """Expert, random and fast with free hands; expert and pressing with the puck."""
    return [
        Motion("expert, reaching", REACH, _recorded(REACH, episodes, _expert), free=True),
        Motion("random", REACH, _drawn(episodes, hold=1), free=True),
        Motion("fast", REACH, _drawn(episodes, hold=8), free=True),
        Motion("expert, with the puck", PICK, _recorded(PICK, episodes, _expert), free=False),
        Motion("pressing", PICK, _recorded(PICK, episodes, _press), free=False),
    ]


def _drawn(episodes: int, hold: int) -> tuple[NDArray[Any], ...]:
    """Uniform actions; those that are held for some steps are at full speed, one way or other."""
    rng = np.random.default_rng(SEED + hold)
    drawn = rng.uniform(-1.0, 1.0, (episodes, -(-STEPS // hold), 3))
    if hold > 1:
        drawn = np.sign(drawn)
    return tuple(np.repeat(drawn, hold, axis=1)[:, :STEPS])


Actions = Callable[[Any, dict[str, Any]], Iterator[NDArray[Any]]]


def _recorded(env_id: str, episodes: int, actions: Actions) -> tuple[NDArray[Any], ...]:
    """What ``actions`` does in PyBullet, to be repeated blindly."""
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
    """Come down on the puck, press it with the cup's spring, and push it along, without vacuum."""
    inner = env.unwrapped
    to_paper, block = inner.machine.mount.to_paper, inner.task.scene.objects[0]
    top = inner.state.object_position[0] + hanging(block)
    for offset in ((0, 0, 0.03), (0, 0, -0.004), (0.06, 0, -0.004), (0.06, 0.01, -0.004)):
        wanted = inner.machine.region.project(to_paper(top + offset))
        for _ in range(12):
            current = to_paper(inner.state.command)
            yield np.array([*inner.control.action(wanted, current), -1.0])


def follow(motion: Motion, engine: str, drive: str = "ideal") -> Trace:
    """Repeat a motion in an engine."""
    rows: list[tuple[FloatArray, ...]] = []
    theory: list[FloatArray] = []
    pucks: list[FloatArray] = []
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
            pucks.extend(inner.state.object_position)
    table = np.array(rows)
    return Trace(table[:, 0], table[:, 1], table[:, 2:], np.array(theory), np.array(pucks))


def torque_by_theory(inner: Any, commands: FloatArray) -> FloatArray:
    """Torques (3,) N m that the closed form asks for in the last time step of a control period.

    Velocities are backward differences of the references, as the engines have them.

    Args:
        inner: The environment.
        commands: The last three (3, 3) m, world.
    """
    substeps = inner.simulation.engine.substeps
    step, machine = CONTROL_PERIOD / substeps, inner.machine
    points = spline_weights(substeps)[-3:] @ machine.mount.to_paper(commands)
    before, at, after = (np.array(machine.inverse(tuple(point))) for point in points.tolist())
    rate, next_rate = (at - before) / step, (after - at) / step
    torque: FloatArray = machine.dynamics.torque(at, rate, (next_rate - rate) / step)
    return torque


def energy_lost(engine: str) -> float:
    """Share of the released potential energy that is missing after a fall with the motors off."""
    machine = PAPER_TPM
    simulation = Simulation(Scene(), machine=machine, engine=engine)
    try:
        theta = machine.inverse(machine.home)
        plant = Plant(motor_strength=(0.0, 0.0, 0.0))
        start = machine.dynamics.energy(np.array(theta), np.zeros(3))
        simulation.reset(theta, plant=plant)
        for _ in range(FALL):
            state = simulation.move(machine.home)
    finally:
        simulation.close()
    end = machine.dynamics.energy(state.theta, state.theta_dot)
    return float((start.potential - sum(end)) / (start.potential - end.potential))
