"""What an engine is asked to do, and the engines by name.

An engine knows a machine, a scene and a drive; never a goal, a reward or gymnasium. What is the
same for all of them (references, encoders' errors, modes, the State) is in
:mod:`tpm_gym.simulation.simulation`.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import Quaternion, Vector, is_whole
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.drives import Reference, Servo
from tpm_gym.simulation.randomisation import Plant
from tpm_gym.simulation.state import Scene
from tpm_gym.simulation.vacuum import Hold

__all__ = [
    "Engine",
    "Hold",
    "Motors",
    "Pose",
    "Reference",
    "Truth",
    "Twist",
    "make_engine",
    "register_engine",
    "require_engine",
]

UPRIGHT: Quaternion = (0.0, 0.0, 0.0, 1.0)
SPRING_GAIN = 0.2
"""Share of its way back that the cup's spring takes in one time step."""


class Pose(NamedTuple):
    """Position (m) and orientation (x, y, z, w)."""

    position: Vector
    quaternion: Quaternion = UPRIGHT


class Twist(NamedTuple):
    """Velocity (m/s) and angular velocity (rad/s)."""

    velocity: Vector = (0.0, 0.0, 0.0)
    angular_velocity: Vector = (0.0, 0.0, 0.0)


class Motors(NamedTuple):
    """True positions (rad, m for a slide) and rates of the motors, and what they last applied."""

    theta: Vector
    theta_dot: Vector
    torque: Vector


class Truth(NamedTuple):
    """What a real robot does not know: largest loop gap (m), point P (m, world), tilt (rad)."""

    gap: float
    position: Vector
    tilt: float


class Engine(Protocol):
    """One machine over one table. World frame, SI units, plain floats.

    ``load`` comes first, then ``place``; what an engine cannot do it refuses with a
    :class:`~tpm_gym.errors.ConfigurationError` that names it.

    Attributes:
        substeps: Time steps in a control period.
    """

    substeps: int

    def load(self, machine: Machine, scene: Scene) -> None:
        """Hold this machine and scene, and nothing else; loops closed, nothing altered."""

    def alter(self, plant: Plant) -> None:
        """Make the machine that of ``plant``, but for its lengths, which ``load`` has seen to."""

    def place(self, joints: Mapping[str, float], objects: Sequence[Pose]) -> None:
        """Let go, then put all joints (rad, m) and objects where they are wanted, at rest."""

    def show_goal(self, markers: Sequence[Vector]) -> None:
        """Move the goal markers."""

    def advance(self, references: Sequence[Reference], vacuum: bool) -> None:
        """Run a control period: drive the motors to one reference in each time step."""

    def motors(self) -> Motors:
        """Read the motors."""

    def truth(self) -> Truth:
        """Read what only a simulation knows."""

    def objects(self) -> list[tuple[Pose, Twist]]:
        """Read the scene's objects, in its order."""

    def hold(self) -> Hold:
        """What the cup holds, and how well; by :mod:`tpm_gym.simulation.vacuum` each time step."""

    def save(self) -> Any:
        """Take down everything that the next steps depend on, as plain data, all in its repr.

        What an engine cannot read out (old contacts' impulses) is not part of it, and ``restore``
        drops it.
        """

    def restore(self, snapshot: Any) -> None:
        """Go back to what ``save`` returned, for the same machine and scene, altered alike."""

    def picture(self, width: int, height: int) -> NDArray[np.uint8]:
        """Draw the scene as (height, width, 3) RGB."""

    def close(self) -> None:
        """Give everything back; harmless the second time."""


Factory = Callable[..., Engine]


_ENGINES: dict[str, str | Factory] = {
    "pybullet": "tpm_gym.simulation.bullet.engine:BulletEngine",
    "mujoco": "tpm_gym.simulation.mujoco.engine:MujocoEngine",
}
SIMULATIONS = {"analytic": "tpm_gym.simulation.analytic.single:SingleSimulation"}
"""Engines that are a simulation of their own, of many robots at a time."""


def register_engine(name: str, engine: str | Factory) -> None:
    """Let environments be made with ``engine=name``.

    Args:
        name: The name.
        engine: What makes the engine, from those of the keywords ``gui`` (to open a window),
            ``renderer`` (other than its own), ``physics`` (its numerical settings) and ``drive`` (a
            :class:`~tpm_gym.simulation.drives.Servo` on each motor, instead of ideal drives) that
            it can serve; or ``"module:attribute"`` of that, imported when first asked for.

    Raises:
        ConfigurationError: If the name is none, or taken by another engine, or that is no engine.
    """
    if not isinstance(name, str) or not name:
        raise ConfigurationError("name", name, "a name")
    if not (isinstance(engine, str) and ":" in engine) and not callable(engine):
        raise ConfigurationError("engine", engine, "what makes an engine, or 'module:attribute'")
    if _path(_ENGINES.get(name, engine)) != _path(engine):
        raise ConfigurationError("engine", name, f"a name other than {', '.join(_ENGINES)}")
    _ENGINES[name] = engine


def _path(engine: str | Factory) -> str:
    """Where it is defined: there the same one may be registered as itself."""
    if isinstance(engine, str):
        return engine
    return f"{engine.__module__}:{getattr(engine, '__qualname__', engine)}"


def require_engine(name: Any, among: Collection[str] = ()) -> None:
    """Refuse what is no engine's name.

    Raises:
        ConfigurationError: If there is none of that name, or it is not ``among`` those.
    """
    known = (*_ENGINES, *SIMULATIONS)
    if not isinstance(name, str) or name not in (among or known):
        raise ConfigurationError("engine", name, ", ".join(map(repr, known)))


def make_engine(
    name: str,
    *,
    gui: bool = False,
    renderer: str | None = None,
    physics: Any = None,
    drive: Servo | None = None,
) -> Engine:
    """The engine of that name.

    Raises:
        ConfigurationError: If there is none, or it cannot do what is asked for.
    """
    require_engine(name, _ENGINES)
    factory = _ENGINES[name]
    if isinstance(factory, str):
        module, _, attribute = factory.partition(":")
        try:
            factory = getattr(importlib.import_module(module), attribute)
        except (ModuleNotFoundError, AttributeError) as error:
            valid = f"one that can be imported; of {factory!r} Python says: {error}"
            raise ConfigurationError("engine", name, valid) from error
    options: dict[str, Any] = {
        "gui": gui or None,
        "renderer": renderer,
        "physics": physics,
        "drive": drive,
    }
    asked = {option: value for option, value in options.items() if value is not None}
    known = inspect.signature(factory).parameters
    if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in known.values()):
        for option in asked.keys() - known.keys():
            valid = f"left out: the engine {name!r} has no such option"
            raise ConfigurationError(option, asked[option], valid)
    engine: Engine = factory(**asked)
    if lacking := [part for part in _PARTS if not _has(engine, part)]:
        raise ConfigurationError("engine", name, f"an engine that has {', '.join(lacking)}")
    if not is_whole(engine.substeps, 1):
        raise ConfigurationError("engine", name, "an engine whose substeps are 1 or more")
    return engine


_PARTS = [name for name in (*Engine.__annotations__, *vars(Engine)) if not name.startswith("_")]


def _has(engine: Engine, part: str) -> bool:
    """Whether it has that part of the protocol, and of its own: the protocol's do nothing."""
    own = getattr(engine, part, None)
    return own is not None and getattr(own, "__func__", None) is not vars(Engine).get(part, own)
