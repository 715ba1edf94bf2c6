"""The ids, and nothing that would import an engine."""

from __future__ import annotations

import gymnasium as gym

__all__ = ["ENV_IDS", "MAX_EPISODE_STEPS", "register"]

MAX_EPISODE_STEPS = 50

_TABLE = {
    f"TPM{task_name}{control_suffix}{reward_suffix}-v0": {
        "task": task,
        "control": control,
        "reward": reward,
    }
    for task_name, task in (("Reach", "reach"), ("PickAndPlace", "pick_and_place"))
    for control_suffix, control in (("", "cartesian"), ("Joints", "joints"))
    for reward_suffix, reward in (("", "sparse"), ("Dense", "dense"))
}

ENV_IDS: tuple[str, ...] = tuple(_TABLE)
"""All ids that tpm_gym registers."""


def register() -> None:
    """Register every id with Gymnasium; harmless the second time."""
    for env_id, kwargs in _TABLE.items():
        if env_id not in gym.registry:
            gym.register(
                id=env_id,
                entry_point="tpm_gym.envs.env:TPMEnv",
                max_episode_steps=MAX_EPISODE_STEPS,
                kwargs=dict(kwargs),
            )
