"""Check for a display. Without a display, an engine that opens a window may end the process."""

from __future__ import annotations

import ctypes
import os
import sys

_kept: list[ctypes.c_void_p] = []  # the first connection to the X server


def has_display() -> bool:
    """Return whether a window can open: on Linux, whether the X server of ``DISPLAY`` has GLX.

    An X server without connections may restart, and rejects new connections during the restart.
    So the first connection stays open.
    """
    if not sys.platform.startswith("linux"):
        return True
    if not os.environ.get("DISPLAY"):
        return False
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return False  # the window of an engine needs this library too
    x11.XOpenDisplay.restype = ctypes.c_void_p
    display = ctypes.c_void_p(x11.XOpenDisplay(None))
    if not display:
        return False
    outputs = [ctypes.byref(ctypes.c_int()) for _ in range(3)]  # required arguments; not read
    found = bool(x11.XQueryExtension(display, b"GLX", *outputs))
    if _kept:
        x11.XCloseDisplay(display)
    else:
        _kept.append(display)
    return found
