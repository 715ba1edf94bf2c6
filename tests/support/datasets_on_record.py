"""Digests of the first episodes of datasets, and how to record them again.

    python tests/support/datasets_on_record.py tests/data/datasets.json [ID ...]

Without ids, all are recorded. Only where the physics, a task or its expert is meant to change are
they recorded anew.
"""

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from minari import MinariDataset
from rich.console import Console

import tpm_gym
from tpm_gym.learning.datasets import CollectConfig, collect, digest

KINDS: Any = ("expert", "noisy", "random")
COUNTS = (5, 50)


def records(env_id: str, episodes: int) -> dict[str, Any]:
    """Collect the datasets of an id; return digests and mean returns by kind and count."""
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        config = CollectConfig(env=(env_id,), kind=KINDS, episodes=episodes, out=Path(folder))
        for kind, made in zip(KINDS, collect(config, Console(quiet=True)), strict=True):
            dataset = MinariDataset(made / "data")
            returns = [float(episode.rewards.sum()) for episode in dataset]
            found[kind] = {
                str(count): {
                    "sha256": digest(made / "data", count),
                    "return": float(np.mean(returns[:count])),
                }
                for count in COUNTS
                if count <= episodes
            }
            if episodes >= max(COUNTS):
                ends = [bool(episode.infos["is_success"][-1]) for episode in dataset]
                found[kind]["success"] = float(np.mean(ends))
    return found


if __name__ == "__main__":
    path = Path(sys.argv[1])
    content = json.loads(path.read_text(encoding="utf-8")) if sys.argv[2:] else {}
    for env_id in sys.argv[2:] or tpm_gym.ENV_IDS:
        content[env_id] = records(env_id, max(COUNTS))
        path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
