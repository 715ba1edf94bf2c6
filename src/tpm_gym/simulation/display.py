"""Whether a window can be opened here; engines that try without one may end the process."""

from __future__ import annotations

import ctypes
import os
import sys

__all__ = ["has_display"]

_kept: list[ctypes.c_void_p] = []  # a connection to the X server


def has_display() -> bool:
    """Whether there is a screen: on Linux, whether the X server of ``DISPLAY`` answers, with GLX.

    A server to which nobody is connected any more may start anew, and refuses whoever comes
    meanwhile. So the first connection from here stays open: asking must not lead to that.
    """
    if not sys.platform.startswith("linux"):
        return True
    if not os.environ.get("DISPLAY"):
        return False
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return False  # what opens windows needs it as well
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
