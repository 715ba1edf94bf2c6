"""Figs. 4 and 5 of the paper, in Cartesian space, for the case study and the elbows-out mode."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d import Axes3D

from figures import surfaces
from figures.sections import MM, heading, mode_name, outline_task_region, section_axes
from figures.surfaces import Surface
from figures.zero_sets import (
    Section,
    parallel_lines,
    reach_margin,
    serial_lines,
    serial_squares,
    sheets,
)
from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.kinematics import ELBOWS_OUT, WORKING_MODES
from tpm_gym.kinematics.geometry import PAPER
from tpm_gym.learning import figure_style as style
from tpm_gym.learning.figure_style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    OUTLINE,
    PURPLE,
    REACHED,
    VERMILLION,
)
from tpm_gym.mechanism import PAPER_TPM

PARALLEL = (
    (BLUE, "$\\sin\\beta = 0$:\nlink 7 lies along x; the plane y = 0"),
    (
        VERMILLION,
        "$l_1 + l_3\\cos\\theta_3 - x_C - 2l_2 = 0$:\n"
        "seen along z, rods 11 are parallel to\nlink 7, and β is free with motors locked",
    ),
    (
        GREEN,
        "$x_C(z_C - l_3\\sin\\theta_2) - (z_C - l_3\\sin\\theta_1)$\n"
        "$\\times(x_C - 2l_5 + l_1 - l_3\\cos\\theta_2) = 0$:\n"
        "seen along y, $B_1C_1$ and $B_2C_2$ are parallel",
    ),
    (
        PURPLE,
        "$z_C - l_3\\sin\\theta_1 = 0$, not in the paper:\n"
        "rods 4 lie level, and link 3' may turn about y",
    ),
)
SERIAL = (
    (BLUE, "$\\cos\\beta = 0$:\nlink 7 lies along y; y = ±l7 = ±50 mm"),
    (
        ORANGE,
        "$B_1C_1\\cdot\\partial B_1/\\partial\\theta_1 = 0$: leg 1,\n"
        "seen along x, arm and rods line up",
    ),
    (GREEN, "$B_2C_2\\cdot\\partial B_2/\\partial\\theta_2 = 0$: leg 2,\narm and rod line up"),
    (
        PURPLE,
        "$B_3C_3\\cdot\\partial B_3/\\partial\\theta_3 = 0$: leg 3,\n"
        "seen along y, arm and rods line up",
    ),
)

_X, _Z = np.linspace(-0.92, 1.06, 199), np.linspace(-1.18, 1.22, 241)
_Y = np.linspace(-0.0529, 0.0529, 60)  # an even number: y = 0 itself is not sampled
_ALONG = np.linspace(_X[0], _X[-1], 2000)  # for what runs along the edge of the reach
_FINE = np.linspace(_X[0], _X[-1], 793), np.linspace(_Z[0], _Z[-1], 961)  # for what is cheap
_LIMITS_X, _LIMITS_Z = (-900.0, 1050.0), (-1180.0, 1220.0)
_SIGN = ELBOWS_OUT.cos_beta
_INSIDE = (1.0, 1.0 - 1e-9, 1.0)  # a surface that ends at y = +-l7 ends just inside


def parallel_figure() -> Figure:
    """Draw the paper's Fig. 4: the zeros of the factors of Eq. (16) and of the constraint."""
    figure, space, sections, plans = _layout("Parallel and constraint singularities")
    _draw_parallel(space)
    _legend(figure, PARALLEL)
    for axes, y in zip(sections, (0.0, 0.025, 0.048), strict=False):
        section = Section("y", y)
        _reached(axes, section, PARALLEL[0][0] if y == 0 else None)
        for index in (1, 2, 3):
            # At y = 0 the sign of sin(beta) is lost, so take the limit.
            near = Section("y", max(y, 1e-5))
            _lines(axes, parallel_lines(index, ELBOWS_OUT, near, _X, _Z), PARALLEL[index][0])
        title = "y = 0: all singular" if y == 0 else f"y = {y * MM:.0f} mm"
        _finish_section(axes, section, title, sections[0] is axes)
    _all_modes(sections[3], Section("y", 0.025))
    for axes, z in zip(plans, (0.750, 0.300, -0.440), strict=True):
        section = Section("z", z)
        _reached(axes, section, None)
        for index in range(4):
            lines = parallel_lines(index, ELBOWS_OUT, section, _ALONG, _Y)
            _lines(axes, lines, PARALLEL[index][0])
        _finish_section(
            axes, section, f"z = {z * MM:.0f} mm".replace("-", "\N{MINUS SIGN}"), plans[0] is axes
        )
    return figure


def serial_figure() -> Figure:
    """Draw the paper's Fig. 5: the zeros of the factors of Eq. (17)."""
    figure, space, sections, plans = _layout("Serial singularities, det B = 0")
    _draw_serial(space)
    _legend(figure, SERIAL)
    cases = ((0.0, _SIGN), (0.025, _SIGN), (PAPER.l7, _SIGN), (0.025, -_SIGN))
    for axes, (y, sign) in zip(sections, cases, strict=True):
        section = Section("y", y)
        singular = y == PAPER.l7
        _reached(axes, section, SERIAL[0][0] if singular else None, sign)
        for index in (1, 2, 3):
            _lines(axes, serial_lines(index, sign, section, *_FINE), SERIAL[index][0])
        title = f"y = {y * MM:.0f} mm" + (": all singular" if singular else "")
        title += "" if sign == _SIGN else ", cos β < 0"
        _finish_section(axes, section, title, sections[0] is axes, sign == _SIGN)
    for axes, z in zip(plans, (0.750, 0.100, -0.400), strict=True):
        section = Section("z", z)
        _reached(axes, section, None)
        for index in range(4):
            _lines(axes, serial_lines(index, _SIGN, section, _X, _Y), SERIAL[index][0])
        _finish_section(
            axes, section, f"z = {z * MM:.0f} mm".replace("-", "\N{MINUS SIGN}"), plans[0] is axes
        )
    return figure


def _draw_parallel(space: Axes3D) -> None:
    """Draw the plane y = 0, and the other factors swept along y behind and in front of it."""
    plane = Surface(surfaces.plate(0.0, _SIGN, _X, _Z), PARALLEL[0][0], 0.30)
    behind: list[Surface] = []
    front: list[Surface] = []
    y0 = 0.025
    for index in (1, 2, 3):

        def exists(points: FloatArray, index: int = index) -> BoolArray:
            return np.isfinite(sheets(points * _INSIDE, ELBOWS_OUT)[..., index])

        for line in parallel_lines(index, ELBOWS_OUT, Section("y", y0), _X, _Z):
            mesh = surfaces.sweep(line, y0, surfaces.levels(), _SIGN)
            parts = surfaces.halves(surfaces.trimmed(mesh, exists))
            for found, part in zip((behind, front), parts, strict=True):
                found.append(Surface(part, PARALLEL[index][0]))
    surfaces.draw(space, (behind, [plane], front))
    for y, index in product((-PAPER.l7, PAPER.l7), (1, 2, 3)):
        for line in serial_lines(index, _SIGN, Section("y", y), *_FINE):
            points = Section("y", y).points(line) * MM
            space.plot(*points.T, color=OUTLINE, linewidth=0.6, zorder=-1 if y > 0 else 9)


def _draw_serial(space: Axes3D) -> None:
    """Draw the planes y = +-l7, and between them the edges of the legs' reach."""
    far, near = (
        Surface(surfaces.plate(y, _SIGN, _X, _Z), SERIAL[0][0], alpha)
        for y, alpha in ((PAPER.l7, 0.35), (-PAPER.l7, 0.18))
    )
    between = []
    for index in (1, 2, 3):

        def reached(points: FloatArray, index: int = index) -> BoolArray:
            others = np.delete(serial_squares(points * _INSIDE, _SIGN), index, axis=-1)
            result: BoolArray = np.all(others >= 0, axis=-1)
            return result

        # Not clipped at y = 0: elsewhere another part of the edge may be this leg's.
        for line in serial_lines(index, _SIGN, Section("y", 0.0), _X, _Z, clipped=False):
            if index == 3:
                mesh = surfaces.sweep_leg3(line, 0.0, surfaces.levels())
            else:
                mesh = surfaces.sweep(line, 0.0, surfaces.levels(), _SIGN)
            between.append(Surface(surfaces.trimmed(mesh, reached), SERIAL[index][0]))
    surfaces.draw(space, ([far], between, [near]))


def _layout(title: str) -> tuple[Figure, Axes3D, list[Axes], list[Axes]]:
    """Build axes: space on top, four x-z sections below it, three x-y sections at the bottom."""
    figure = Figure(figsize=(style.WIDTH, 8.7))
    what = f"elbows-out working mode ({mode_name(ELBOWS_OUT)})"
    heading(figure, title, what, 0.982, 0.957)
    space = figure.add_axes((0.0, 0.55, 0.58, 0.39), projection="3d")
    surfaces.frame(space, _LIMITS_X, _LIMITS_Z)
    sections: list[Axes] = []
    plans: list[Axes] = []
    for column in range(4):
        share = sections[0] if sections else None
        axes = figure.add_axes((0.085 + 0.232 * column, 0.235, 0.208, 0.25), sharey=share)
        sections.append(axes)
    for column in range(3):
        share = plans[0] if plans else None
        plans.append(figure.add_axes((0.085 + 0.312 * column, 0.052, 0.278, 0.115), sharey=share))
    return figure, space, sections, plans


def _reached(axes: Axes, section: Section, colour: str | None, sign: int = _SIGN) -> None:
    """Shade the reachable set, in a factor's colour where all of it is singular."""
    other = _Z if section.fixed == "y" else np.linspace(-PAPER.l7, PAPER.l7, 241)
    plane = np.stack(np.meshgrid(_X, other), axis=-1)
    margin = reach_margin(section.points(plane), sign)
    xy = (_X * MM, other * MM, margin)
    axes.contourf(*xy, levels=[0, np.inf], colors=[colour or REACHED], alpha=0.3 if colour else 1)
    axes.contour(*xy, levels=[0], colors=[OUTLINE], linewidths=0.6)


def _lines(axes: Axes, lines: Sequence[FloatArray], colour: str, width: float = 1.6) -> None:
    for line in lines:
        axes.plot(*(line.T * MM), color=colour, linewidth=width, solid_capstyle="butt")


def _all_modes(axes: Axes, section: Section) -> None:
    """Draw the union over all working modes, as elimination of the joint angles gives it."""
    for sign in (-1, 1):
        _reached(axes, section, None, sign)
    fine = np.linspace(_X[0], _X[-1], 400), np.linspace(_Z[0], _Z[-1], 480)
    # The second factor does not feel the bends of legs 1 and 2, the third not that of leg 3, the
    # constraint's feels that of leg 1 only.
    level3 = [(1, mode) for mode in WORKING_MODES if mode.leg1 == mode.leg2 == 1]
    planar = [(2, mode) for mode in WORKING_MODES if mode.leg3 == 1]
    elevation = [(3, mode) for mode in WORKING_MODES if mode.leg2 == mode.leg3 == 1]
    for index, mode in level3 + planar + elevation:
        lines = parallel_lines(index, mode, section, *fine)
        _lines(axes, lines, PARALLEL[index][0], 0.8)
    _finish_section(axes, section, f"y = {section.at * MM:.0f} mm, all 16 modes", False, False)


def _finish_section(
    axes: Axes, section: Section, title: str, first: bool, ours: bool = True
) -> None:
    """Set up the axes of a section, with the task region if the section cuts it."""
    vertical = "z" if section.fixed == "y" else "y"
    section_axes(axes, title, "x", vertical)
    row = 1 if section.fixed == "y" else 2
    low, high = PAPER_TPM.region.low[row], PAPER_TPM.region.high[row]
    if ours and low <= section.at <= high:
        outline_task_region(axes, vertical, inside=True)
    axes.set_xlim(_LIMITS_X)
    axes.set_xticks([-500, 0, 500, 1000])
    if section.fixed == "y":
        axes.plot([-300, 300], [0, 0], color=BLACK, linewidth=1.8, solid_capstyle="butt")
        axes.set_ylim(_LIMITS_Z)
        axes.set_aspect("equal")
    else:
        axes.set_ylim(-56, 56)
        axes.set_yticks([-50, 0, 50])
    if not first:
        axes.set_ylabel("")
        axes.tick_params(labelleft=False)


def _legend(figure: Figure, factors: Sequence[tuple[str, str]]) -> None:
    handles: list[Patch | Line2D] = [Patch(color=colour, label=text) for colour, text in factors]
    handles += [
        Patch(facecolor=REACHED, edgecolor=OUTLINE, label="reachable set (sections)"),
        Line2D([], [], color=BLACK, linewidth=1.0, label="task region of the environments"),
        Line2D([], [], color=BLACK, linewidth=1.8, label="base, A2 to A3 (x-z sections)"),
    ]
    legend = figure.legend(
        handles=handles,
        loc="center right",
        bbox_to_anchor=(0.995, 0.74),
        labelspacing=1.1,
        handlelength=1.4,
        borderpad=0.8,
    )
    legend.set_title("y is drawn 6 times too long in space,\nand stretched in the x-y sections")
    legend.get_title().set_fontsize(7.5)
