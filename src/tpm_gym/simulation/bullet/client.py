"""The physics engine: the only module that imports PyBullet."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import pybullet

from tpm_gym.errors import ConfigurationError
from tpm_gym.simulation.physics import GRAVITY, REGULARISATION, Physics

__all__ = ["Client", "has_display"]


class Client:
    """A private physics client: pybullet's functions with its number filled in.

    pybullet_utils' BulletClient looks every function up anew at every call, which costs as much as
    the cheaper calls themselves, and prints a line on connecting.

    Args:
        physics: Numerical settings.
        gui: Whether to open PyBullet's window.
        renderer: ``"tiny"`` or ``"egl"``.

    Attributes:
        renderer: The engine's number of the renderer.

    Raises:
        ConfigurationError: If no window opened, or EGL was asked for and is not there.
    """

    def __init__(self, physics: Physics, gui: bool = False, renderer: str = "tiny") -> None:
        """Connect and configure."""
        self._number = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        if self._number < 0:
            raise ConfigurationError(
                "render_mode", "human", "None or 'rgb_array': no window opened"
            )
        try:
            self.renderer = self._load_renderer(renderer)
            self.configure(physics)
        except BaseException:
            self.close()
            raise

    def __getattr__(self, name: str) -> Any:
        """The engine's function of that name, bound to this client, or its constant."""
        value = getattr(pybullet, name)
        if callable(value):
            value = partial(value, physicsClientId=self._number)
        setattr(self, name, value)
        return value

    def configure(self, physics: Physics) -> None:
        """Put all settings in force, as after a reset of the whole client."""
        self.setGravity(0.0, 0.0, -GRAVITY)
        self.setTimeStep(physics.time_step)
        self.setPhysicsEngineParameter(
            numSolverIterations=physics.iterations,
            erp=physics.erp,
            globalCFM=REGULARISATION,
            deterministicOverlappingPairs=1,
        )
        if physics.solver == "direct":
            with _silence():
                self.setPhysicsEngineParameter(
                    constraintSolverType=pybullet.CONSTRAINT_SOLVER_LCP_DANTZIG
                )
        self.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0)  # no side panels

    def close(self) -> None:
        """Disconnect; harmless the second time."""
        if self._number >= 0:
            pybullet.disconnect(self._number)
            self._number = -1

    def _load_renderer(self, renderer: str) -> int:
        """The engine's number of the renderer; loads the EGL plugin if that was asked for."""
        if renderer == "tiny":
            return int(pybullet.ER_TINY_RENDERER)
        if renderer != "egl":
            raise ConfigurationError("renderer", renderer, "'tiny' or 'egl'")
        spec = importlib.util.find_spec("eglRenderer")
        if spec is None or self.loadPlugin(spec.origin, "_eglRendererPlugin") < 0:
            valid = "'tiny': this machine has no EGL renderer"
            raise ConfigurationError("renderer", renderer, valid)
        return int(pybullet.ER_BULLET_HARDWARE_OPENGL)


def has_display() -> bool:
    """Whether PyBullet can open a window here (on Linux it needs an X server)."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY"))


@contextmanager
def _silence() -> Iterator[None]:
    """Keep what the engine says (from C, on changing its solver) out of the user's output."""
    if os.name != "posix":
        yield
        return
    flush = ctypes.CDLL(None).fflush
    sys.stdout.flush()
    flush(None)
    ours, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
        flush(None)
    finally:
        os.dup2(ours, 1)
        os.close(ours)
        os.close(nowhere)
