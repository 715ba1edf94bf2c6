"""Record of the calls of the engine in an episode, and their replay without anything else.

The calls of a control step are a target for each motor and one ``stepSimulation`` for each time
step, the constraint of the vacuum cup when it grasps or releases, direction and forces of friction.
Replayed on another environment from the same start, the same calls do the same physics, which
:func:`replay` checks. Their time is a floor of ``env.step``. There are two floors:

* physics: the ``stepSimulation`` calls alone;
* with motors: these and the motor commands, which any controller in Python has to send.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby
from typing import Any

import gymnasium as gym
import numpy as np
import pybullet
from numpy.typing import NDArray

from tpm_gym.arrays import FloatArray

__all__ = ["Floor", "Tape", "record", "recording", "replay"]

STEP = "stepSimulation"
MOTOR = "setJointMotorControl2"
PUSHES = ("applyExternalForce", "applyExternalTorque", "getLinkState")
"""Forces, and a call that updates the place of a link, from which Bullet computes their levers."""
CONTACT = ("createConstraint", "changeConstraint", "removeConstraint", "changeDynamics", *PUSHES)

_SAME = 1e-12
"""Tolerance, rad or m. Bullet replays a block at rest to 2e-18 m, not always to the last bit."""


@dataclass
class Call:
    """Call of the engine, without the number of the client."""

    name: str
    arguments: tuple[Any, ...]
    options: dict[str, Any]
    result: Any


@dataclass
class Tape:
    """Calls of the engine in a block of steps.

    Attributes:
        steps: Calls of each control step.
        resets: Indices of the steps after which the environment was reset.
        ends: Motors, P and objects after each step, to compare with.
    """

    steps: list[list[Call]] = field(default_factory=list)
    resets: set[int] = field(default_factory=set)
    ends: list[FloatArray] = field(default_factory=list)


@dataclass(frozen=True)
class Floor:
    """Seconds of a block: ``stepSimulation`` alone, and with the motor commands."""

    physics: float
    with_motors: float


class Recorder:
    """Wrappers of pybullet's functions that record their calls.

    A client binds the functions when it first uses them. So a client that was first used inside
    :func:`recording` must only be used there, and a client that is timed must never be.
    """

    def __init__(self) -> None:
        """Start without calls."""
        self.calls: list[Call] = []

    def wrap(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function with a record of its calls."""

        def noting(*arguments: Any, **options: Any) -> Any:
            result = function(*arguments, **options)
            if name == MOTOR:
                arguments = arguments[:9]  # the tenth is the client's number
            elif name in PUSHES and "physicsClientId" not in options:
                arguments = arguments[:-1]
            kept = {key: value for key, value in options.items() if key != "physicsClientId"}
            self.calls.append(Call(name, arguments, kept, result))
            return result

        return noting

    def take(self) -> list[Call]:
        """Return the calls since the last time."""
        calls, self.calls = self.calls, []
        return calls


@contextmanager
def recording(recorder: Recorder) -> Iterator[None]:
    """Replace the engine's functions by the recorder's."""
    real = {name: getattr(pybullet, name) for name in (STEP, MOTOR, *CONTACT)}
    for name, function in real.items():
        setattr(pybullet, name, recorder.wrap(name, function))
    try:
        yield
    finally:
        for name, function in real.items():
            setattr(pybullet, name, function)


def record(
    env: gym.Env[Any, Any], recorder: Recorder, actions: NDArray[np.float32], seed: int
) -> Tape:
    """Record a block of ``actions`` (n, k) after ``reset(seed=seed)``, inside :func:`recording`.

    Raises:
        RuntimeError: A step did not call the engine.
    """
    tape = Tape()
    env.reset(seed=seed)
    for index, action in enumerate(actions):
        recorder.take()
        _, _, terminated, truncated, _ = env.step(action)
        tape.steps.append(recorder.take())
        tape.ends.append(_where(env))
        if not any(call.name == STEP for call in tape.steps[-1]):
            raise RuntimeError("a step of the environment called no pybullet.stepSimulation")
        if terminated or truncated:
            env.reset()
            tape.resets.add(index)
    return tape


def replay(env: gym.Env[Any, Any], tape: Tape, seed: int) -> Floor:
    """Replay the calls on an environment that was never recorded, and time them alone.

    Raises:
        RuntimeError: A step ended elsewhere than in the record. Then calls are missing from the
            record, and its time is no floor.
    """
    player = _Player(env)
    env.reset(seed=seed)
    physics = with_motors = 0.0
    for index, calls in enumerate(tape.steps):
        for of_contact, group in groupby(calls, key=lambda call: call.name in CONTACT):
            if of_contact:
                player.touch(group)
                continue
            bound = [(player.bind(call), call.name == STEP) for call in group]
            begun = time.perf_counter()
            for function, is_step in bound:
                if is_step:
                    started = time.perf_counter()
                    function()
                    physics += time.perf_counter() - started
                else:
                    function()
            with_motors += time.perf_counter() - begun
        ends = _where(env, fresh=True), tape.ends[index]
        if not np.allclose(*ends, rtol=0.0, atol=_SAME, equal_nan=True):
            raise RuntimeError(
                f"the repeated physics differ from the recorded ones at step {index}"
            )
        if index in tape.resets:
            player.let_go()
            env.reset()
    player.let_go()
    return Floor(physics, with_motors)


class _Player:
    """Calls of the engine for the client of an environment."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        """Find the number of the client."""
        unwrapped: Any = env.unwrapped
        self._number = unwrapped.simulation.engine.client.number
        self._constraints: dict[int, int] = {}  # number when recorded -> number here

    def bind(self, call: Call) -> Callable[[], Any]:
        """Return the call as a function without arguments."""
        function = getattr(pybullet, call.name)
        if call.name in (STEP, MOTOR):  # in the cheapest way there is
            return partial(function, *call.arguments, self._number)
        return partial(function, *call.arguments, **call.options, physicsClientId=self._number)

    def touch(self, calls: Iterable[Call]) -> None:
        """Grasp, release, and turn the friction as recorded."""
        for call in calls:
            if call.name == "createConstraint":
                self._constraints[call.result] = self.bind(call)()
            elif call.name in ("changeConstraint", "removeConstraint"):
                recorded, *others = call.arguments
                if call.name == "removeConstraint":
                    number = self._constraints.pop(recorded)
                else:
                    number = self._constraints[recorded]
                self.bind(Call(call.name, (number, *others), call.options, None))()
            else:
                self.bind(call)()

    def let_go(self) -> None:
        """Remove all grasps, because the environment does not know them."""
        for number in self._constraints.values():
            pybullet.removeConstraint(number, physicsClientId=self._number)
        self._constraints.clear()


def _where(env: gym.Env[Any, Any], fresh: bool = False) -> FloatArray:
    """Return angles of the motors, P and objects as last reported, or as they are now."""
    unwrapped: Any = env.unwrapped
    if fresh:
        now = unwrapped.simulation.engine.read()
        return np.concatenate([now.theta[0], now.position[0], *now.object_position[0]])
    state = unwrapped.state
    return np.concatenate([state.theta, state.platform_position, *state.object_position])
