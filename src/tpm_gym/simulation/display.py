"""Whether a window can be opened here; engines that try without one may end the process."""

from __future__ import annotations

import ctypes
import os
import sys

__all__ = ["has_display"]


def has_display() -> bool:
    """Whether there is a screen: on Linux, whether the X server of ``DISPLAY`` answers."""
    if not sys.platform.startswith("linux"):
        return True
    if not os.environ.get("DISPLAY"):
        return False
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return False  # what opens windows needs it as well
    x11.XOpenDisplay.restype = ctypes.c_void_p
    display = x11.XOpenDisplay(None)
    if display:
        x11.XCloseDisplay(ctypes.c_void_p(display))
    return bool(display)
