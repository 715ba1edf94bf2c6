"""The picture of a run shows the intervals of its evaluations, and marks the best policy."""

import numpy as np

from tpm_gym.learning import curve


def estimate(mean: float) -> dict[str, float]:
    return {"mean": mean, "low": mean - 0.1, "high": mean + 0.2}


def test_the_best_policy_is_marked_and_bands_are_the_intervals(tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(curve, "save", lambda figure, path: figures.append(figure))
    scores = ((0.1, -40.0), (0.605, -20.0), (0.605, -10.0), (0.5, -5.0))  # success and return
    names = ("success_at_end", "return", "success_once")
    evaluations = [
        {"steps": 100 * k, "episodes": 50}
        | {name: estimate(value) for name, value in zip(names, (*score, 1.0), strict=True)}
        for k, score in enumerate(scores)
    ]
    curve.draw_learning_curve(tmp_path / "curve.png", "a run", evaluations)
    upper, lower = figures[0].axes
    (star,) = (line for line in upper.lines if line.get_marker() == "*")
    assert star.get_xydata().tolist() == [[200, 0.605]]
    assert star.get_label() == "best.zip (60.5%)"  # as in the log
    for axes, low, high in ((upper, 0.0, 0.805), (lower, -40.1, -4.8)):
        (band,) = axes.collections
        np.testing.assert_allclose(
            band.get_paths()[0].get_extents().extents, (0, low, 300, high), atol=1e-9
        )
