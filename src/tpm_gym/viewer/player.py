"""Episodes of any task, engine and policy, one step at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, Final

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import tpm_gym
from tpm_gym.envs.ids import env_ids
from tpm_gym.envs.single import TPMEnv
from tpm_gym.errors import ConfigurationError, EpisodeError
from tpm_gym.mechanism.machine import Machine
from tpm_gym.policy.files import published
from tpm_gym.simulation.engine import engine_names
from tpm_gym.simulation.state import State
from tpm_gym.tasks.expert import Expert

SCRIPTED: Final = ("expert", "random")
_PACKAGES: Final = {"pybullet": "pybullet", "mujoco": "mujoco"}


def installed_engines() -> tuple[str, ...]:
    """Return the names of the engines whose packages are installed, the analytic one first."""
    there = [name for name in engine_names() if find_spec(_PACKAGES.get(name, "tpm_gym"))]
    return tuple(sorted(there, key=lambda name: name != "analytic"))


def policies_for(env_id: str) -> tuple[str, ...]:
    """Return ``expert``, ``random`` and the published policies for an environment's task.

    Raises:
        ConfigurationError: If there is no such environment.
    """
    _require_id(env_id)
    kwargs = gym.spec(env_id).kwargs

    def fits(other: str) -> bool:
        own = gym.spec(other).kwargs
        return all(own.get(key) == kwargs.get(key) for key in ("task", "control"))

    return (*SCRIPTED, *filter(fits, published()))


def _require_id(env_id: str) -> None:
    """Raise if an id is not one of this package.

    A page can send ``module:id``, and Gymnasium would import the module.
    """
    if env_id not in env_ids():
        raise ConfigurationError("env", env_id, ", ".join(env_ids()))


@dataclass(frozen=True)
class Record:
    """Outcome of one control step.

    Attributes:
        reward_terms: Weighted terms of the reward by name; their sum is the reward.
        torque: (3,) N m, torques of the motors at the end of the step.
        success: Whether the goal is achieved.
    """

    reward_terms: dict[str, float]
    torque: NDArray[np.float64]
    success: bool


class Player:
    """An environment and a policy that acts in it.

    Args:
        policy: ``expert``, ``random``, the id of a published policy, or the path of an exported
            one.

    Attributes:
        task: The environment's task.
        records: Records of the steps of the episode so far.
        ended: Whether the episode has ended, or none has begun.

    Raises:
        ConfigurationError: If an option is not possible.
        PolicyFileError: If there is no such policy.
        PolicyMismatchError: If the policy does not fit the environment.
        MissingPackageError: If a package of the engine or of the policy is not installed.
    """

    def __init__(self, env_id: str, engine: str, machine: Machine, policy: str) -> None:
        """Make the environment and load the policy."""
        _require_id(env_id)
        self._env = gym.make(env_id, engine=engine, machine=machine, disable_env_checker=True)
        assert isinstance(self._env.unwrapped, TPMEnv)
        self._inner = self._env.unwrapped
        self.task = self._inner.task
        try:
            self._act = self._load(policy)
        except BaseException:
            self._env.close()
            raise
        self.records: list[Record] = []
        self.ended = True
        self._observation: Any = None
        self._rng = np.random.default_rng()

    def _load(self, policy: str) -> Callable[[Any], Any]:
        """Return a function from an observation to the action."""
        if policy == "random":
            return self._draw
        if policy == "expert":
            return Expert(self._env).act
        loaded = tpm_gym.load_policy(policy)
        loaded.check(self._env)
        return loaded.act

    def _draw(self, observation: Any) -> Any:
        """Return a uniform action; the draws of an episode depend on its seed alone."""
        space: Any = self._env.action_space
        return self._rng.uniform(space.low, space.high).astype(space.dtype)

    @property
    def state(self) -> State:
        """State of the robot, without a leading axis."""
        return self._inner.state

    @property
    def markers(self) -> NDArray[np.float64]:
        """Points (k, 3) m, world, that show the goal."""
        return self.task.markers(self._inner.goal)

    @property
    def length(self) -> int:
        """Number of steps of a full episode."""
        spec = self._env.spec
        return spec.max_episode_steps if spec and spec.max_episode_steps else 0

    def reset(self, seed: int) -> None:
        """Begin the episode of a seed."""
        self._observation, _ = self._env.reset(seed=seed)
        self._rng = np.random.default_rng([seed, 1])  # the environment's own is default_rng(seed)
        self.records, self.ended = [], False

    def step(self) -> Record:
        """Run one control step with the policy's action.

        Raises:
            EpisodeError: If the episode has ended, or none has begun.
        """
        if self.ended:
            raise EpisodeError("the episode has ended; call reset() first")
        action = self._act(self._observation)
        self._observation, _, terminated, truncated, info = self._env.step(action)
        self.ended = bool(terminated or truncated)
        record = Record(info["reward_terms"], self.state.torque, bool(info["is_success"]))
        self.records.append(record)
        return record

    def close(self) -> None:
        """Close the environment."""
        self._env.close()
        self.ended = True
