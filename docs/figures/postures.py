"""Figure of the 16 inverse postures of one point."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from figures.sections import MM, heading
from figures.skeleton import seen_from, skeleton
from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics import ELBOWS_OUT, WorkingMode
from tpm_gym.learning import figure_style as style
from tpm_gym.learning.figure_style import BLACK, BLUE, GREEN, ORANGE, PURPLE, VERMILLION

POINT = np.array([-0.020, 0.025, 0.750])  # m; the middle of what the environments use
_AZIMUTH = np.deg2rad(-58.0)  # of the eye, hanging machine

# Link -> colour and width. The offsets l6 are too short to be seen.
_LEG1, _LEG2, _LEG3 = VERMILLION, GREEN, BLUE
STROKES: dict[str, tuple[str, float]] = {
    "rod 4a": (_LEG1, 1.0),
    "rod 4b": (_LEG1, 1.0),
    "link 3": (_LEG1, 1.6),
    "arm 1": (_LEG1, 2.6),
    "rod 6": (_LEG2, 1.0),
    "arm 2": (_LEG2, 2.6),
    "rod 11a": (_LEG3, 1.0),
    "rod 11b": (_LEG3, 1.0),
    "link 9": (_LEG3, 1.6),
    "link 10": (_LEG3, 1.6),
    "arm 3": (_LEG3, 2.6),
    "link 3'": (BLACK, 2.0),
    "link 7": (ORANGE, 2.6),
    "platform": (PURPLE, 2.6),
}


def project(points: FloatArray) -> FloatArray:
    """Project points (..., 3) m to (..., 2) m, hanging: z of the paper points down.

    The eye is on the side of leg 1, a little to the right of it.
    """
    return seen_from(_AZIMUTH, points * (1.0, -1.0, -1.0))  # a half turn about x


def postures_figure() -> Figure:
    """Draw all working modes of one point: rows by leg 1, columns by legs 2 and 3."""
    figure = Figure(figsize=(style.WIDTH, 8.5))
    x, y, z = (f"{value * MM:.0f}".replace("-", "\N{MINUS SIGN}") for value in POINT)
    what = f"P at x = {x}, y = {y}, z = {z} mm; z points down"
    heading(figure, "The 16 inverse postures of one point", what, 0.988, 0.963)
    for group, cos_beta in enumerate((1, -1)):
        bottom = 0.503 - 0.45 * group
        plan = figure.add_axes((0.30, bottom + 0.375, 0.55, 0.05))
        _draw_plan(plan, cos_beta)
        text = f"cos β {'>' if cos_beta > 0 else '<'} 0\nseen along z,\nenlarged"
        figure.text(0.27, bottom + 0.40, text, ha="right", va="center", fontsize=8)
        for row, leg1 in enumerate((1, -1)):
            for column, (leg2, leg3) in enumerate(((-1, 1), (-1, -1), (1, 1), (1, -1))):
                rect = (0.015 + 0.2445 * column, bottom + 0.185 * (1 - row), 0.236, 0.178)
                _draw_posture(figure.add_axes(rect), WorkingMode(cos_beta, leg1, leg2, leg3))
    legend(figure)
    return figure


def _draw_posture(axes: Axes, mode: WorkingMode) -> None:
    """Draw one posture; the frame is heavy if all elbows point outwards."""
    posture = skeleton(POINT, mode)
    pivots = project(posture.a) * MM
    base = pivots[[1, 0, 2, 1]]
    axes.fill(*base.T, facecolor="0.9", edgecolor="0.6", linewidth=0.6)
    links = posture.links()
    for name, (colour, width) in STROKES.items():
        ends = project(np.stack(links[name][:2])) * MM
        axes.plot(*ends.T, color=colour, linewidth=width, solid_capstyle="round")
    joints = project(np.concatenate([posture.b, posture.c])) * MM
    axes.plot(*joints.T, "o", color="white", markeredgecolor=BLACK, markersize=2.4, mew=0.5)
    axes.plot(*pivots.T, "s", color=BLACK, markersize=3.4)
    axes.plot(*(project(POINT) * MM), "o", color=BLACK, markersize=2.4)
    axes.set(xlim=(-620, 605), ylim=(-860, 160), xticks=[], yticks=[])
    axes.set_aspect("equal")
    signs = ["+" if sign > 0 else "\N{MINUS SIGN}" for sign in (mode.leg1, mode.leg2, mode.leg3)]
    axes.text(0.03, 0.03, "legs " + " ".join(signs), transform=axes.transAxes, fontsize=8)
    out = (mode.leg1, mode.leg2, mode.leg3) == (ELBOWS_OUT.leg1, ELBOWS_OUT.leg2, ELBOWS_OUT.leg3)
    if out:
        heavy = {"transform": axes.transAxes, "ha": "right", "fontsize": 7.5, "weight": "bold"}
        axes.text(0.97, 0.92, "elbows out", **heavy)
        if mode == ELBOWS_OUT:
            axes.text(0.97, 0.03, "environments", **heavy)
    for spine in axes.spines.values():
        spine.set(linewidth=2.0 if out else 0.5, color=BLACK if out else "0.6")


def _draw_plan(axes: Axes, cos_beta: int) -> None:
    """Draw link 3', link 7 and the platform along z, where the two signs of cos(beta) differ."""
    posture = skeleton(POINT, WorkingMode(cos_beta, 1, -1, 1))
    links = posture.links()
    for name in ("link 3'", "link 7", "platform"):
        ends = np.stack(links[name][:2])[:, :2] * MM
        axes.plot(*ends.T, color=STROKES[name][0], linewidth=3.0, solid_capstyle="round")
    for joint in (posture.d1, posture.e1):
        axes.plot(
            *(joint[:2] * MM), "o", color="white", markeredgecolor=BLACK, markersize=4, mew=0.7
        )
    axes.plot(*(POINT[:2] * MM), "o", color=BLACK, markersize=4)
    axes.annotate("P", POINT[:2] * MM, (0, 5), textcoords="offset points", ha="center")
    axes.set(xlim=(-360, 160), ylim=(-18, 45))
    axes.set_aspect("equal", anchor="W")
    axes.axis("off")


def legend(figure: Figure) -> None:
    """Draw the legend of the colours at the bottom."""
    names = (
        ("leg 1: arm 2, link 3, rods 4", _LEG1),
        ("leg 2: arm 5, rod 6", _LEG2),
        ("leg 3: arm 12, links 9 and 10, rods 11", _LEG3),
        ("link 3'", BLACK),
        ("link 7", ORANGE),
        ("platform 1", PURPLE),
    )
    handles = [Line2D([], [], color=colour, linewidth=2.4, label=name) for name, colour in names]
    for marker, name in (("s", "A1, A2, A3 on base 0"), ("o", "P")):
        handles.append(
            Line2D([], [], linestyle="", marker=marker, color=BLACK, markersize=4, label=name)
        )
    figure.legend(
        handles=handles,
        loc="lower center",
        ncols=4,
        bbox_to_anchor=(0.5, 0.0),
        fontsize=7,
        columnspacing=1.2,
        handlelength=1.4,
    )
