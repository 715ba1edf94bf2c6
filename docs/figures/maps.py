"""Heatmaps of the conditioning, and the reachable set of the two kinds of working mode."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from figures.sections import MM, heading, mode_name, outline_task_region, section_axes
from figures.zero_sets import Section, reach_margin
from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics import ELBOWS_OUT
from tpm_gym.kinematics.geometry import PAPER
from tpm_gym.kinematics.workspace import conditioning_at
from tpm_gym.learning import figure_style as style
from tpm_gym.learning.figure_style import BLACK, BLUE, GREEN, OUTLINE, VERMILLION
from tpm_gym.mechanism import PAPER_TPM

HEIGHTS = (0.005, 0.012, 0.025, 0.040, 0.048)  # values of y, m
_SAFE = PAPER_TPM.safe_conditioning
_LOW, _HIGH = PAPER_TPM.region.low, PAPER_TPM.region.high
PROBES = (
    ((0.0, 0.75), BLUE, "-"),
    ((_LOW[0], _LOW[2]), VERMILLION, "--"),
    ((_HIGH[0], _HIGH[2]), GREEN, ":"),
)

_X, _Z = np.linspace(-0.78, 0.96, 436), np.linspace(0.42, 1.17, 188)
_TICKS = (0.0, 0.02, 0.05, _SAFE, 0.15, 0.25, 0.35, 0.5)


def conditioning_figure() -> Figure:
    """Draw 1/cond(J) in x-z sections, and along y."""
    figure = Figure(figsize=(style.WIDTH, 6.6))
    heading(figure, "Conditioning 1/cond(J)", f"elbows-out mode ({mode_name(ELBOWS_OUT)})")
    grid_x, grid_z = np.meshgrid(_X, _Z)
    norm = PowerNorm(0.5, vmin=0.0, vmax=_TICKS[-1], clip=True)  # room for the small values
    for number, y in enumerate(HEIGHTS):
        row, column = divmod(number, 2)
        axes = figure.add_axes((0.085 + 0.425 * column, 0.69 - 0.29 * row, 0.39, 0.205))
        points = np.stack([grid_x, np.full_like(grid_x, y), grid_z], axis=-1)
        value = conditioning_at(points)  # 0 where not reachable, as on the edge
        image = axes.pcolormesh(
            _X * MM, _Z * MM, np.ma.masked_equal(value, 0.0), cmap="viridis", norm=norm
        )
        axes.contour(_X * MM, _Z * MM, value, [_SAFE], colors="white", linewidths=1.4)
        axes.contour(
            _X * MM, _Z * MM, reach_margin(points, 1), [0], colors=[OUTLINE], linewidths=0.6
        )
        inside = PAPER_TPM.region.low[1] <= y <= PAPER_TPM.region.high[1]
        outline_task_region(axes, "z", inside)
        largest = float(value.max())
        section_axes(axes, f"y = {y * MM:.0f} mm, largest {largest:.3f}")
        axes.set_aspect("equal")
        if column:
            axes.set_ylabel("")
            axes.tick_params(labelleft=False)
    bar = figure.add_axes((0.912, 0.40, 0.018, 0.495))
    figure.colorbar(image, cax=bar, ticks=_TICKS, format="%g", label="1/cond(J)")
    bar.axhline(_SAFE, color="white", linewidth=1.4)
    _along_y(figure.add_axes((0.55, 0.115, 0.385, 0.20)))
    _conditioning_legend(figure)
    return figure


def _along_y(axes: Axes) -> None:
    """Draw the conditioning against y at three points of the task region."""
    y = np.linspace(0.0, PAPER.l7, 201)
    for (x, z), colour, dash in PROBES:
        points = np.stack([np.full_like(y, x), y, np.full_like(y, z)], axis=-1)
        label = f"x = {x * MM:.0f}, z = {z * MM:.0f} mm".replace("-", "\N{MINUS SIGN}")
        axes.plot(y * MM, conditioning_at(points), dash, color=colour, label=label)
    axes.axhline(_SAFE, color="0.5", linewidth=0.8)
    axes.axvspan(PAPER_TPM.region.low[1] * MM, PAPER_TPM.region.high[1] * MM, color="0.92")
    axes.set(xlim=(0, PAPER.l7 * MM), ylim=(0, None), xlabel="y (mm)", ylabel="1/cond(J)")
    axes.set_title("along y; shaded: the task region")
    axes.legend(loc="upper left", fontsize=6.5)


def _conditioning_legend(figure: Figure) -> None:
    handles = [
        Line2D([], [], color=BLACK, linewidth=1.0, label="task region"),
        Line2D(
            [],
            [],
            color=BLACK,
            linewidth=1.0,
            linestyle=(0, (3, 2)),
            label="the same, not in this section",
        ),
        Line2D(
            [],
            [],
            color="white",
            linewidth=1.4,
            label=f"{_SAFE}, the safe limit",
        ),
        Line2D([], [], color=OUTLINE, linewidth=0.8, label="edge of the reachable set"),
    ]
    legend = figure.legend(
        handles=handles, loc="lower center", ncols=4, bbox_to_anchor=(0.5, 0.0), columnspacing=1.4
    )
    legend.get_frame().set_facecolor("0.78")


def volume(cos_beta_sign: int, step: float = 0.005, slices: int = 32) -> float:
    """Compute the volume of the reachable set in m^3, by the midpoint rule on a grid."""
    x, z = np.arange(-1.2, 1.2, step) + step / 2, np.arange(-1.3, 1.3, step) + step / 2
    # Where |y| nears l7 the set moves fastest with y: sum over the angle of link 7 instead.
    angle = (np.arange(slices) + 0.5) / slices * np.pi / 2
    plane = np.stack(np.meshgrid(x, z), axis=-1)
    areas = [
        np.count_nonzero(
            reach_margin(Section("y", PAPER.l7 * np.sin(a)).points(plane), cos_beta_sign) > 0
        )
        for a in angle
    ]
    weights = PAPER.l7 * np.cos(angle) * (np.pi / 2 / slices)
    return float(2 * step * step * np.dot(areas, weights))


def workspace_figure() -> Figure:
    """Draw the two reachable sets, in sections and by volume."""
    figure = Figure(figsize=(style.WIDTH, 4.75))
    heading(figure, "Reachable set of point P", "all 16 working modes", 0.975, 0.93)
    x, z = np.linspace(-0.95, 1.06, 403), np.linspace(-1.18, 1.22, 481)
    sections = [Section("y", y) for y in (0.0, 0.030, 0.050)] + [Section("z", 0.750)]
    for column, section in enumerate(sections[:3]):
        axes = figure.add_axes((0.095 + 0.233 * column, 0.385, 0.21, 0.47))
        _compare(axes, section, x, z)
        section_axes(axes, f"y = ±{section.at * MM:.0f} mm" if section.at else "y = 0")
        axes.plot([-300, 300], [0, 0], color=BLACK, linewidth=1.8, solid_capstyle="butt")
        axes.set_aspect("equal")
        if column:
            axes.set_ylabel("")
            axes.tick_params(labelleft=False)
    axes = figure.add_axes((0.095, 0.1, 0.676, 0.155))
    y = np.linspace(-PAPER.l7, PAPER.l7, 201)
    _compare(axes, sections[3], x, y)
    section_axes(axes, "z = 750 mm (y stretched)", "x", "y")
    figure.legend(handles=_workspace_handles(), loc="upper left", bbox_to_anchor=(0.785, 0.865))
    note = "8 modes each: how\nthe legs are bent\nmakes no difference\nto where P can be"
    figure.text(0.795, 0.63, note, va="top", fontsize=7.5)
    return figure


def _compare(axes: Axes, section: Section, x: FloatArray, other: FloatArray) -> None:
    """Shade the parts that one kind of mode reaches, and those that both reach."""
    points = section.points(np.stack(np.meshgrid(x, other), axis=-1))
    plus, minus = reach_margin(points, 1), reach_margin(points, -1)
    xy = x * MM, other * MM
    parts = (
        (np.minimum(plus, minus), _BOTH),
        (np.minimum(plus, -minus), to_rgba(BLUE, 0.75)),
        (np.minimum(minus, -plus), to_rgba(VERMILLION, 0.75)),
    )
    for margin, colour in parts:
        if margin.max() > 0:
            axes.contourf(*xy, margin, [0, np.inf], colors=[colour])
    for margin in (plus, minus):
        axes.contour(*xy, margin, [0], colors=[BLACK], linewidths=0.5)


_BOTH = (0.88, 0.88, 0.88, 1.0)


def _workspace_handles() -> list[Patch | Line2D]:
    names = {1: "cos β > 0", -1: "cos β < 0"}
    colours = {1: to_rgba(BLUE, 0.75), -1: to_rgba(VERMILLION, 0.75)}
    return [
        Patch(color=_BOTH, label="both"),
        *(
            Patch(color=colours[sign], label=f"{name} only\n(in all {1e3 * volume(sign):.1f} dm³)")
            for sign, name in names.items()
        ),
        Line2D([], [], color=BLACK, linewidth=1.8, label="base, A2 to A3"),
    ]
