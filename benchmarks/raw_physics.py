"""The engine's own work in an episode, recorded once and repeated without anything around it.

What a control step asks of the engine is taken down as calls of pybullet: a target for each motor
and one ``stepSimulation`` a time step, the constraint of the vacuum cup when it takes or lets go,
and the direction of the friction. Repeated on another environment from the same start, the same
calls do the same physics, which :func:`replay` checks; its time is the floor of ``env.step``. Two
floors:

* physics: the ``stepSimulation`` calls alone;
* with motors: these and the motor commands, which any controller in Python has to send as well.
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
CONTACT = ("createConstraint", "changeConstraint", "removeConstraint", "changeDynamics")

_SAME = 1e-12
"""Rad or m. Bullet repeats a puck at rest to 2e-18 m, not always to the last bit."""


@dataclass
class Call:
    """One call of the engine, less the number of the client."""

    name: str
    arguments: tuple[Any, ...]
    options: dict[str, Any]
    result: Any


@dataclass
class Tape:
    """What the engine was asked in a block of steps.

    Attributes:
        steps: The calls of each control step.
        resets: Indices of the steps after which the environment was reset.
        ends: Where each step left the motors and the object, to compare with.
    """

    steps: list[list[Call]] = field(default_factory=list)
    resets: set[int] = field(default_factory=set)
    ends: list[FloatArray] = field(default_factory=list)


@dataclass(frozen=True)
class Floor:
    """Seconds of a whole block: ``stepSimulation`` alone, and with the motor commands."""

    physics: float
    with_motors: float


class Recorder:
    """Functions of pybullet that take down how they are called.

    A client binds the engine's functions when it first uses them, so a client that was first used
    inside :func:`recording` must be used inside it only, and one to be timed must never be.
    """

    def __init__(self) -> None:
        """Start with nothing taken down."""
        self.calls: list[Call] = []

    def wrap(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, noting its calls."""

        def noting(*arguments: Any, **options: Any) -> Any:
            result = function(*arguments, **options)
            if name == MOTOR:
                arguments = arguments[:9]  # the tenth is the client's number
            kept = {key: value for key, value in options.items() if key != "physicsClientId"}
            self.calls.append(Call(name, arguments, kept, result))
            return result

        return noting

    def take(self) -> list[Call]:
        """What was called since the last time."""
        calls, self.calls = self.calls, []
        return calls


@contextmanager
def recording(recorder: Recorder) -> Iterator[None]:
    """Put the recorder's functions in the place of the engine's."""
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
    """Run the block of ``actions`` (n, k) from ``reset(seed=seed)``; inside :func:`recording`.

    Raises:
        RuntimeError: If a step asked nothing of the engine, so that there is nothing to repeat.
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
    """Repeat the engine's calls on an environment that was never recorded, timing them alone.

    Raises:
        RuntimeError: If a step ended elsewhere than when it was recorded: then the calls taken down
            are not all that the step does to the engine, and their time is no floor.
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
    """Calls the engine in the name of an environment's client."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        """Take the number of the client."""
        unwrapped: Any = env.unwrapped
        self._number = unwrapped.simulation.engine.client.number
        self._constraints: dict[int, int] = {}  # number when recorded -> number here

    def bind(self, call: Call) -> Callable[[], Any]:
        """The call, ready to be made on this client."""
        function = getattr(pybullet, call.name)
        if call.name in (STEP, MOTOR):  # in the cheapest way there is
            return partial(function, *call.arguments, self._number)
        return partial(function, *call.arguments, **call.options, physicsClientId=self._number)

    def touch(self, calls: Iterable[Call]) -> None:
        """Take, let go, and turn the friction as recorded."""
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
        """Leave the environment without a grasp that it does not know of."""
        for number in self._constraints.values():
            pybullet.removeConstraint(number, physicsClientId=self._number)
        self._constraints.clear()


def _where(env: gym.Env[Any, Any], fresh: bool = False) -> FloatArray:
    """Angles of the motors, P and the objects as last reported, or as the engine has them now."""
    unwrapped: Any = env.unwrapped
    state = unwrapped.simulation.read() if fresh else unwrapped.state
    return np.concatenate([state.theta, state.platform_position, *state.object_position])
