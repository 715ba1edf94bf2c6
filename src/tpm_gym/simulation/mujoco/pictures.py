"""Pictures of the scene by MuJoCo, without a window."""

from __future__ import annotations

import atexit
import importlib
import os
import weakref
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from tpm_gym.errors import ConfigurationError
from tpm_gym.simulation.display import has_display
from tpm_gym.simulation.stage import CAMERA

__all__ = ["RENDERERS", "Pictures"]

RENDERERS = ("egl", "osmesa", "glfw")
"""OpenGL backends, in the order in which they are tried: on the GPU, the CPU, a display."""

_open: weakref.WeakSet[Pictures] = weakref.WeakSet()


class Pictures:
    """Renderer of the scene. It opens an OpenGL context for the first picture.

    Args:
        renderer: One of :data:`RENDERERS`; None for the value of the environment variable
            ``MUJOCO_GL``, or else the first renderer that works.

    Raises:
        ConfigurationError: If ``renderer`` is another name.
    """

    def __init__(self, renderer: str | None) -> None:
        """Check the name of the renderer; OpenGL is opened later."""
        if renderer is not None and renderer not in RENDERERS:
            raise ConfigurationError("renderer", renderer, " or ".join(map(repr, RENDERERS)))
        self._renderer = renderer
        self._size = (0, 0)
        self._opengl: Any = None
        self._context: Any = None

    def draw(
        self, model: mujoco.MjModel, data: mujoco.MjData, width: int, height: int
    ) -> NDArray[np.uint8]:
        """Draw the scene as an RGB image (height, width, 3).

        Raises:
            ConfigurationError: If no OpenGL backend works.
        """
        if self._size != (width, height):
            self._open(model, width, height)
        self._opengl.make_current()
        scene = mujoco.MjvScene(model, maxgeom=200)
        scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(
            model, data, mujoco.MjvOption(), None, _camera(), everything.value, scene
        )
        place = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(place, scene, self._context)
        pixels = np.empty((height, width, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, place, self._context)
        return np.ascontiguousarray(pixels[::-1])  # OpenGL returns the lowest row first

    def close(self) -> None:
        """Release the OpenGL context; a second call does nothing."""
        self._size = (0, 0)
        if self._context is not None:
            self._opengl.make_current()
            self._context.free()
        if self._opengl is not None:
            self._opengl.free()
        self._opengl = self._context = None

    def _open(self, model: mujoco.MjModel, width: int, height: int) -> None:
        """Open an OpenGL context for pictures of this size."""
        self.close()
        self._opengl = _opengl(self._renderer, width, height)
        self._opengl.make_current()
        screen = model.vis.global_
        screen.offwidth, screen.offheight, screen.fovy = width, height, CAMERA.opening
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._size = (width, height)
        if not _open:  # contexts that are still open at the end of the process print messages
            atexit.register(_close_all)
        _open.add(self)


def _close_all() -> None:
    for pictures in list(_open):
        pictures.close()


def _camera() -> mujoco.MjvCamera:
    camera = mujoco.MjvCamera()
    camera.lookat[:] = CAMERA.target
    camera.distance = CAMERA.distance
    camera.azimuth, camera.elevation = CAMERA.yaw + 90.0, CAMERA.pitch  # azimuth 0 is along +x
    return camera


def _opengl(renderer: str | None, width: int, height: int) -> Any:
    """Open an OpenGL context with ``renderer``, or else with the first backend that works."""
    asked = renderer or os.environ.get("MUJOCO_GL", "").lower()
    names = [asked] if asked in RENDERERS else RENDERERS
    found = (_context(name, width, height) for name in names)
    context = next((one for one in found if one is not None), None)
    if context is None:
        valid = (
            "one that works here: 'egl' needs a GPU driver or Mesa, 'osmesa' Mesa's library, "
            "'glfw' a display; or use render_mode=None; engine='pybullet' draws anywhere"
        )
        raise ConfigurationError("renderer", renderer, valid)
    return context


def _context(name: str, width: int, height: int) -> Any:
    """Open a context of this backend; return None if the backend does not work."""
    if name == "glfw" and not has_display():
        return None  # without a display, GLFW prints messages and may end the process
    platform = os.environ.get("PYOPENGL_PLATFORM")
    try:
        return importlib.import_module(f"mujoco.{name}").GLContext(width, height)
    except Exception:  # raised by the loader, the driver, or OpenGL
        # The module has set PYOPENGL_PLATFORM, with which other backends cannot be imported.
        os.environ.pop("PYOPENGL_PLATFORM", None)
        if platform is not None:
            os.environ["PYOPENGL_PLATFORM"] = platform
        return None
