"""Figure of the two operation modes: postures, the surface where they meet, and the workspace."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike

from figures.postures import STROKES
from figures.sections import MM, heading, outline_task_region, section_axes
from figures.zero_sets import Section, reach_margin
from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics import (
    DEFAULT_ASSEMBLY,
    RotatedPostures,
    forward_all,
    forward_rotated,
    inverse_all,
)
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.kinematics.rotated import inverse_rotated, link3_rotated
from tpm_gym.learning import figure_style as style
from tpm_gym.learning.figure_style import BLACK, BLUE, OUTLINE, PURPLE, VERMILLION
from tpm_gym.mechanism import PAPER_TPM

THETA = np.deg2rad([90.0, 180.0, 100.0])  # of the drawn postures, and of the path
HEIGHT = 0.025  # m, value of y of the section
_HALO = withStroke(linewidth=2.5, foreground="white")  # names stay readable where rods cross


@np.errstate(all="ignore")
def transition(
    theta_1: ArrayLike, beta: ArrayLike, side: ArrayLike = -1, geometry: Geometry = PAPER
) -> FloatArray:
    """Compute points P (..., 3) m of the surface on which both modes meet.

    Angles (...,) rad and ``side`` (...,), the sign of xC, broadcast. The surface is a curve of C1,
    on which rods 4a and 4b are level in x, swept by link 7. NaN where rods 4 do not reach y = 0;
    that arms 2 and 3 reach is not checked.
    """
    g, (one, turn) = geometry, (np.asarray(theta_1), np.asarray(beta))
    x_c = np.asarray(side) * np.sqrt(g.l4**2 - (g.l1 + g.l3 * np.cos(one)) ** 2)
    x, y = x_c + g.l7 * np.cos(turn) + g.l2, g.l7 * np.sin(turn)
    return np.stack(np.broadcast_arrays(x, y, g.l3 * np.sin(one) + 2 * g.l6), axis=-1)


def level_posture(theta: FloatArray) -> RotatedPostures:
    """Return the environments' assembly at theta (3,) rad, as a posture whose tilt is 0."""
    found, slot = forward_all(theta), DEFAULT_ASSEMBLY.index
    beta = np.asarray(found.beta[slot])
    return RotatedPostures(theta, found.link3[slot], np.zeros(()), beta, PAPER)


def turned_posture(theta: FloatArray) -> RotatedPostures:
    """Return the first assembly with link 3' turned and y > 0 at theta (3,) rad."""
    found = forward_rotated(theta)
    slot = int(np.flatnonzero(found.valid & (found.beta > 0))[0])
    return RotatedPostures(theta, found.link3[slot], found.tilt[slot], found.beta[slot], PAPER)


def meeting_posture(theta_1: float, beta: float) -> RotatedPostures:
    """Return a posture that belongs to both modes, with arm 5 bent outwards."""
    point = transition(theta_1, beta)
    found = inverse_all(point)
    apart = np.abs(found.theta[:, 0] - theta_1) + np.abs(found.beta - beta)
    slot = int(np.flatnonzero(found.valid & (apart < 1e-9))[1])  # the first has it inwards
    c1 = np.array([point[0] - PAPER.l2 - PAPER.l7 * np.cos(beta), point[2] - 2 * PAPER.l6])
    return RotatedPostures(found.theta[slot], c1, np.zeros(()), np.asarray(beta), PAPER)


def operation_modes_figure() -> Figure:
    """Draw three postures, tilts along a path, the joint space and a section of the workspace."""
    figure = Figure(figsize=(style.WIDTH, 8.3))
    heading(figure, "Two operation modes", "z points down, as the robot hangs", 0.988, 0.962)
    drawn = (
        ("translating: rods 4 parallel", level_posture(THETA)),
        ("both modes meet: rods 4 in line", meeting_posture(THETA[0], 0.6)),
        ("rotated: rods 4 crossed", turned_posture(THETA)),
    )
    for column, (title, posture) in enumerate(drawn):
        axes = figure.add_axes((0.02 + 0.325 * column, 0.625, 0.31, 0.285))
        _draw(axes, posture)
        axes.set_title(f"{'abc'[column]}  {title}")
    _legend(figure)
    _along_path(figure.add_axes((0.085, 0.385, 0.37, 0.165)))
    _joint_space(figure.add_axes((0.085, 0.115, 0.37, 0.185)))
    _section(figure, figure.add_axes((0.565, 0.115, 0.305, 0.435)))
    return figure


def _draw(axes: Axes, posture: RotatedPostures) -> None:
    """Draw a posture seen along y, with the base at the top."""
    g, half = PAPER, np.array([PAPER.l5, 0.0, 0.0])
    rods, ends = posture.rods, posture.ends
    feet = ends - rods
    c1 = (ends[0] + ends[1]) / 2
    e1 = c1 + posture.orientation @ [g.l7 * np.cos(posture.beta), 0.0, g.l6]
    pivots = np.array([[0.0, g.l1, 0.0], [-g.l1, 0.0, 0.0], [g.l1, 0.0, 0.0]])
    links = {
        "rod 11a": (feet[3], ends[3]),
        "rod 6": (feet[2], ends[2]),
        "arm 1": (pivots[0], feet[0] - half),
        "arm 2": (pivots[1], feet[2]),
        "arm 3": (pivots[2], feet[3]),
        "rod 4a": (feet[0], ends[0]),
        "rod 4b": (feet[1], ends[1]),
        "link 3": (feet[0], feet[1]),
        "link 3'": (ends[2], ends[0]),
        "platform": (e1, ends[3]),
    }
    for name, places in links.items():
        colour, width = STROKES[name]
        x, _, z = np.array(places).T * MM
        axes.plot(x, z, color=colour, linewidth=1.25 * width, solid_capstyle="round")
    x, _, z = np.concatenate([feet, ends]).T * MM
    axes.plot(x, z, "o", color="white", markeredgecolor=BLACK, markersize=3, mew=0.6)
    x, _, z = pivots.T * MM
    axes.plot(x, z, "s", color=BLACK, markersize=4)
    for name, place, offset in (
        ("4a", feet[0] + 0.3 * rods[0], (-6, -10)),
        ("4b", feet[1] + 0.1 * rods[1], (-15, 3)),
        ("3", feet[0], (3, 5)),
        ("3'", (ends[1] + ends[2]) / 2, (-8, -13)),
    ):
        axes.annotate(name, (place[0] * MM, place[2] * MM), offset, textcoords="offset points",
                      fontsize=8, weight="bold", path_effects=[_HALO])  # fmt: skip
    axes.set(xlim=(-990, 460), ylim=(960, -390), xticks=[], yticks=[])
    axes.set_aspect("equal")


def _legend(figure: Figure) -> None:
    names = (
        ("leg 1: arm 2, links 3, rods 4a and 4b", "rod 4a"),
        ("leg 2: arm 5, rod 6", "rod 6"),
        ("leg 3: arm 12, rods 11", "arm 3"),
        ("link 3'", "link 3'"),
        ("platform", "platform"),
    )
    handles = [Line2D([], [], color=STROKES[n][0], linewidth=2, label=text) for text, n in names]
    figure.legend(handles=handles, loc="upper center", ncols=5, bbox_to_anchor=(0.5, 0.622),
                  columnspacing=1.2, handlelength=1.5)  # fmt: skip


def _along_path(axes: Axes) -> None:
    """Draw the tilts of link 3' against theta_2, with theta_1 of the postures."""
    theta_2 = np.linspace(0.0, 2 * np.pi, 2881)
    theta = np.stack(np.broadcast_arrays(THETA[0], theta_2, THETA[2]), axis=-1)
    degrees, turned = np.degrees(theta_2), np.degrees(link3_rotated(theta)[1])
    meets, level = meeting_terms(np.asarray(THETA[0]), theta_2)
    line = np.where(level >= 0, 0.0, np.nan)
    axes.plot(degrees, line, color=BLUE, linewidth=1.8, label="translating")
    for slot in range(4):
        # Where the tilt passes 180 degrees, or a slot is another posture, the line ends.
        jump = np.abs(np.diff(turned[:, slot], prepend=np.nan)) > 20
        label = "rotated" if slot == 0 else None
        line = np.where(jump, np.nan, turned[:, slot])
        axes.plot(degrees, line, color=VERMILLION, linewidth=1.2, label=label)
    crossed = np.flatnonzero(np.sign(meets[:-1]) != np.sign(meets[1:]))
    axes.plot(degrees[crossed], 0 * crossed, "o", color=PURPLE, markeredgecolor=BLACK,
              markersize=4.5, mew=0.6, zorder=5, linestyle="none", label="both meet")  # fmt: skip
    axes.annotate("b", (degrees[crossed][2], 0), (4, 4), textcoords="offset points", fontsize=8)
    for name, tilt in (("a", 0.0), ("c", float(np.degrees(turned_posture(THETA).tilt)))):
        at = np.degrees(THETA[1])
        axes.plot(at, tilt, "o", color="white", markeredgecolor=BLACK, markersize=4.5, zorder=6)
        axes.annotate(name, (at, tilt), (4, 4), textcoords="offset points", fontsize=8)
    axes.set(xlim=(0, 360), ylim=(-180, 180), xlabel="θ2 (°)", ylabel="tilt of link 3' (°)")
    axes.set(xticks=range(0, 361, 90), yticks=range(-180, 181, 90))
    axes.set_title(f"d  all tilts of link 3' for θ1 = {np.degrees(THETA[0]):.0f}°")
    axes.legend(loc="lower right", bbox_to_anchor=(0.94, 0.0), fontsize=6, handlelength=1.4)


def meeting_terms(theta_1: FloatArray, theta_2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two terms, m^4: 0 where both modes meet; >= 0 where the circles of Eq. (6) meet."""
    g = PAPER
    y_b, z_b = g.l1 + g.l3 * np.cos(theta_1), g.l3 * np.sin(theta_1)
    level, rise = g.l3 * np.cos(theta_2) - g.l1 + 2 * g.l5, g.l3 * np.sin(theta_2) - z_b
    apart2, reach2 = level**2 + rise**2, g.l4**2 - y_b**2
    square = (apart2 - y_b**2) ** 2
    return square - 4 * reach2 * level**2, 4 * reach2 * apart2 - square


def _joint_space(axes: Axes) -> None:
    """Draw the number of tilts of link 3' over joint space, and the curve where both modes meet."""
    one, two = np.linspace(-np.pi, np.pi, 361), np.linspace(0.0, 2 * np.pi, 361)
    grid = np.meshgrid(one, two)
    theta = np.stack([*grid, np.zeros_like(grid[0])], axis=-1)
    count = np.isfinite(link3_rotated(theta)[1]).sum(axis=-1)
    degrees = np.degrees(one), np.degrees(two)
    axes.pcolormesh(*degrees, count // 2, cmap=ListedColormap(_COUNTS), vmin=0, vmax=2)
    meets, level = meeting_terms(*grid)
    axes.contour(*degrees, level, [0], colors=[BLUE], linewidths=1.0)
    meets = np.where(count > 0, meets, np.nan)
    axes.contour(*degrees, meets, [0], colors=[PURPLE], linewidths=1.4)
    first, second = PAPER_TPM.mechanism.motors[:2]
    low, high = np.degrees([first.lower, second.lower]), np.degrees([first.upper, second.upper])
    axes.add_patch(Rectangle(low, *(high - low), fill=False, edgecolor=BLACK, linewidth=1.0))
    axes.plot(*np.degrees(THETA[:2]), "o", color="white", markeredgecolor=BLACK, markersize=4.5)
    axes.annotate("a, c", np.degrees(THETA[:2]), (-5, 5), textcoords="offset points", fontsize=8,
                  ha="right")  # fmt: skip
    axes.axvline(np.degrees(THETA[0]), color="0.4", linewidth=0.7, linestyle=(0, (3, 2)))
    axes.set(xlim=(-180, 180), ylim=(0, 360), xticks=range(-180, 181, 90),
             yticks=range(0, 361, 90), xlabel="θ1 (°)", ylabel="θ2 (°)")  # fmt: skip
    axes.set_title("e  tilted postures of link 3'")
    handles = [
        *(Patch(facecolor=colour, edgecolor="0.6", label=label)
          for colour, label in zip(_COUNTS, ("none", "two", "four"), strict=True)),
        Line2D([], [], color=PURPLE, linewidth=1.4, label="both modes meet"),
        Line2D([], [], color=BLUE, linewidth=1.0, label="edge, translating"),
        Line2D([], [], color=BLACK, linewidth=1.0, label="motors' stops"),
    ]  # fmt: skip
    axes.legend(handles=handles, loc="upper center", ncols=3, bbox_to_anchor=(0.5, -0.24),
                fontsize=7, columnspacing=1.2, handlelength=1.5)  # fmt: skip


_COUNTS = ("#FFFFFF", "#DDDDDD", "#F0B44C")


def _section(figure: Figure, axes: Axes) -> None:
    """Draw the least tilt with which the rotated mode reaches a point, and the meeting surface."""
    x, z = np.linspace(-0.86, 1.0, 249), np.linspace(-1.16, 1.16, 311)
    points = Section("y", HEIGHT).points(np.stack(np.meshgrid(x, z), axis=-1))
    tilt = np.abs(inverse_rotated(points).tilt)
    least = np.degrees(np.where(np.isnan(tilt), np.inf, tilt).min(axis=-1))
    image = axes.pcolormesh(x * MM, z * MM, np.ma.masked_invalid(least), cmap="viridis_r", vmin=0,
                            vmax=180)  # fmt: skip
    both = np.maximum(reach_margin(points, 1), reach_margin(points, -1))
    axes.contour(x * MM, z * MM, both, [0], colors=[OUTLINE], linewidths=1.0)
    theta_1, angle = np.linspace(-np.pi, np.pi, 1441), np.arcsin(HEIGHT / PAPER.l7)
    for side in (1, -1):
        for beta in (angle, np.pi - angle):
            line = transition(theta_1, beta, side)
            reached = inverse_all(line).valid.any(axis=-1)
            line = np.where(reached[:, None], line, np.nan) * MM
            axes.plot(line[:, 0], line[:, 2], color=PURPLE, linewidth=1.4)
    axes.plot([-300, 300], [0, 0], color=BLACK, linewidth=1.8, solid_capstyle="butt")
    outline_task_region(axes, "z", inside=True)
    axes.set(xlim=(-860, 1000), ylim=(1160, -1160))
    axes.set_aspect("equal")
    section_axes(axes, f"f  y = {HEIGHT * MM:.0f} mm: smallest tilt of the rotated mode")
    handles = [
        Line2D([], [], color=PURPLE, linewidth=1.4, label="both modes meet"),
        Line2D([], [], color=OUTLINE, linewidth=1.0, label="edge, translating"),
        Line2D([], [], color=BLACK, linewidth=1.0, label="task region"),
    ]
    axes.legend(handles=handles, loc="upper center", ncols=3, bbox_to_anchor=(0.5, -0.115),
                fontsize=7, columnspacing=1.0, handlelength=1.5)  # fmt: skip
    bar = figure.add_axes((0.895, 0.16, 0.016, 0.335))
    figure.colorbar(image, cax=bar, ticks=range(0, 181, 30), label="smallest tilt (°)")
