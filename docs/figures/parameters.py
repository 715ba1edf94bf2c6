"""Figure of the points, lengths and angles of the paper: its Figs. 2 and 3 in one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from figures.postures import STROKES, legend
from figures.skeleton import Skeleton, seen_from, skeleton
from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics import ELBOWS_OUT
from tpm_gym.kinematics.geometry import Geometry
from tpm_gym.learning import figure_style as style
from tpm_gym.learning.figure_style import BLACK

View = Callable[[FloatArray], FloatArray]
Offset = tuple[float, float]

# The case study's l2, l6 and l7 are too short for labels.
DRAWN = Geometry(l1=0.30, l2=0.14, l3=0.33, l4=0.66, l5=0.085, l6=0.085, l7=0.21)
POINT = np.array([0.24, 0.14, 0.82])
_AZIMUTH = np.deg2rad(-62.0)  # of the eye; z points up
_THIN = {"color": "0.4", "linewidth": 0.7}
X, Y, Z = np.eye(3)

# In points of type: from a joint, or from the middle of a link, to its label.
_SPACE: dict[str, Offset] = {
    "A1": (10, -7),
    "A2": (3, -10),
    "A3": (0, -11),
    "B1": (10, -7),
    "B2": (-11, -2),
    "B3": (14, -1),
    "C1": (11, 6),
    "C2": (-11, 2),
    "C3": (1, -12),
    "D1": (-10, 5),
    "D3": (12, 6),
    "E1": (12, -5),
    "F1": (-9, 5),
    "P": (-3, -11),
}
_SPACE_LENGTHS: dict[str, tuple[str, Offset]] = {
    "arm 1": ("l_3", (-9, 0)),
    "arm 2": ("l_3", (3, 9)),
    "arm 3": ("l_3", (6, 9)),
    "rod 4a": ("l_4", (3, 8)),
    "rod 6": ("l_4", (-9, 0)),
    "rod 11b": ("l_4", (-9, -4)),
    "offset C1D1": ("l_6", (-9, 0)),
    "offset E1F1": ("l_6", (9, 0)),
    "offset D3C3": ("l_6", (-7, 2)),
    "link 7": ("l_7", (-3, 9)),
}
_PLAN: dict[str, Offset] = {
    "C1, D1": (4, -12),
    "C2": (0, -12),
    "C3, D3": (19, 0),
    "E1, F1": (12, 10),
    "P": (0, -11),
}
_PLAN_LENGTHS: dict[str, tuple[str, Offset]] = {
    "link 7": ("l_7", (-8, 6)),
    "platform": ("2l_2", (0, 9)),
    "link 10": ("2l_5", (-11, -14)),
}


def project(points: FloatArray) -> FloatArray:
    """Project points (..., 3) m to (..., 2) m, z up, with leg 1 at the back."""
    return seen_from(_AZIMUTH, points)


def from_above(points: FloatArray) -> FloatArray:
    """Return the coordinates x, y of points (..., 3) m."""
    return points[..., :2]


def parameters_figure() -> Figure:
    """Draw one posture in space and from above, with every name of the section on positions."""
    figure = Figure(figsize=(style.WIDTH, 4.9))
    at = {"ha": "center", "va": "top"}
    figure.text(0.5, 0.985, "Points, lengths and angles", fontsize=11, weight="bold", **at)
    what = (
        "the paper's Figs. 2 and 3; not to scale: in its case study l2, l6 and l7 are far shorter"
    )
    figure.text(0.5, 0.945, what, fontsize=8.5, **at)
    posture = skeleton(POINT, ELBOWS_OUT, DRAWN)
    _space(figure.add_axes((0.0, 0.11, 0.57, 0.77)), posture)
    _plan(figure.add_axes((0.575, 0.17, 0.42, 0.65)), posture)
    legend(figure)
    return figure


def _space(axes: Axes, s: Skeleton) -> None:
    _base(axes, s, project)
    _links(axes, s, project)
    sizes = (0.15, 0.11, 0.14)
    for leg, (level, size) in enumerate(zip((Y, X, X), sizes, strict=True)):
        name = rf"$\theta_{leg + 1}$"
        _angle(axes, project, s.a[leg], (level, Z), s.theta[leg], name, size)
    _angle(axes, project, s.d1, (X, Y), _beta(s), r"$\beta$", 0.12)
    _frame(axes, np.zeros(3), "xyz", 0.17, (-7, -6), "$O$")
    _frame(axes, POINT, "uvw", 0.12, (0, 0), "")
    _name_joints(axes, s, project, _SPACE)
    _name_lengths(axes, s, project, _SPACE_LENGTHS)
    front = s.geometry.l1 * (X - Y), s.geometry.l1 * (-X - Y)
    axes.annotate("$2l_1$", project(np.stack(front)).mean(axis=0), (0, -8), color="0.3", **_LABEL)
    axes.set(xlim=(-0.66, 0.76), ylim=(-0.24, 1.04))
    _finish(axes, "in space, leg 1 at the back", 0.95)


def _plan(axes: Axes, s: Skeleton) -> None:
    """Draw link 3', link 7 and the platform; the rods are cut off."""
    _links(axes, s, from_above, arms=False)
    _angle(axes, from_above, s.d1, (X, Y), _beta(s), r"$\beta$", 0.09)
    _name_joints(axes, s, from_above, _PLAN)
    _name_lengths(axes, s, from_above, _PLAN_LENGTHS)
    (x1, y1), below = s.c[0][:2], -0.075
    for start, end, label in (
        (x1 - 2 * s.geometry.l5, x1, "2l_5"),
        (x1, x1 + s.geometry.l5, "l_5"),
    ):
        axes.annotate(
            "", (start, y1 + below), (end, y1 + below), arrowprops={"arrowstyle": "<->", **_ARROW}
        )
        axes.annotate(f"${label}$", ((start + end) / 2, y1 + below), (0, -8), color="0.3", **_LABEL)
    axes.set(xlim=(-0.26, 0.53), ylim=(-0.2, 0.33))
    _finish(axes, "link 3', link 7 and platform from above, enlarged", 1.0)


_ARROW = {"linewidth": 0.7, "color": "0.4", "shrinkA": 0, "shrinkB": 0}
_LABEL = {"textcoords": "offset points", "ha": "center", "va": "center", "fontsize": 9, "zorder": 6}


def _beta(s: Skeleton) -> float:
    along = s.e1 - s.d1
    return float(np.arctan2(along[1], along[0]))


def _base(axes: Axes, s: Skeleton, view: View) -> None:
    corners = s.geometry.l1 * np.array([(1, 1, 0), (-1, 1, 0), (-1, -1, 0), (1, -1, 0)])
    axes.fill(*view(corners).T, facecolor="0.94", edgecolor="0.7", linewidth=0.6)


def _links(axes: Axes, s: Skeleton, view: View, arms: bool = True) -> None:
    links = s.links()
    offsets = {name: ("0.35", 1.8) for name in links if name.startswith("offset")}
    for name, (colour, width) in (STROKES | offsets).items():
        if name.startswith("arm") and not arms:
            continue
        ends = view(np.stack(links[name][:2]))
        axes.plot(*ends.T, color=colour, linewidth=width, solid_capstyle="round")


def _name_joints(axes: Axes, s: Skeleton, view: View, offsets: dict[str, Offset]) -> None:
    points = {
        f"{name}{i + 1}": p[i]
        for name, p in zip("ABC", (s.a, s.b, s.c), strict=True)
        for i in range(3)
    }
    points |= {"D1": s.d1, "D3": s.d3, "E1": s.e1, "F1": s.f1, "P": POINT}
    shown = {name for label in offsets for name in label.split(", ")}
    for name, point in points.items():
        if name not in shown:
            continue
        fill = BLACK if name[0] in "AP" else "white"
        marker = "s" if name[0] == "A" else "o"
        style_ = {"color": fill, "markeredgecolor": BLACK, "markersize": 4, "mew": 0.7}
        axes.plot(*view(point), marker, zorder=5, **style_)
    for label, offset in offsets.items():
        names = [f"${n[0]}_{n[1]}$" if n[1:] else f"${n}$" for n in label.split(", ")]
        axes.annotate(", ".join(names), view(points[label.split(", ")[0]]), offset, **_LABEL)


def _name_lengths(
    axes: Axes, s: Skeleton, view: View, labels: dict[str, tuple[str, Offset]]
) -> None:
    links = s.links()
    for name, (label, offset) in labels.items():
        middle = view(np.stack(links[name][:2])).mean(axis=0)
        axes.annotate(f"${label}$", middle, offset, color="0.3", **_LABEL)


def _angle(
    axes: Axes,
    view: View,
    vertex: FloatArray,
    plane: tuple[FloatArray, FloatArray],
    angle: float,
    name: str,
    size: float,
) -> None:
    """Return an arc (m) in a plane, from its first direction towards its second, and its start."""
    start, turn = plane
    t = np.linspace(0.0, angle, 60)[:, None]
    arc = vertex + size * (np.cos(t) * start + np.sin(t) * turn)
    axes.plot(
        *view(np.stack([vertex, vertex + 1.5 * size * start])).T, linestyle=(0, (4, 2)), **_THIN
    )
    axes.plot(*view(arc).T, **_THIN)
    middle = size * (np.cos(angle / 2) * start + np.sin(angle / 2) * turn)
    axes.annotate(name, view(vertex + (1 + 0.042 / size) * middle), (0, 0), **_LABEL)


def _frame(
    axes: Axes, origin: FloatArray, names: str, size: float, offset: Offset, name: str
) -> None:
    for label, direction in zip(names, np.eye(3), strict=True):
        tip = project(origin + size * direction)
        arrow = {"arrowstyle": "-|>", "mutation_scale": 7} | _ARROW | {"color": BLACK}
        axes.annotate("", tip, project(origin), arrowprops=arrow)
        at = project(origin + (size + 0.03) * direction)
        aside = (-4.0, 8.0) if label == "u" else (0.0, 0.0)  # off the platform
        axes.annotate(f"${label}$", at, aside, **_LABEL)
    axes.annotate(name, project(origin), offset, **_LABEL)


def _finish(axes: Axes, title: str, height: float) -> None:
    axes.set_title(title, fontsize=9, y=height)
    axes.set_aspect("equal")
    axes.axis("off")
