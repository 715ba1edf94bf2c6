"""Vector environment of the analytic engine for Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from tpm_gym.envs.core import EnvSnapshot
from tpm_gym.envs.vector import TPMVectorEnv
from tpm_gym.errors import ConfigurationError
from tpm_gym.learning.checkpoint import starting
from tpm_gym.learning.rollout import Observation
from tpm_gym.simulation.randomisation import NOMINAL, Plant
from tpm_gym.simulation.simulation import Snapshot

_ENVS, _SIMULATION, _ENGINE = "envs/", "simulation/", "engine/"  # prefixes of arrays in a state


class AnalyticVecEnv(VecEnv):
    """Adapter of a :class:`~tpm_gym.envs.vector.TPMVectorEnv` to Stable-Baselines3.

    At the end of an episode, its info holds ``terminal_observation``, ``TimeLimit.truncated``,
    ``is_success`` and ``episode``, which the algorithms read. At other steps infos are empty.

    Args:
        envs: Environments with same-step autoreset: ``gym.make_vec(id, num_envs=256,
            engine="analytic", autoreset_mode="SameStep", stagger=True)``.

    Raises:
        ConfigurationError: ``envs`` is no ``TPMVectorEnv``, or has no same-step autoreset.
    """

    def __init__(self, envs: TPMVectorEnv) -> None:
        """Wrap the environments."""
        ours = isinstance(getattr(envs, "unwrapped", None), TPMVectorEnv)
        if not ours or envs.autoreset_mode != AutoresetMode.SAME_STEP:
            valid = "gym.make_vec(id, num_envs=..., engine='analytic', autoreset_mode='SameStep')"
            raise ConfigurationError("envs", envs, valid)
        self.envs = envs
        self._actions: NDArray[Any] = np.zeros(0)
        self._returns = np.zeros(envs.num_envs)
        self._lengths = np.zeros(envs.num_envs, dtype=np.int64)
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Observation:
        """Start an episode in all environments, with the seeds and options that are set."""
        seeds = None if self._seeds[0] is None else self._seeds
        observation: Observation = {}
        own = np.array([bool(options) for options in self._options])
        for row in np.flatnonzero(own).tolist():
            options = {**self._options[row], "reset_mask": np.arange(self.num_envs) == row}
            observation, _ = self.envs.reset(seed=seeds, options=options)
        if not own.all():
            others = {"reset_mask": ~own} if own.any() else None
            observation, _ = self.envs.reset(seed=seeds, options=others)
        self._reset_seeds()
        self._reset_options()
        self._returns[:], self._lengths[:] = 0.0, 0
        return observation

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Run a control period."""
        observation, rewards, _, dones, told = self.envs.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        infos: list[dict[str, Any]] = [{}] * self.num_envs
        ended = np.flatnonzero(dones)
        for row in ended.tolist():
            infos[row] = {
                "terminal_observation": told["final_obs"][row],
                "TimeLimit.truncated": True,
                "is_success": bool(told["final_info"]["is_success"][row]),
                "episode": {"r": float(self._returns[row]), "l": int(self._lengths[row])},
            }
        self._returns[ended], self._lengths[ended] = 0.0, 0
        return observation, rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the vector environment, once for each index."""
        return [getattr(self.envs, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the vector environment."""
        setattr(self.envs, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        """Call a method of the vector environment, once for each index."""
        method = getattr(self.envs, method_name)
        return [method(*args, **kwargs) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return False for each index, since no environment has a wrapper of its own."""
        return [False for _ in self._get_indices(indices)]

    # -- checkpoints ----------------------------------------------------------------------------

    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return everything that the next steps depend on, as plain data and arrays by name."""
        (snapshot,) = self.envs.save_state()
        simulation = snapshot.simulation
        plants = simulation.plants if any(plant != NOMINAL for plant in simulation.plants) else ()
        arrays: dict[str, NDArray[Any]] = {"returns": self._returns, "lengths": self._lengths}
        columns = {_ENVS: snapshot.columns, _SIMULATION: simulation.columns}
        for prefix, group in {**columns, _ENGINE: simulation.engine}.items():
            arrays |= {f"{prefix}{name}": values for name, values in group.items()}
        return {"rngs": snapshot.rngs, "plants": [asdict(plant) for plant in plants]}, arrays

    def restore(self, plain: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Observation:
        """Restore what :meth:`state` returned; return the observation at that moment."""
        plants = tuple(map(_plant, plain["plants"])) or (NOMINAL,) * self.num_envs
        envs, simulation, engine = (starting(arrays, p) for p in (_ENVS, _SIMULATION, _ENGINE))
        self._returns, self._lengths = arrays["returns"].copy(), arrays["lengths"].copy()
        moment = Snapshot(plants, simulation, engine)
        return self.envs.restore_state([EnvSnapshot(self.envs.kind, moment, plain["rngs"], envs)])


def _plant(entries: dict[str, Any]) -> Plant:
    """Build a plant from JSON, which has lists in place of tuples."""
    tuples: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in entries.items()}
    return Plant(**tuples)
