"""Figure of docs/gradients.md: three machines with boxes; a motion beside the expert's."""

from __future__ import annotations

import itertools

import numpy as np
from figures.postures import STROKES, project
from figures.sections import MM
from figures.skeleton import skeleton
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from gradients.lengths import FOOTPRINT, Design
from gradients.ways import Carry, points
from tpm_gym.kinematics import ELBOWS_OUT
from tpm_gym.learning import figure_style as style
from tpm_gym.learning.figure_style import BLACK, BLUE, OUTLINE, VERMILLION
from tpm_gym.simulation.state import CONTROL_PERIOD


def figure(designs: dict[str, Design], carry: Carry, expert: Tensor, found: Tensor) -> Figure:
    """Draw boxes above, to one scale, and a motion below, with its torques."""
    drawn = Figure(figsize=(style.WIDTH, 4.6))
    for column, (name, design) in enumerate(designs.items()):
        axes = drawn.add_axes((0.01 + 0.33 * column, 0.45, 0.32, 0.48))
        _machine(axes, design)
        axes.set_title(f"{name}: {1e3 * design.volume:.1f} litres")
    side = drawn.add_axes((0.08, 0.1, 0.24, 0.27))
    above = drawn.add_axes((0.41, 0.1, 0.24, 0.27))
    torque = drawn.add_axes((0.735, 0.1, 0.25, 0.27))
    for label, way, colour in (("expert", expert, VERMILLION), ("least torque", found, BLUE)):
        path = points(way).numpy() * MM
        height = path[0, 2] - path[:, 2]
        for axes, other in ((side, height), (above, path[:, 1])):
            axes.plot(path[:, 0], other, color=colour, label=label)
            axes.plot(path[::10, 0], other[::10], "o", color=colour, markersize=2.0)
        square = (carry.torque(way) ** 2).sum(-1)
        time = np.arange(1, len(square) + 1) * CONTROL_PERIOD / 10
        torque.plot(time, square, color=colour)
    side.set(title="from the side", xlabel="x (mm)", ylabel="height (mm)")
    above.set(title="from above", xlabel="x (mm)", ylabel="y (mm)")
    torque.set(
        title="torque squared, sum of motors", xlabel="time (s)", ylabel="N² m²", ylim=(0, None)
    )
    side.legend(loc="lower center")
    return drawn


def _machine(axes: Axes, design: Design) -> None:
    """Draw the mechanism at the middle of its box, with the footprint of base and arms."""
    low, high = np.array(design.box.low), np.array(design.box.high)
    posture = skeleton((low + high) / 2, ELBOWS_OUT, design.geometry)
    axes.fill(*(project(posture.a)[[1, 0, 2]].T * MM), facecolor="0.9", edgecolor="0.6", lw=0.6)
    for name, (colour, width) in STROKES.items():
        ends = project(np.stack(posture.links()[name][:2])) * MM
        axes.plot(*ends.T, color=colour, linewidth=0.7 * width, solid_capstyle="round")
    corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
    for one, other in itertools.combinations(corners, 2):
        if np.count_nonzero(one != other) == 1:
            axes.plot(*(project(np.stack([one, other])).T * MM), color=BLACK, linewidth=0.9)
    square = FOOTPRINT * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0), (-1, -1, 0)])
    axes.plot(*(project(square).T * MM), color=OUTLINE, linewidth=0.6, linestyle=(0, (3, 2)))
    axes.set(xlim=(-930, 930), ylim=(-1180, 340), aspect="equal")
    axes.axis("off")
