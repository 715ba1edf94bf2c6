"""Numerical settings: what they are, and what is refused."""

from typing import Any

import pytest

from tpm_gym.errors import ConfigurationError
from tpm_gym.simulation.bullet.physics import SOLVERS, Physics
from tpm_gym.simulation.state import CONTROL_PERIOD

NAN = float("nan")


def test_defaults_are_250_hz_physics_under_25_hz_control() -> None:
    assert (Physics().substeps, Physics().solver) == (10, "direct")
    assert Physics().time_step * Physics().substeps == pytest.approx(CONTROL_PERIOD)


@pytest.mark.parametrize(("time_step", "substeps"), [(0.04, 1), (0.001, 40), (1 / 225, 9)])
def test_substeps_fill_the_control_period(time_step: float, substeps: int) -> None:
    assert Physics(time_step=time_step).substeps == substeps


@pytest.mark.parametrize(
    ("name", "value"),
    [("time_step", value) for value in (0.0, -0.002, 0.05, 0.003, NAN, float("inf"))]
    + [("time_step", "x"), ("time_step", 1e-400)]
    + [("iterations", value) for value in (0, -1, 1.5, NAN, True, "50")]
    + [("solver", value) for value in ("dantzig", "Direct", "", None, 1)]
    + [("erp", value) for value in (0.0, -0.1, 1.01, NAN, True, [0.8])],
)
def test_settings_that_cannot_work_are_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(ConfigurationError) as caught:
        Physics(**{name: value})
    assert caught.value.name == name
    assert caught.value.value is value


def test_the_ends_of_the_ranges_are_allowed() -> None:
    assert Physics(iterations=1, erp=1.0).erp == 1.0
    assert [Physics(solver=name).solver for name in SOLVERS] == ["direct", "iterative"]
