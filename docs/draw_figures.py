"""Draw the figures of docs/figures.md into docs/images/, from the kinematics alone.

python docs/draw_figures.py [name ...]
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from figures import maps, modes, motors, parameters, postures, regions, singularities
from matplotlib.figure import Figure

from tpm_gym.learning import figure_style as style

IMAGES = Path(__file__).parent / "images"
FIGURES: dict[str, Callable[[], Figure]] = {
    "parameters": parameters.parameters_figure,
    "parallel_singularities": singularities.parallel_figure,
    "serial_singularities": singularities.serial_figure,
    "conditioning": maps.conditioning_figure,
    "workspace": maps.workspace_figure,
    "motors": motors.motors_figure,
    "postures": postures.postures_figure,
    "aspects": regions.aspects_figure,
    "operation_modes": modes.operation_modes_figure,
}


def draw(name: str, folder: Path = IMAGES) -> Path:
    """Draw one figure of FIGURES into ``folder`` and return its path."""
    path = folder / f"{name}.png"
    with style.style():
        style.save(FIGURES[name](), path)
    return path


def main(names: list[str]) -> None:
    """Draw the named figures, or all."""
    unknown = sorted(set(names) - set(FIGURES))
    if unknown:
        sys.exit(f"no figure {', '.join(unknown)}; there are {', '.join(FIGURES)}")
    IMAGES.mkdir(exist_ok=True)
    for name in names or FIGURES:
        print(draw(name))


if __name__ == "__main__":
    main(sys.argv[1:])
