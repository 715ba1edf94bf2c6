"""Style of all figures: palette, fonts, and saving with equal bytes each time."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
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
    "axes.titlesize": 8.0,
    "axes.labelsize": 8.0,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "legend.fontsize": 7.5,
    "figure.titlesize": 9.5,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "axes.labelpad": 2.0,
    "legend.framealpha": 1.0,
    "legend.edgecolor": "0.8",
    "axes.unicode_minus": True,
}


@contextmanager
def style() -> Iterator[None]:
    """Set Matplotlib's defaults and our sizes, regardless of the user's settings."""
    with matplotlib.rc_context(fname=None):
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_SETTINGS)
        yield


def save(figure: Figure, path: Path) -> None:
    """Write a PNG without the program and date, which would change its bytes.

    Drawing takes a second. It happens in memory, so that a process that is killed meanwhile leaves
    no part of a file.
    """
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=DPI, metadata={"Software": None})
    write_whole(path, lambda part: part.write_bytes(drawn.getvalue()))
