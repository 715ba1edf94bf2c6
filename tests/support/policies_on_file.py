"""Policies written to files for tests, by the letter of the format and without the exporter."""

import itertools
import json
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from tpm_gym.policy.files import digest
from tpm_gym.policy.policy import Policy

Weights = dict[str, np.ndarray[Any, Any]]


def box(size: int, bound: float, dtype: str = "float32") -> dict[str, Any]:
    low, high = [-bound] * size, [bound] * size
    return {"shape": [size], "dtype": dtype, "low": low, "high": high}


def described(data: bytes, **changes: Any) -> dict[str, Any]:
    """Return what a JSON file holds, before it is sealed with its own sum."""
    content: dict[str, Any] = {
        "format": "tpm_gym.policy",
        "version": 1,
        "env": "TPMReach-v0",
        "env_options": {"machine": "wide"},
        "algorithm": "sac",
        "seed": 3,
        "steps": 5000,
        "recipe": {"n_timesteps": 5000, "arguments": {"gamma": 0.95, "net_arch": [5, 4]}},
        "versions": {"python": "3.11.7", "torch": None},
        "network": {
            "features": {"kind": "goal_gap", "unit": 0.05},
            "hidden": [5, 4],
            "activation": "relu",
            "output": "tanh",
        },
        "action_space": box(2, 1.0),
        "observation_space": {
            "achieved_goal": box(3, 2.0),
            "desired_goal": box(3, 2.0),
            "observation": box(4, 10.0),
        },
        "weights": {"bytes": len(data), "sha256": sha256(data).hexdigest()},
    }
    return content | changes


def some_weights(sizes: tuple[int, ...] = (7, 5, 4, 2)) -> Weights:
    rng = np.random.default_rng(7)
    found = {}
    for i, (before, after) in enumerate(itertools.pairwise(sizes)):
        found[f"layers.{i}.weight"] = rng.normal(size=(after, before)).astype(np.float32)
        found[f"layers.{i}.bias"] = rng.normal(size=after).astype(np.float32)
    return found


WEIGHTS = some_weights()
DATA = safetensors.numpy.save(WEIGHTS)


def write(folder: Path, content: dict[str, Any] | None = None, data: bytes = DATA) -> Path:
    """Write both files; the JSON is sealed with the sum that belongs to it."""
    content = described(data) if content is None else content
    text = json.dumps(content | {"sha256": digest(content)}, indent=1)
    return write_raw(folder, text.encode("utf-8"), data)


def write_raw(folder: Path, text: bytes, data: bytes = DATA) -> Path:
    path = folder / "p.json"
    path.write_bytes(text)
    path.with_suffix(".safetensors").write_bytes(data)
    return path


TEXT = json.dumps(described(DATA) | {"sha256": digest(described(DATA))}).encode()


def observations(n: int, seed: int = 0) -> dict[str, np.ndarray[Any, Any]]:
    rng = np.random.default_rng(seed)
    goals = {key: rng.uniform(-0.5, 0.5, (n, 3)) for key in ("achieved_goal", "desired_goal")}
    return goals | {"observation": rng.uniform(-1, 1, (n, 4))}


def same(first: Policy, second: Policy) -> bool:
    """Whether two policies are described alike and act alike, to the last bit."""
    batch = observations(20)
    return first.description == second.description and np.array_equal(
        first.act(batch), second.act(batch)
    )
