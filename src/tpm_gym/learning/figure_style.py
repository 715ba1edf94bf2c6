"""What all figures share: palette, fonts, names of modes, and saving with the same bytes each time.

All drawings are in millimetres, the unit of the paper's case study; all data are in metres.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from tpm_gym.kinematics import WorkingMode
from tpm_gym.mechanism import PAPER_TPM

FloatArray = NDArray[np.float64]

MM = 1e3
DPI = 160
WIDTH = 7.2  # inches: a paper's page, both columns

# Okabe and Ito's palette: told apart with every kind of colour blindness.
BLUE, VERMILLION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, BLACK = "#E69F00", "#56B4E9", "#000000"
REACHED, OUTLINE = "#EBEBEB", "#8C8C8C"  # the reachable set, and its edge

LENGTHS = "lengths of the paper's case study"

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
    """Matplotlib's defaults with our sizes, whatever the user's own settings are."""
    with matplotlib.rc_context(fname=None):
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_SETTINGS)
        yield


def save(figure: Figure, path: Path) -> None:
    """Write a PNG without the entries (program, date) that would change its bytes."""
    figure.savefig(path, dpi=DPI, metadata={"Software": None})


def mode_name(mode: WorkingMode) -> str:
    """The four signs of a working mode, in words."""
    signs = (mode.cos_beta, mode.leg1, mode.leg2, mode.leg3)
    marks = ["+" if sign > 0 else "\N{MINUS SIGN}" for sign in signs]
    return "cos β {}, legs {} {} {}".format(*marks)


def section_axes(axes: Axes, title: str, horizontal: str = "x", vertical: str = "z") -> None:
    """Title and units of a section through the workspace."""
    axes.set_title(title)
    axes.set_xlabel(f"{horizontal} (mm)")
    axes.set_ylabel(f"{vertical} (mm)")


def outline_task_region(axes: Axes, vertical: str, inside: bool, colour: str = BLACK) -> None:
    """Outline the environments' region in an x-z or x-y section; dashed where that misses it."""
    row = {"y": 1, "z": 2}[vertical]
    low, high = (
        np.asarray(corner) * MM for corner in (PAPER_TPM.region.low, PAPER_TPM.region.high)
    )
    axes.add_patch(
        Rectangle(
            (low[0], low[row]),
            high[0] - low[0],
            high[row] - low[row],
            fill=False,
            edgecolor=colour,
            linewidth=1.0,
            linestyle="-" if inside else (0, (3, 2)),
            zorder=5,
        )
    )


def heading(figure: Figure, title: str, what: str, top: float = 0.985, below: float = 0.95) -> None:
    """Title, and below it the lengths and the working mode; heights in parts of the figure."""
    figure.text(0.5, top, title, ha="center", va="top", fontsize=11, weight="bold")
    figure.text(0.5, below, f"{LENGTHS}; {what}", ha="center", va="top", fontsize=8.5)
