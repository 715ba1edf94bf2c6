"""What the tests of learning share."""

import shutil
from dataclasses import replace

import pytest
import torch
from trainings import kill_at, killed_half_way, make_config

from tpm_gym.learning import curve


@pytest.fixture(autouse=True)
def _one_thread():
    """Networks this small only wait for each other on several threads."""
    torch.set_num_threads(1)


@pytest.fixture
def no_pictures(monkeypatch):
    """Drawing takes longer than all the rest of the small trainings."""
    monkeypatch.setattr(curve, "draw_learning_curve", lambda *args: None)


@pytest.fixture
def killed(tmp_path, monkeypatch):
    """Trains, in the folder ``run``, up to a death at a step; returns the configuration."""

    def train_and_die(step, case="sac", **changes):
        config = replace(make_config(case, tmp_path), **changes)
        kill_at(monkeypatch, step, config)
        return config

    return train_and_die


@pytest.fixture
def half(tmp_path):
    """A run that was killed half way."""
    config = replace(killed_half_way(), run=tmp_path / "run")
    shutil.copytree(killed_half_way().run, config.run)
    return config
