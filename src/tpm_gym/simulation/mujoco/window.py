"""Window of MuJoCo: its passive viewer."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import ConfigurationError
from tpm_gym.simulation.display import has_display
from tpm_gym.simulation.imaging import Camera
from tpm_gym.simulation.mujoco.pictures import aim
from tpm_gym.simulation.stage import MARKER_COLOUR


class Window:
    """Viewer that opens at the first call of :meth:`show`, and for each new model.

    If the user closes the window, it does not open again, not even for a new model.

    Raises:
        ConfigurationError: If no window can open.
    """

    def __init__(self) -> None:
        """Check for a display."""
        if not has_display():
            valid = "None or 'rgb_array': no window opens without a display"
            raise ConfigurationError("render_mode", "human", valid)
        self._viewer: Any = None
        self._model: mujoco.MjModel | None = None
        self._aimed: Camera | None = None

    def show(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        camera: Camera,
        markers: FloatArray,
        radius: float,
    ) -> None:
        """Draw the scene with goal markers (k, 3) m as spheres of ``radius`` (m)."""
        if self._viewer is not None and not self._viewer.is_running():
            return
        if model is not self._model:  # the first model, or a robot with other lengths
            self._open(model, data, camera)
        viewer = self._viewer
        with viewer.lock():
            if camera != self._aimed:  # else the user may move the camera
                aim(viewer.cam, camera)
                self._aimed = camera
            for geom, place in zip(viewer.user_scn.geoms, markers, strict=False):
                kind, size = mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, radius)
                colour = np.array(MARKER_COLOUR, dtype=np.float32)
                mujoco.mjv_initGeom(geom, kind, size, place, np.eye(3).ravel(), colour)
            viewer.user_scn.ngeom = len(markers)
        viewer.sync()

    def _open(self, model: mujoco.MjModel, data: mujoco.MjData, camera: Camera) -> None:
        import mujoco.viewer  # imports GLFW

        self.close()
        model.vis.global_.fovy = camera.opening
        panels = {"show_left_ui": False, "show_right_ui": False}
        self._viewer = mujoco.viewer.launch_passive(model, data, **panels)
        self._viewer.opt.sitegroup[:] = 0  # hides the sites of the loop closures
        self._model, self._aimed = model, None

    def close(self) -> None:
        """Close the window; a second call does nothing."""
        if self._viewer is not None:
            self._viewer.close()
        self._viewer = self._model = None
