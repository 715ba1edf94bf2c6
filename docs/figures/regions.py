"""Figure of the aspects: regions of the elbows-out mode that no singularity divides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from string import ascii_uppercase

import numpy as np
from clearance import clear_of_links
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from figures.sections import MM, heading, mode_name, outline_task_region, section_axes
from figures.zero_sets import Section, parallel_lines, reach_margin, sheets
from tpm_gym.analysis.aspects import Aspect, aspects
from tpm_gym.analysis.limits import within_stops
from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.kinematics import ELBOWS_OUT, inverse_all
from tpm_gym.kinematics.geometry import PAPER
from tpm_gym.learning import figure_style as style
from tpm_gym.learning.figure_style import BLACK, BLUE, GREEN, ORANGE, PURPLE, VERMILLION
from tpm_gym.mechanism import PAPER_TPM

SHAPE = (200, 12, 260)
# Signs of the second and third factor of Eq. (16) -> colour; paler where rods 4 lead back to the
# base, z_C1 < z_B1.
COLOURS = {(1, -1): BLUE, (-1, -1): ORANGE, (-1, 1): GREEN, (1, 1): PURPLE}
SHARED, SMALLER = (-1, -1, -1), VERMILLION
"""Signs of two regions of one half, and the colour of the smaller of the two."""

Signs = tuple[int, int, int]

_RIM = 2e-2  # margin of reach below which the stops are not drawn; they would hide the rim
_X, _Z = np.linspace(-0.92, 1.06, 397), np.linspace(-1.18, 1.22, 481)
_Y = np.linspace(-PAPER.l7, PAPER.l7, 160)  # an even number: y = 0 itself is not sampled


def aspects_figure() -> Figure:
    """Draw sections of all aspects, with their volumes."""
    half = [a for a in aspects(ELBOWS_OUT, shape=SHAPE) if a.assembly.sin_beta > 0]
    draw = partial(_section, small=smaller(half))
    figure = Figure(figsize=(style.WIDTH, 4.9))
    what = f"elbows-out mode ({mode_name(ELBOWS_OUT)})"
    heading(figure, "Aspects: regions free of singularities", what, 0.978, 0.935)
    for column, y in enumerate((0.005, 0.025, 0.048)):
        axes = figure.add_axes((0.095 + 0.222 * column, 0.385, 0.2, 0.47))
        draw(axes, Section("y", y))
        axes.plot([-300, 300], [0, 0], color=BLACK, linewidth=1.8, solid_capstyle="butt")
        axes.set_aspect("equal")
        axes.set(xlim=(-880, 1020), ylim=(-1180, 1220))
        if column:
            axes.set_ylabel("")
            axes.tick_params(labelleft=False)
    for column, height in enumerate((0.75, 0.30)):
        axes = figure.add_axes((0.095 + 0.335 * column, 0.1, 0.30, 0.155))
        draw(axes, Section("z", height), _X, _Y)
        axes.set(xlim=(-880, 1020), ylim=(-56, 56), yticks=[-50, 0, 50])
        if column:
            axes.set_ylabel("")
            axes.tick_params(labelleft=False)
    _legend(figure, half)
    # The smallest aspect is too small for the other sections.
    x, z = np.linspace(-0.13, 0.33, 231), np.linspace(-0.470, -0.400, 141)
    axes = figure.add_axes((0.825, 0.1, 0.165, 0.155))
    draw(axes, Section("y", 0.025), x, z)
    axes.set(xlim=(x[0] * MM, x[-1] * MM), ylim=(z[0] * MM, z[-1] * MM), xticks=[0, 200])
    axes.set_title("in detail, " + axes.get_title())
    axes.set_ylabel("z (mm)", labelpad=0)
    return figure


def colour(signs: Signs, small: bool = False) -> FloatArray:
    """Return the colour of an aspect by its signs of level3, planar and elevation.

    ``small`` stands for the smaller of the two aspects with the signs SHARED.
    """
    strength = 0.90 if signs[2] > 0 else 0.45
    full = SMALLER if small else COLOURS[signs[:2]]
    mixed: FloatArray = 1 - strength * (1 - np.asarray(to_rgb(full)))
    return mixed


def smaller(half: Sequence[Aspect]) -> Callable[[FloatArray], BoolArray]:
    """Return a test for points (n, 3) m with the signs SHARED: are they in the smaller aspect?

    They are if they lie within a cell's diagonal of one of its cells' centres.
    """
    shared = (aspect.cells for aspect in half if signs_of(aspect) == SHARED)
    cells = min(shared, key=lambda cells: cells.volume)
    centres, diagonal = cells.centres(), np.linalg.norm(cells.spacing)

    def small(points: FloatArray) -> BoolArray:
        mirrored = np.stack([points[:, 0], abs(points[:, 1]), points[:, 2]], axis=-1)
        parts = np.array_split(mirrored, 1 + len(mirrored) // 1000)
        gaps = [np.linalg.norm(part[:, None] - centres, axis=-1).min(axis=1) for part in parts]
        found: BoolArray = np.concatenate(gaps) < diagonal
        return found

    return small


def signs_of(aspect: Aspect) -> Signs:
    """Return the signs of level3, planar and elevation of an aspect."""
    return aspect.level3, aspect.assembly.planar, aspect.elevation


def _section(
    axes: Axes,
    section: Section,
    x: FloatArray = _X,
    other: FloatArray = _Z,
    *,
    small: Callable[[FloatArray], BoolArray],
) -> None:
    """Colour the points (x, other) of a section by their aspects, and draw the aspects' edges."""
    points = section.points(np.stack(np.meshgrid(x, other), axis=-1))
    found = np.sign(sheets(points, ELBOWS_OUT)[..., 1:])
    image = np.ones(points.shape)
    for level3, planar in COLOURS:
        for elevation in (1, -1):
            signs = level3, planar, elevation
            image[np.all(found == signs, axis=-1)] = colour(signs)
    shared = np.all(found == SHARED, axis=-1)
    parts = small(points[shared])[:, None]
    image[shared] = np.where(parts, colour(SHARED, small=True), colour(SHARED))
    axes.pcolormesh(x * MM, other * MM, image)
    margin = reach_margin(points, ELBOWS_OUT.cos_beta)
    axes.contour(x * MM, other * MM, margin, [0], colors=[BLACK], linewidths=0.6)
    stops = np.ma.masked_where(margin < _RIM, _stop_margin(points))
    axes.contour(x * MM, other * MM, stops, [0], colors=["white"], linewidths=1.3, linestyles="--")
    for factor in range(section.fixed == "y", 4):
        for line in parallel_lines(factor, ELBOWS_OUT, section, x, other):
            axes.plot(*(line.T * MM), color=BLACK, linewidth=0.8)
    vertical = "z" if section.fixed == "y" else "y"
    section_axes(axes, f"{section.fixed} = {section.at * MM:.0f} mm", "x", vertical)
    fixed = 1 if section.fixed == "y" else 2
    if PAPER_TPM.region.low[fixed] <= section.at <= PAPER_TPM.region.high[fixed]:
        outline_task_region(axes, vertical, inside=True)


def _stop_margin(points: FloatArray) -> FloatArray:
    """Compute the least distance of a motor to its stops, rad; negative beyond a stop."""
    theta = inverse_all(points).theta[..., ELBOWS_OUT.index, :]
    motors = PAPER_TPM.mechanism.motors
    low, high = ([getattr(motor, end) for motor in motors] for end in ("lower", "upper"))
    margin: FloatArray = np.minimum(theta - low, high - theta).min(axis=-1)
    return np.ma.masked_invalid(margin)


def _legend(figure: Figure, half: Sequence[Aspect]) -> None:
    """Write a table of the aspects, with letters, beside the sections."""
    handles: list[Patch | Line2D] = [Patch(facecolor="none", label="  234   dm³ stops links")]
    seen: set[Signs] = set()
    allowed = np.zeros(3)  # volume, within the stops, and clear of links as well; dm^3
    for letter, aspect in zip(ascii_uppercase, half, strict=False):
        parts = _allowed(aspect)
        allowed += parts
        signs = signs_of(aspect)
        marks = "".join("+" if sign > 0 else "\N{MINUS SIGN}" for sign in signs)
        patch = Patch(facecolor=colour(signs, signs in seen), edgecolor="0.4", linewidth=0.4)
        seen.add(signs)  # the larger of two comes first
        patch.set_label(_row(f"{letter} {marks}", parts))
        handles.append(patch)
    handles.append(Patch(facecolor="none", label=_row("  all", allowed)))
    handles.append(Line2D([], [], color="white", linewidth=1.6, linestyle="--"))
    handles[-1].set_label("motors' stops")
    font = {"family": "monospace", "size": 6.5}
    legend = figure.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(0.748, 0.9), prop=font, handlelength=1.5
    )
    legend.get_frame().set_facecolor("0.88")
    title = "Regions A to H for y > 0, and\nthe signs of factors 2, 3 and 4"
    legend.set_title(title)
    legend.get_title().set_fontsize(7.0)


def _allowed(aspect: Aspect) -> FloatArray:
    """Compute volumes of an aspect, dm^3: all, within the motors' stops, and clear of links too."""
    centres = aspect.cells.centres()
    stops = within_stops(centres, ELBOWS_OUT, PAPER)
    clear = clear_of_links(centres[stops], ELBOWS_OUT, PAPER)
    shares = np.array([len(centres), stops.sum(), clear.sum()]) / len(centres)
    return 1e3 * aspect.cells.volume * shares


def _row(name: str, parts: FloatArray) -> str:
    volume, stops, clear = parts
    number = f"{volume:.1f}" if volume >= 10 else f"{volume:.2f}"
    return f"{name} {number:>5} {100 * stops / volume:4.0f}% {100 * clear / volume:4.0f}%"
