"""What MuJoCo alone does: its own frames, its console, its missing package."""

from contextlib import nullcontext
from types import SimpleNamespace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from alone import Alone
from episodes import random_episode
from inside import around_each_step, push

from tpm_gym.arrays import rotate
from tpm_gym.errors import ClosureError, ConfigurationError
from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.simulation import Block, Scene
from tpm_gym.simulation.mujoco.model import object_name

HOME = PAPER_TPM.home
THETA = PAPER_TPM.inverse(HOME)


def test_turning_is_told_in_the_world():
    simulation = Alone(Scene(objects=(Block(),)), engine="mujoco")
    simulation.reset(THETA, {"object": (0.2, 0.1, 0.3)})
    engine = simulation.engine
    joint = engine.data.joint(object_name(0))
    joint.qpos[3:] = np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0  # a quarter turn about x
    joint.qvel[3:] = 0.0, 2.0, 0.0  # about its own y, which points up now
    now = engine.read()
    np.testing.assert_allclose(now.object_angular_velocity[0, 0], (0, 0, 2), atol=1e-12)
    axis = rotate(tuple(now.object_quaternion[0, 0]), (0.0, 0.0, 1.0))
    np.testing.assert_allclose(axis, (0, -1, 0), atol=1e-12)


def test_nothing_is_printed(capfd):
    env = gym.make("TPMPickAndPlace-v0", engine="mujoco")
    list(random_episode(env, 0))
    env.close()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("newtons", [1e3, 1e8, float("nan")])
def test_a_mechanism_torn_apart_is_a_typed_error_and_nothing_else(
    newtons, capfd, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # where the engine would log
    simulation = Alone(engine="mujoco")
    for _ in range(2):
        simulation.reset(THETA)
        assert simulation.move(HOME).closure_error < 1e-6
        tear = lambda: push(simulation, [newtons] * 3)  # noqa: E731
        with around_each_step(simulation, before=tear), pytest.raises(ClosureError):
            simulation.move(HOME)
    printed, written = capfd.readouterr().err, [path.name for path in tmp_path.iterdir()]
    if newtons == 1e8:  # MuJoCo 4 prints and logs of its line search; that cannot be switched off
        printed = printed.replace("WARNING: Linesearch objective is not convex", "").strip()
        written = [name for name in written if name != "MUJOCO_LOG.TXT"]
    assert not printed
    assert not written


def test_a_closed_window_stays_closed_when_lengths_change(monkeypatch):
    opened = []

    def launch(model, data, **panels):
        opened.append(SimpleNamespace(
            is_running=lambda: False, close=lambda: None, sync=lambda: None,
            opt=SimpleNamespace(sitegroup=np.ones(6)), cam=mujoco.MjvCamera(),
            lock=nullcontext, user_scn=SimpleNamespace(geoms=[], ngeom=0),
        ))  # fmt: skip
        return opened[-1]

    for module in ("simulation.mujoco.window", "envs.single"):
        monkeypatch.setattr(f"tpm_gym.{module}.has_display", lambda: True)
    monkeypatch.setattr("mujoco.viewer.launch_passive", launch)
    options = {"randomisation": {"length_error": 1e-3}, "render_mode": "human"}
    env = gym.make("TPMReach-v0", engine="mujoco", disable_env_checker=True, **options)
    for seed in range(3):  # the user closes the first window, other lengths make other models
        env.reset(seed=seed)
    env.close()
    assert len(opened) == 1


def test_a_window_without_a_display_is_refused_by_name(monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(ConfigurationError, match=r"^render_mode = 'human'.*without a display"):
        Alone(engine="mujoco", gui=True)
