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
from tpm_gym.simulation.imaging import BACKGROUND, Camera, Picture, View, metres

RENDERERS = ("egl", "osmesa", "glfw")
"""OpenGL backends in the order in which they are tried.

EGL draws on the GPU, or on the CPU with Mesa. OSMesa draws on the CPU. GLFW needs a display.
"""

_SMALL = 128 * 128  # pixels

_open: weakref.WeakSet[Pictures] = weakref.WeakSet()


class Pictures:
    """Renderer of the scene. It opens an OpenGL context for the first picture of each size.

    Args:
        renderer: One of :data:`RENDERERS`. If None, the environment variable ``MUJOCO_GL`` names
            the renderer. If the variable has none of these names, the first renderer that works is
            used.

    Raises:
        ConfigurationError: If ``renderer`` is neither None nor one of :data:`RENDERERS`.
    """

    def __init__(self, renderer: str | None) -> None:
        """Check the name of the renderer; OpenGL is opened later."""
        if renderer is not None and renderer not in RENDERERS:
            raise ConfigurationError("renderer", renderer, " or ".join(map(repr, RENDERERS)))
        self._renderer = renderer
        self._contexts: dict[tuple[int, int], tuple[Any, mujoco.MjrContext]] = {}

    def draw(
        self, model: mujoco.MjModel, data: mujoco.MjData, view: View, ids: NDArray[np.int32]
    ) -> Picture:
        """Draw the scene; ``ids`` (number of geoms,) are the geoms' ids in a segmentation.

        Raises:
            ConfigurationError: If no OpenGL backend works.
        """
        size = view.width, view.height
        if size not in self._contexts:
            self._contexts[size] = self._open(model, *size)
        opengl, context = self._contexts[size]
        opengl.make_current()
        model.vis.global_.fovy = view.opening
        scene = mujoco.MjvScene(model, maxgeom=200)
        scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        looks, camera = mujoco.MjvOption(), mujoco.MjvCamera()
        looks.sitegroup[:] = 0  # the closures' sites
        aim(camera, view.camera)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, looks, None, camera, everything, scene)
        colour, share = _draw(scene, context, view)
        segmentation = None
        if view.segmented:
            for flag in (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR):
                scene.flags[flag] = True
            drawn = [geom for geom in scene.geoms[: scene.ngeom] if geom.segid >= 0]
            table = np.full(scene.ngeom + 1, BACKGROUND, dtype=np.int32)
            table[[geom.segid + 1 for geom in drawn]] = ids[[geom.objid for geom in drawn]]
            # The edges of this depth are at the edges of the ids. Smoothed edges would not be.
            shown, share = _draw(scene, context, view)
            segmentation = table[shown @ (1, 1 << 8, 1 << 16)]
        return Picture(colour, metres(share), segmentation)

    def close(self) -> None:
        """Release the OpenGL contexts; a second call does nothing."""
        for opengl, context in self._contexts.values():
            opengl.make_current()
            context.free()
            opengl.free()
        self._contexts.clear()

    def _open(self, model: mujoco.MjModel, width: int, height: int) -> tuple[Any, Any]:
        """Open an OpenGL context for pictures of this size."""
        opengl = _opengl(self._renderer, width, height)
        opengl.make_current()
        screen = model.vis.global_
        screen.offwidth, screen.offheight = width, height
        # Smooth edges take three quarters of the time. Small pictures are observations.
        model.vis.quality.offsamples = 4 if width * height > _SMALL else 0
        model.vis.quality.shadowsize = 0  # a map for shadows, which no light casts, takes 64 MiB
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR.value
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
        if not _open:  # contexts that are still open at the end of the process print messages
            atexit.register(_close_all)
        _open.add(self)
        return opengl, context


def _draw(
    scene: mujoco.MjvScene, context: mujoco.MjrContext, view: View
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Draw a scene; return colours (height, width, 3) and depth buffer (height, width)."""
    place = mujoco.MjrRect(0, 0, view.width, view.height)
    mujoco.mjr_render(place, scene, context)
    pixels = np.empty((view.height, view.width, 3), np.uint8)
    depth = np.empty((view.height, view.width), np.float32)
    mujoco.mjr_readPixels(pixels, depth, place, context)
    return np.ascontiguousarray(pixels[::-1]), depth[::-1]  # OpenGL has the lowest row first


def _close_all() -> None:
    for pictures in list(_open):
        pictures.close()


def aim(own: mujoco.MjvCamera, camera: Camera) -> None:
    """Set the pose of a MuJoCo camera, not its field of view, which is stored in the model."""
    own.lookat[:], own.distance = camera.target, camera.distance
    own.azimuth, own.elevation = camera.yaw + 90.0, camera.pitch  # azimuth 0 is along +x


def _opengl(renderer: str | None, width: int, height: int) -> Any:
    """Open an OpenGL context for pictures of this size.

    If ``renderer`` is None, the environment variable ``MUJOCO_GL`` names the backend. If the
    variable has none of the names in :data:`RENDERERS`, the first backend that works is used.
    """
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
