"""Frames of environments, as render() returns them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from tpm_gym.arrays import is_whole
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.imaging import View, camera_of
from tpm_gym.simulation.simulation import Simulation
from tpm_gym.tasks.task import Task

RENDER_MODES = ("human", "rgb_array", "depth_array", "rgbd_tuple", "segmentation")
"""Values of ``render_mode``."""


class Rendering:
    """Options of frames: render mode, camera and size; see :class:`tpm_gym.TPMEnv`.

    Raises:
        ConfigurationError: If an option is out of range.
    """

    def __init__(
        self, machine: Machine, mode: str | None, camera: Any, width: int, height: int
    ) -> None:
        """Check the options."""
        self.mode = mode
        for name, value in (("width", width), ("height", height)):
            if not is_whole(value, 16) or value > 4096:
                valid = "a whole number of pixels from 16 to 4096"
                raise ConfigurationError(name, value, valid)
        camera = camera_of(camera, machine)
        segmented = mode in ("depth_array", "rgbd_tuple", "segmentation")
        self.view = View(camera, int(width), int(height), segmented)

    def frame(self, simulation: Simulation, row: int, markers: ArrayLike) -> Any:
        """Draw one environment in the render mode.

        Args:
            simulation: Simulation of all environments.
            row: Index of the environment.
            markers: Points (k, 3) m, world frame, at which the k goal markers are drawn.

        Raises:
            ConfigurationError: If the engine cannot draw in the render mode.
        """
        picture = simulation.picture(self.view, markers, row)
        if self.mode == "rgb_array":
            return picture.colour
        found = picture.segmentation if self.mode == "segmentation" else picture.depth
        if found is None:
            raise ConfigurationError("render_mode", self.mode, "'rgb_array' with this engine")
        return (picture.colour, found) if self.mode == "rgbd_tuple" else found


class Pixels:
    """Pixel observations: a picture replaces the objects' values in the observation vector.

    Raises:
        ConfigurationError: If an option is out of range.
    """

    def __init__(self, task: Task, camera: Any, size: int) -> None:
        """Find the entries of the observation vector that the pictures do not replace."""
        if not is_whole(size, 16) or size > 1024:
            raise ConfigurationError("pixel_size", size, "a whole number of pixels from 16 to 1024")
        self._rendering = Rendering(task.machine, "rgb_array", camera, size, size)
        blocks = range(len(task.scene.objects))
        seen = {entry.name for block in blocks for entry in task.object_entries(block, turn=True)}
        kept = [np.full(len(entry.scale), entry.name not in seen) for entry in task.entries]
        self._columns = np.flatnonzero(np.concatenate(kept))

    def spaces_of(self, vectors: Mapping[str, spaces.Box]) -> dict[str, spaces.Space[Any]]:
        """Add the pictures to the spaces of the observations."""
        view, bound = self._rendering.view, float(vectors["observation"].high[0])
        return {
            **vectors,
            "observation": spaces.Box(-bound, bound, (len(self._columns),), np.float32),
            "pixels": spaces.Box(0, 255, (view.height, view.width, 3), np.uint8),
        }

    def observe(
        self,
        observation: Mapping[str, Any],
        simulation: Simulation,
        rows: Iterable[tuple[int, ArrayLike]],
    ) -> dict[str, Any]:
        """Return observations with a picture of each environment.

        Args:
            observation: Observations without pictures, (n, ...) each.
            simulation: Simulation to draw.
            rows: For each environment, its row, and the points (k, 3) m, world frame, of its k goal
                markers.
        """
        frames = [self._rendering.frame(simulation, row, markers) for row, markers in rows]
        kept = np.ascontiguousarray(observation["observation"][:, self._columns])
        return {**observation, "observation": kept, "pixels": np.stack(frames)}
