"""Learning curve of a run, as a picture."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from tpm_gym.learning.figure_style import BLUE, GREEN, ORANGE, WIDTH, save, style


def draw_learning_curve(path: Path, title: str, evaluations: Sequence[Mapping[str, Any]]) -> None:
    """Draw the periodic evaluations of a run: success above, return below."""
    steps = [evaluation["steps"] for evaluation in evaluations]

    def values(name: str, part: str = "mean") -> list[float]:
        return [evaluation[name][part] for evaluation in evaluations]

    quality = list(zip(values("success_at_end"), values("return"), strict=True))
    best = quality.index(max(quality))
    with style():
        figure = Figure(figsize=(WIDTH, 4.8), layout="constrained")
        figure.suptitle(title, weight="bold")
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
        upper.plot(steps, values("success_once"), color=GREEN, ls="--", label="success once")
        named = (upper, "success_at_end", "success at end"), (lower, "return", "mean")
        for axes, name, label in named:
            bounds = values(name, "low"), values(name, "high")
            axes.fill_between(steps, *bounds, color=BLUE, alpha=0.16, lw=0, label="95% interval")
            axes.plot(steps, values(name), color=BLUE, marker="o", markersize=3, label=label)
            axes.grid(linewidth=0.4)
        star = {"color": ORANGE, "markersize": 12, "label": f"best.zip ({quality[best][0]:.1%})"}
        upper.plot(steps[best], quality[best][0], "*", **star)
        upper.set(ylim=(-0.02, 1.04), ylabel="successful episodes")
        upper.yaxis.set_major_formatter(PercentFormatter(xmax=1))
        upper.set_title(f"{evaluations[-1]['episodes']} episodes an evaluation, never trained on")
        lower.set(xlabel="environment steps", ylabel="return per episode")
        lower.xaxis.set_major_formatter(EngFormatter(sep=""))
        for axes in (upper, lower):  # to the right, where the legend covers no data
            axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
        save(figure, path)
