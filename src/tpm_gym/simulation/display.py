"""Check for a display. An engine that opens a window without one may end the process."""

from __future__ import annotations

import ctypes
import os
import sys

__all__ = ["has_display"]

_kept: list[ctypes.c_void_p] = []  # a connection to the X server


def has_display() -> bool:
    """Return whether there is a display: on Linux, whether the X server of ``DISPLAY`` has GLX.

    An X server without connections may restart, and refuses new ones meanwhile. So the first
    connection stays open.
    """
    if not sys.platform.startswith("linux"):
        return True
    if not os.environ.get("DISPLAY"):
        return False
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return False  # an engine's window needs the library too
    x11.XOpenDisplay.restype = ctypes.c_void_p
    display = ctypes.c_void_p(x11.XOpenDisplay(None))
    if not display:
        return False
    numbers = [ctypes.byref(ctypes.c_int()) for _ in range(3)]  # of the extension, not needed
    found = bool(x11.XQueryExtension(display, b"GLX", *numbers))
    if _kept:
        x11.XCloseDisplay(display)
    else:
        _kept.append(display)
    return found
