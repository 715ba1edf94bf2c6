"""PyBullet's functions, bound to one physics client."""

from __future__ import annotations

import ctypes
import importlib.util
import itertools
import weakref
from contextlib import nullcontext, suppress
from functools import partial
from typing import Any

import pybullet

from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.mount import GRAVITY
from tpm_gym.simulation.bullet.physics import REGULARISATION, Physics
from tpm_gym.simulation.bullet.silence import silence
from tpm_gym.simulation.display import has_display

_WINDOW = "--width=960 --height=720"  # software OpenGL takes longer for more pixels

_closed = itertools.count(1)


class Client:
    """Physics client: pybullet's functions with the argument ``physicsClientId`` filled in.

    It replaces BulletClient of pybullet_utils. It looks up each function only once, which halves
    the time of the cheaper calls, and it prints nothing.

    Args:
        physics: Numerical settings.
        gui: Whether to open PyBullet's window.
        renderer: ``"tiny"`` or None draws on the CPU; ``"egl"`` draws on a GPU.

    Attributes:
        number: PyBullet's id of the client.
        renderer: PyBullet's id of the renderer.

    Raises:
        ConfigurationError: If no window can open, or the renderer is not available.
    """

    def __init__(self, physics: Physics, gui: bool = False, renderer: str | None = None) -> None:
        """Connect to PyBullet, load the renderer, and apply the settings."""
        self.number = _connect(gui)
        # Without this, an environment that is deleted without close() would keep its 28 MB.
        self._disconnect = weakref.finalize(self, _disconnect, self.number)
        try:
            self.renderer = self._load_renderer(renderer)
            self.configure(physics)
        except BaseException:
            self.close()
            raise

    def __getattr__(self, name: str) -> Any:
        """Return the constant ``name`` of pybullet, or its function bound to this client."""
        value = getattr(pybullet, name)
        if callable(value):
            value = partial(value, physicsClientId=self.number)
        setattr(self, name, value)
        return value

    def configure(self, physics: Physics) -> None:
        """Apply all settings; ``resetSimulation`` of PyBullet clears them."""
        self.setGravity(0.0, 0.0, -GRAVITY)
        self.setTimeStep(physics.time_step)
        self.setPhysicsEngineParameter(
            numSolverIterations=physics.iterations,
            erp=physics.erp,
            globalCFM=REGULARISATION,
            deterministicOverlappingPairs=1,
        )
        if physics.solver == "direct":
            with silence():  # PyBullet prints a line from C
                self.setPhysicsEngineParameter(
                    constraintSolverType=pybullet.CONSTRAINT_SOLVER_LCP_DANTZIG
                )

    def close(self) -> None:
        """Disconnect from PyBullet; a second call does nothing."""
        self._disconnect()

    def _load_renderer(self, renderer: str | None) -> int:
        """Return PyBullet's id of the renderer; load the EGL plugin for ``"egl"``."""
        if renderer in (None, "tiny"):
            return int(pybullet.ER_TINY_RENDERER)
        if renderer != "egl":
            raise ConfigurationError("renderer", renderer, "'tiny' or 'egl'")
        spec = importlib.util.find_spec("eglRenderer")
        if spec is None or self.loadPlugin(spec.origin, "_eglRendererPlugin") < 0:
            valid = "'tiny': this computer has no EGL renderer"
            raise ConfigurationError("renderer", renderer, valid)
        return int(pybullet.ER_BULLET_HARDWARE_OPENGL)


def _connect(gui: bool) -> int:
    """Return the id of a new client."""
    if not gui:
        return int(pybullet.connect(pybullet.DIRECT))
    number = -1
    with suppress(pybullet.error), silence():  # PyBullet prints some 30 lines from C
        number = pybullet.connect(pybullet.GUI, options=_WINDOW) if has_display() else -1
    if number < 0:
        valid = "None or 'rgb_array': no window opened (needs a display; one window per process)"
        raise ConfigurationError("render_mode", "human", valid)
    return int(number)


def _disconnect(number: int) -> None:
    # The client may not exist any more at the end of the interpreter or after a fork.
    with suppress(pybullet.error):
        window = pybullet.getConnectionInfo(number)["connectionMethod"] == pybullet.GUI
        with silence() if window else nullcontext():
            pybullet.disconnect(number)
    if next(_closed) % 4 == 0:  # glibc keeps free memory; trimming takes ms, so not every time
        with suppress(AttributeError, OSError, TypeError):  # other C libraries have no malloc_trim
            ctypes.CDLL(None).malloc_trim(0)
