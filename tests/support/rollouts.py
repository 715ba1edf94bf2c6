"""Rollouts as digests and numbers, and how to record them again.

    python tests/support/rollouts.py tests/data/rollouts.json

Only where the physics, a task or a policy is meant to change are they recorded anew.
"""

import hashlib
import json
import struct
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import tpm_gym
from tpm_gym.resources import POLICIES

EPISODES = 20
FIRST_SEED = 3_000_000
KEYS = ("observation", "achieved_goal", "desired_goal")
NUMBERS = ("closure_error", "conditioning", "singularity_penalty")


def cases() -> list[tuple[str, str]]:
    """Every id with the scripted expert and random actions; the published policies on theirs."""
    published = sorted(path.stem for path in POLICIES.glob("*.safetensors"))
    scripted = [(env_id, name) for env_id in tpm_gym.ENV_IDS for name in ("expert", "random")]
    return scripted + [(env_id, "published") for env_id in published]


def play(env_id: str, name: str, make_expert: Callable[[Any], Any]) -> dict[str, Any]:
    """Play a case; its digest, and the return and the last distance to the goal of each episode."""
    digest, returns, gaps = hashlib.sha256(), [], []
    env = gym.make(env_id)
    if name == "expert":
        player = make_expert(env)
    elif name == "published":
        player = tpm_gym.load_policy(POLICIES / f"{env_id}.json")
    for seed in range(FIRST_SEED, FIRST_SEED + EPISODES):
        observation, info = env.reset(seed=seed)
        rng = np.random.default_rng(seed)
        if name == "expert":
            player.reset(observation)
        total, done = 0.0, False
        while not done:
            _update(digest, observation, info)
            random = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
            action = random if name == "random" else player.act(observation)
            observation, reward, terminated, truncated, info = env.step(action)
            digest.update(struct.pack("d??", float(reward), terminated, truncated))
            total, done = total + float(reward), terminated or truncated
        _update(digest, observation, info)
        returns.append(total)
        gap = observation["achieved_goal"] - observation["desired_goal"]
        gaps.append(float(np.linalg.norm(gap.astype(np.float64))))
    return {"sha256": digest.hexdigest(), "returns": returns, "gaps": gaps}


def _update(digest: Any, observation: Mapping[str, Any], info: Mapping[str, Any]) -> None:
    for key in KEYS:
        digest.update(observation[key].tobytes())
    digest.update(struct.pack("3d?", *(info[name] for name in NUMBERS), info["is_success"]))
    for name, value in sorted(info["reward_terms"].items()):
        digest.update(name.encode() + struct.pack("d", value))


if __name__ == "__main__":
    from tpm_gym.tasks.expert import Expert

    found = {f"{env_id} {name}": play(env_id, name, Expert) for env_id, name in cases()}
    Path(sys.argv[1]).write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
