"""Trained policies, loaded from safetensors and JSON and run by NumPy."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import FloatArray, numbers
from tpm_gym.errors import ConfigurationError, InputError, PolicyMismatchError
from tpm_gym.policy.files import Description, files, published, read_description, read_weights
from tpm_gym.resources import POLICIES

_BLOCK = 8
"""Rows of a batch that are multiplied at once.

OpenBLAS uses no threads for so few rows. So an observation gives the same action, bit for bit,
alone or in a batch, and threads do not slow each other down on a busy computer.
"""


def load_policy(path: str | Path) -> Policy:
    """Load an exported policy. Nothing in its files is executed or unpickled.

    Args:
        path: ``NAME.json``, ``NAME.safetensors`` or ``NAME``; the JSON file and the file of weights
            must both exist. If neither exists, ``path`` may be the id of an environment with a
            published policy, such as ``"TPMPickAndPlace-v0"``.

    Raises:
        InputError: ``path`` is empty, or is neither a str nor a Path.
        PolicyFileError: A file is missing or does not belong to a policy, or ``path`` is an archive
            of Stable-Baselines3, which only unpickling could read.
        MissingPackageError: safetensors or pydantic is not installed.
    """
    pair = files(path)
    if path in published() and not any(map(os.path.exists, pair)):
        pair = files(POLICIES / path)
    description = read_description(pair[0])
    return Policy(description, read_weights(pair[1], description))


class Policy:
    """Mean action of a trained policy.

    Args:
        weights: Arrays by name, of the shapes in ``description.shapes``.

    Attributes:
        description: Environment, algorithm, recipe, spaces, versions and network.
    """

    def __init__(
        self, description: Description, weights: Mapping[str, NDArray[np.float32]]
    ) -> None:
        """Build the network."""
        self.description = description
        # In double precision, so that an action hardly depends on the size of its batch.
        values = {name: array.astype(np.float64) for name, array in weights.items()}
        self._layers = [
            (values[f"layers.{i}.weight"].T, values[f"layers.{i}.bias"])
            for i in range(len(description.network.hidden) + 1)
        ]

    def act(self, observation: Mapping[str, Any]) -> NDArray[Any]:
        """Return the action for an observation, or the actions for a batch of observations.

        Args:
            observation: Arrays of the shapes of the observation space, or all with one more axis
                in front for a batch of n.

        Returns:
            The action, in the shape, dtype and bounds of the action space; (n, ...) for a batch.

        Raises:
            InputError: An entry is missing, unknown, of the wrong shape, or not finite, or the
                network overflows.
        """
        x, batched = self._features(observation)
        network, space = self.description.network, self.description.action_space
        count, size = x.shape
        x = np.concatenate([x, np.zeros((-count % _BLOCK, size))])
        x = x.reshape(len(x) // _BLOCK, _BLOCK, size)
        *hidden, (weight, bias) = self._layers
        with np.errstate(over="ignore", invalid="ignore"):
            for own_weight, own_bias in hidden:
                x = x @ own_weight + own_bias
                x = np.tanh(x) if network.activation == "tanh" else np.maximum(x, 0.0)
            x = (x @ weight + bias).reshape(-1, *space.shape)[:count]
        if np.isnan(x).any():
            valid = "entries or weights with which the network stays finite"
            raise InputError("observation", "an overflow", valid)
        if network.output == "tanh":
            x = space.low + 0.5 * (np.tanh(x) + 1.0) * (space.high - space.low)
        actions = np.clip(x, space.low, space.high).astype(space.dtype)
        return actions if batched else np.asarray(actions[0])

    def predict(
        self,
        observation: Mapping[str, Any],
        state: None = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], None]:
        """Return the action of :meth:`act`, and no state, as Stable-Baselines3 does."""
        if not deterministic:
            valid = "True; an exported policy has no random actions"
            raise ConfigurationError("deterministic", deterministic, valid)
        return self.act(observation), None

    def check(self, env: Any) -> None:
        """Check that the policy fits an environment.

        The spaces are compared. For an environment of tpm_gym, the option ``control`` is compared
        too, since Cartesian and joint increments have equal spaces. The machine may differ.

        Args:
            env: Environment of Gymnasium, wrapped or not, or vector environment of Gymnasium or of
                Stable-Baselines3.

        Raises:
            PolicyMismatchError: The environment has other observations or actions.
            InputError: ``env`` is no environment.
        """
        wanted = self.description
        if not hasattr(env, "observation_space") or not hasattr(env, "action_space"):
            raise InputError("env", env, f"an environment, such as gym.make({wanted.env_id!r})")
        for kind in ("observation_space", "action_space"):
            trained, given = getattr(wanted, kind), getattr(env, f"single_{kind}", None)
            given = getattr(env, kind) if given is None else given
            if trained != given:
                raise PolicyMismatchError(kind.replace("_", " "), trained, given, wanted.env_id)
        spec = gym.registry.get(wanted.env_id)
        own, found = spec.kwargs.get("control") if spec else None, _control(env)
        if own and found and own != found:
            raise PolicyMismatchError("control", own, found, wanted.env_id)

    def __repr__(self) -> str:
        """Return environment, algorithm and seed of the policy."""
        about = self.description
        return f"<Policy of {about.env_id}, {about.algorithm}, seed {about.seed}>"

    def _features(self, observation: Mapping[str, Any]) -> tuple[FloatArray, bool]:
        """Return the input (n, size) of the first layer, and whether the observation is a batch."""
        boxes, features = self.description.observation_space, self.description.network.features
        given = list(observation) if isinstance(observation, Mapping) else type(observation)
        if not isinstance(given, list) or set(given) != set(boxes):
            raise InputError("observation", given, f"a mapping with the keys {', '.join(boxes)}")
        found = {
            name: _rows(name, observation[name], box.shape or ()) for name, box in boxes.items()
        }
        entries = {name: rows for name, (rows, _) in found.items()}
        batches = {batch for _, batch in found.values()}
        if len(batches) > 1:
            raise InputError("observation", sorted(batches), "of one batch size in all entries")
        if features.kind == "goal_gap":
            gap = entries["desired_goal"] - entries["achieved_goal"]
            parts = [entries["observation"], gap / features.unit]
        else:
            parts = [entries[key] for key in features.keys]
        return np.concatenate(parts, axis=1), batches != {()}


def _rows(name: str, value: Any, shape: tuple[int, ...]) -> tuple[FloatArray, tuple[int, ...]]:
    """Return an entry of an observation as (n, size), rounded to float32, and its batch shape."""
    values = numbers(name, value)
    batch = values.shape[: values.ndim - len(shape)]
    if values.shape != batch + shape or len(batch) > 1:
        many = ", ".join(map(str, ("n", *shape)))
        raise InputError(f"shape of {name}", values.shape, f"{shape} or ({many})")
    with np.errstate(over="ignore"):
        rows = values.reshape(-1, math.prod(shape)).astype(np.float32).astype(np.float64)
    if not np.isfinite(rows).all():
        odd = float(values.flat[np.isfinite(rows).argmin()])
        raise InputError(name, odd, "finite in float32")
    return rows, batch


def _control(env: Any) -> str | None:
    """Return the option ``control`` of an environment; None for environments of other packages."""
    if hasattr(env, "has_attr") and env.has_attr("control"):  # of Stable-Baselines3
        return getattr(env.get_attr("control")[0], "name", None)
    own = getattr(env, "unwrapped", env)
    # Gymnasium's SyncVectorEnv has a list of environments, and no method that is safe to call here.
    first = next(iter(getattr(own, "envs", [])), own)
    return getattr(getattr(getattr(first, "unwrapped", first), "control", None), "name", None)
