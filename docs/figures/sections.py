"""Sections through the workspace: axes, titles and the environments' region.

All drawings are in millimetres, the unit of the paper's case study; all data are in metres.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from tpm_gym.kinematics import WorkingMode
from tpm_gym.learning.figure_style import BLACK
from tpm_gym.mechanism import PAPER_TPM

MM = 1e3
LENGTHS = "lengths of the paper's case study"


def mode_name(mode: WorkingMode) -> str:
    """Return the four signs of a working mode, in words."""
    signs = (mode.cos_beta, mode.leg1, mode.leg2, mode.leg3)
    marks = ["+" if sign > 0 else "\N{MINUS SIGN}" for sign in signs]
    return "cos β {}, legs {} {} {}".format(*marks)


def section_axes(axes: Axes, title: str, horizontal: str = "x", vertical: str = "z") -> None:
    """Set title and units of a section through the workspace."""
    axes.set_title(title)
    axes.set_xlabel(f"{horizontal} (mm)")
    axes.set_ylabel(f"{vertical} (mm)")


def outline_task_region(axes: Axes, vertical: str, inside: bool, colour: str = BLACK) -> None:
    """Outline the environments' region in an x-z or x-y section; dashed where it is elsewhere."""
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
    """Write the title, the lengths and the working mode, at heights in parts of the figure."""
    figure.text(0.5, top, title, ha="center", va="top", fontsize=11, weight="bold")
    figure.text(0.5, below, f"{LENGTHS}; {what}", ha="center", va="top", fontsize=8.5)
