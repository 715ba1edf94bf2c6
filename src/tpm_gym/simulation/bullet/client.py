"""PyBullet's functions, bound to one private physics client."""

from __future__ import annotations

import ctypes
import importlib.util
import itertools
import os
import sys
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import pybullet

from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.mount import GRAVITY
from tpm_gym.simulation.bullet.physics import REGULARISATION, Physics
from tpm_gym.simulation.display import has_display

__all__ = ["Client", "silence"]

_stdout_lock = threading.RLock()
_closed = itertools.count(1)


class Client:
    """A private physics client: pybullet's functions with its number filled in.

    Unlike BulletClient of pybullet_utils, it looks each function up only once, which halves the
    time of the cheaper calls, and prints nothing.

    Args:
        physics: Numerical settings.
        gui: Whether to open PyBullet's window.
        renderer: ``"tiny"`` (None too) draws on the CPU anywhere; ``"egl"`` on a GPU.

    Attributes:
        number: PyBullet's number of the client.
        renderer: PyBullet's number of the renderer.

    Raises:
        ConfigurationError: If no window opened, or EGL was asked for and is not there.
    """

    def __init__(self, physics: Physics, gui: bool = False, renderer: str | None = None) -> None:
        """Connect and configure."""
        self.number = _connect(gui)
        # An environment that is dropped without close() would keep its 28 MB until the end.
        self._disconnect = weakref.finalize(self, _disconnect, self.number)
        try:
            self.renderer = self._load_renderer(renderer)
            self.configure(physics)
        except BaseException:
            self.close()
            raise

    def __getattr__(self, name: str) -> Any:
        """Return PyBullet's function of that name, bound to this client, or its constant."""
        value = getattr(pybullet, name)
        if callable(value):
            value = partial(value, physicsClientId=self.number)
        setattr(self, name, value)
        return value

    def configure(self, physics: Physics) -> None:
        """Apply all settings, which a reset of the whole client clears."""
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
        self.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0)  # no side panels

    def close(self) -> None:
        """Disconnect; harmless the second time."""
        self._disconnect()

    def _load_renderer(self, renderer: str | None) -> int:
        """Return PyBullet's number of the renderer, and load the EGL plugin where necessary."""
        if renderer in (None, "tiny"):
            return int(pybullet.ER_TINY_RENDERER)
        if renderer != "egl":
            raise ConfigurationError("renderer", renderer, "'tiny' or 'egl'")
        spec = importlib.util.find_spec("eglRenderer")
        if spec is None or self.loadPlugin(spec.origin, "_eglRendererPlugin") < 0:
            valid = "'tiny': this machine has no EGL renderer"
            raise ConfigurationError("renderer", renderer, valid)
        return int(pybullet.ER_BULLET_HARDWARE_OPENGL)


def _connect(gui: bool) -> int:
    """Return the number of a new client, with a window if required."""
    if not gui:
        return int(pybullet.connect(pybullet.DIRECT))
    number = -1
    with suppress(pybullet.error):
        number = pybullet.connect(pybullet.GUI) if has_display() else -1
    if number < 0:
        valid = "None or 'rgb_array': no window opened (it takes a display, one in a process)"
        raise ConfigurationError("render_mode", "human", valid)
    return int(number)


def _disconnect(number: int) -> None:
    # PyBullet may be gone already, at the end of the interpreter or after a fork.
    with suppress(pybullet.error):
        pybullet.disconnect(number)
    if next(_closed) % 4 == 0:  # glibc would keep the memory until the end; this takes milliseconds
        with suppress(AttributeError, OSError, TypeError):  # another C library
            ctypes.CDLL(None).malloc_trim(0)


@contextmanager
def silence() -> Iterator[None]:
    """Discard the standard output for a moment, that of C code too.

    The whole process is silent meanwhile, so only one thread does this at a time.
    """
    with _stdout_lock:
        try:
            kept = os.dup(1) if os.name == "posix" else -1
        except OSError:  # there is no standard output
            kept = -1
        if kept < 0:
            yield
            return
        _flush()
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 1)
            try:
                yield
            finally:
                _flush()
                os.dup2(kept, 1)
                os.close(kept)


def _flush() -> None:
    """Flush the buffers of Python and of the C library."""
    with suppress(AttributeError, ValueError, OSError):  # stdout may be None, or closed
        sys.stdout.flush()
    ctypes.CDLL(None).fflush(None)
