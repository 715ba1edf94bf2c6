"""Style of all figures: palette, fonts, and saving with equal bytes each time."""

import io
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import matplotlib.style
from matplotlib.figure import Figure

from tpm_gym.learning.provenance import write_whole

DPI = 160
WIDTH = 7.2  # inches: a paper's page, both columns

# Palette of Okabe and Ito, which is clear with every kind of colour blindness.
BLUE, VERMILLION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, BLACK = "#E69F00", "#56B4E9", "#000000"
REACHED, OUTLINE = "#EBEBEB", "#8C8C8C"  # the reachable set, and its edge

_SETTINGS: dict[Any, Any] = {
    "font.size": 8.0,
    "figure.titlesize": 9.5,
    **dict.fromkeys(("axes.titlesize", "axes.labelsize"), 8.0),
    **dict.fromkeys(("xtick.labelsize", "ytick.labelsize"), 7.0),
    **dict.fromkeys(("axes.linewidth", "xtick.major.width", "ytick.major.width"), 0.6),
    "axes.labelpad": 2.0,
    "legend.fontsize": 7.5,
    "legend.framealpha": 1.0,
    "legend.edgecolor": "0.8",
}


def style() -> AbstractContextManager[None]:
    """Set Matplotlib's defaults and our sizes, regardless of the user's settings."""
    return matplotlib.style.context(["default", _SETTINGS])


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, with metadata that do not contain Matplotlib's version.

    With the version, the bytes of the file would change at every update of Matplotlib.

    Drawing takes a second. It happens in memory, so that a process that is killed meanwhile leaves
    no part of a file.
    """
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=DPI, metadata={"Software": None})
    write_whole(path, lambda part: part.write_bytes(drawn.getvalue()))
