"""Pictures by MuJoCo: the same as the other engine's, or a typed error where there is no OpenGL."""

import os
import subprocess
from typing import Any

import numpy as np
import pytest
from alone import Alone
from numpy.typing import NDArray
from processes import PYTHON

from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.simulation import Block, Scene
from tpm_gym.simulation.imaging import View, camera_of
from tpm_gym.simulation.mujoco import pictures as module

HOME = PAPER_TPM.home
THETA = PAPER_TPM.inverse(HOME)
WIDTH, HEIGHT = 320, 240


@pytest.fixture
def simulation():
    simulation = Alone(Scene(objects=(Block(),)), engine="mujoco")
    simulation.reset(THETA, {"object": (0.1, -0.1, 0.015)})
    yield simulation
    simulation.close()


GOAL = (-0.1, -0.03, 0.2)
VIEW = View(camera_of("table", PAPER_TPM), WIDTH, HEIGHT)


def picture(simulation: Alone, goal: Any = GOAL) -> NDArray[Any]:
    try:
        return simulation.picture(VIEW, goal).colour.astype(int)
    except ConfigurationError:
        pytest.skip("needs OpenGL")


def middle(pixels: NDArray[Any]) -> NDArray[Any]:
    """Row and column of the middle of what is marked."""
    assert pixels.sum() >= 5
    return np.argwhere(pixels).mean(axis=0)


def red(image: NDArray[Any]) -> NDArray[Any]:
    """The block."""
    colour = np.moveaxis(image, -1, 0) / (image[..., 0] + 1)
    return (image[..., 0] > 100) & (colour[1] < 0.3) & (abs(colour[2] - 0.4) < 0.08)


def green(image: NDArray[Any]) -> NDArray[Any]:
    """The goal."""
    return image[..., 1] - image[..., [0, 2]].max(axis=-1) > 40


def test_what_moves_is_drawn_elsewhere_before_the_next_time_step(simulation):
    seen = []
    for x in (-0.1, 0.1):
        goal = (x, -0.03, 0.2)
        seen.append(middle(green(picture(simulation, goal))))
        simulation.move(HOME)
        seen.append(middle(green(picture(simulation, goal))))
    assert np.linalg.norm(seen[0] - seen[2]) > 10
    np.testing.assert_allclose(seen[::2], seen[1::2], atol=0.5)
    before = middle(red(picture(simulation)))
    simulation.reset(THETA, {"object": (-0.1, -0.1, 0.015)})
    assert np.linalg.norm(middle(red(picture(simulation))) - before) > 10


def test_sizes_may_change_and_a_closed_one_draws_again(simulation):
    picture(simulation)
    small = VIEW._replace(width=64, height=48)
    assert simulation.picture(small).colour.shape == (48, 64, 3)
    simulation.close()
    simulation.close()
    assert picture(simulation).shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("renderer", ["tiny", "", 1])
def test_an_unknown_renderer_is_refused(renderer):
    with pytest.raises(ConfigurationError, match="'egl' or 'osmesa' or 'glfw'") as caught:
        Alone(Scene(), engine="mujoco", renderer=renderer)
    assert (caught.value.name, caught.value.value) == ("renderer", renderer)


def test_where_there_is_no_way_to_opengl_the_error_names_what_there_is(simulation, monkeypatch):
    def missing(name):
        os.environ["PYOPENGL_PLATFORM"] = name
        raise ImportError(name)

    monkeypatch.setattr(module.importlib, "import_module", missing)
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    with pytest.raises(ConfigurationError, match="engine='pybullet' draws anywhere") as caught:
        simulation.picture(VIEW)
    assert caught.value.name == "renderer"
    assert "PYOPENGL_PLATFORM" not in os.environ
    simulation.move(HOME)


def test_a_process_that_ends_with_pictures_open_says_nothing():
    script = """
import gymnasium as gym, tpm_gym
envs = [gym.make("TPMReach-v0", engine="mujoco", render_mode="rgb_array") for _ in range(2)]
for env in envs:
    env.reset(seed=0)
    try:
        env.render()
    except tpm_gym.TPMError:
        pass
"""
    done = subprocess.run([PYTHON, "-c", script], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
