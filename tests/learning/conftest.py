"""What the tests of learning share."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from trainings import kill_at, make_config

from tpm_gym.learning import TrainingConfig, curve


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    """Networks this small only wait for each other on several threads."""
    torch.set_num_threads(1)


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes longer than all the rest of the small trainings."""
    monkeypatch.setattr(curve, "draw_learning_curve", lambda *args: None)


@pytest.fixture
def killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., TrainingConfig]:
    """Trains, in the folder ``run``, up to a death at a step; returns the configuration."""

    def train_and_die(step: int, case: str = "sac", **changes: Any) -> TrainingConfig:
        config = replace(make_config(case, tmp_path), **changes)
        kill_at(monkeypatch, step, config)
        return config

    return train_and_die
