"""Figure of each motor turned alone, and its share in every coordinate."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from figures.parameters import DRAWN, POINT, project
from figures.postures import STROKES
from figures.skeleton import Skeleton, skeleton
from tpm_gym.analysis.decoupling import link_velocity, motors, over, shares
from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics import DEFAULT_ASSEMBLY, ELBOWS_OUT, forward, inverse
from tpm_gym.learning import figure_style as style
from tpm_gym.learning.figure_style import BLACK
from tpm_gym.mechanism import PAPER_TPM

TURNS = np.deg2rad([-4.0, 12.0, 8.0]) * np.eye(3)  # towards where all legs reach
_ASSEMBLY = DEFAULT_ASSEMBLY  # of the posture of the labelled figure
_STILL = "0.82"
_ROWS = ("$x_C$", "$z_C$", "β", "x", "y", "z")


def turned(motor: int) -> Skeleton:
    """Return the posture of the labelled figure with one motor turned."""
    theta = skeleton(POINT, ELBOWS_OUT, DRAWN).theta
    position = forward(theta + TURNS[motor], _ASSEMBLY, DRAWN)
    return skeleton(position, ELBOWS_OUT, DRAWN)


def table() -> tuple[FloatArray, FloatArray]:
    """Compute mean shares (6, 3) and numbers of motors (6,) over the task region."""
    index = over(PAPER_TPM.region)
    low, high = np.array(PAPER_TPM.region.low), np.array(PAPER_TPM.region.high)
    cells = np.stack(np.meshgrid(*[np.arange(9)] * 3), axis=-1).reshape(-1, 3)
    links = link_velocity(inverse(low + (cells + 0.5) / 9 * (high - low)))
    return (
        np.concatenate([shares(links).mean(axis=0), index.shares]),
        np.concatenate([motors(links).mean(axis=0), index.motors]),
    )


def motors_figure() -> Figure:
    """Draw a column for each motor: the links that it moves, and its shares."""
    figure = Figure(figsize=(style.WIDTH, 4.4))
    at = {"ha": "center", "va": "top"}
    figure.text(0.5, 0.985, "Which motor moves what", fontsize=11, weight="bold", **at)
    what = "each motor turned alone, from the grey posture (4, 12 and 8°; not to scale)"
    figure.text(0.5, 0.94, what, fontsize=8.5, **at)
    lefts, width = (0.115, 0.375, 0.635), 0.25
    for motor, left in enumerate(lefts):
        _posture(figure.add_axes((left - 0.01, 0.44, width + 0.02, 0.43)), motor)
    values, counts = table()
    axes = figure.add_axes((lefts[0], 0.06, lefts[2] + width - lefts[0], 0.36))
    _table(axes, values, counts)
    return figure


def _posture(axes: Axes, motor: int) -> None:
    still, moved = skeleton(POINT, ELBOWS_OUT, DRAWN), turned(motor)
    base = DRAWN.l1 * np.array([(1, 1, 0), (-1, 1, 0), (-1, -1, 0), (1, -1, 0)])
    axes.fill(*project(base).T, facecolor="0.95", edgecolor="0.8", linewidth=0.5)
    before, after = still.links(), moved.links()
    offsets = {name: ("0.35", 1.4) for name in before if name.startswith("offset")}
    for name, (colour, width) in (STROKES | offsets).items():
        old, new = (np.stack(links[name][:2]) for links in (before, after))
        axes.plot(*project(old).T, color=_STILL, linewidth=width, solid_capstyle="round")
        if np.abs(old - new).max() > 1e-9:
            axes.plot(
                *project(new).T, color=colour, linewidth=width, zorder=3, solid_capstyle="round"
            )
    p = project(moved.f1 + (DRAWN.l2, 0, 0))
    axes.plot(*project(POINT), "o", color="0.6", markersize=3.5, zorder=4)
    axes.plot(*p, "o", color=BLACK, markersize=3.5, zorder=4)
    axes.set_title(f"motor {motor + 1}", fontsize=9)
    axes.set(xlim=(-0.68, 0.76), ylim=(-0.18, 0.84))
    axes.set_aspect("equal")
    axes.axis("off")


def _table(axes: Axes, values: FloatArray, counts: FloatArray) -> None:
    """Draw the shares as numbers on shades; structural zeros are white."""
    axes.imshow(np.ma.masked_equal(values, 0.0), cmap="Blues", vmin=0.0, vmax=1.4, aspect="auto")
    for (row, motor), value in np.ndenumerate(values):
        text = f"{100 * value:.0f}%" if value else "nothing"
        axes.text(motor, row, text, ha="center", va="center", color="0.5" if not value else BLACK)
    for row, count in enumerate(counts):
        axes.text(2.62, row, f"{count:.1f}", ha="left", va="center")
    axes.text(2.62, -0.95, "motors\nthat count", ha="left", va="center", fontsize=7)
    axes.set(xticks=[], yticks=range(6), yticklabels=_ROWS)
    axes.tick_params(length=0)
    axes.axhline(2.5, color="white", linewidth=4)
    names = ("link 3'", 0.5), ("link 7", 2.0), ("P", 4.0)
    for name, row in names:
        axes.text(-0.72, row, name, ha="right", va="center", weight="bold")
    for spine in axes.spines.values():
        spine.set_visible(False)
    note = "its share in the motion of each coordinate; all numbers are means over the task region"
    axes.set_xlabel(note, labelpad=5)
