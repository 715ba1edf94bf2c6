"""Numerical settings of the engines: what they are, and what is refused."""

from typing import Any

import pytest
from alone import Alone

from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism import PAPER_TPM

NAN = float("nan")
STEPS = [0.0, -0.002, 0.05, 0.003, 1e-12, NAN, float("inf"), "x", True]
COUNTS = [0, -1, 1.5, NAN, True, "50"]
WRONG: dict[str, dict[str, list[Any]]] = {
    "pybullet": {
        "time_step": STEPS,
        "iterations": COUNTS,
        "solver": ["dantzig", "Direct", "", None, 1],
        "erp": [0.0, -0.1, 1.01, NAN, True, [0.8]],
    },
    "mujoco": {
        "time_step": STEPS,
        "iterations": COUNTS,
        "tolerance": [-1e-9, 1.0, float("inf"), "0", False],
    },
    "analytic": {"time_step": [*STEPS, 0.04, 0.02], "torques": ["all", "", None, 1]},
}


@pytest.mark.parametrize("engine", WRONG)
def test_settings_that_cannot_work_are_refused_by_name(engine):
    for name, values in WRONG[engine].items():
        for value in values:
            with pytest.raises(ConfigurationError) as caught:
                Alone(engine=engine, physics={name: value})
            assert (caught.value.name, caught.value.value is value) == (name, True)


@pytest.mark.parametrize("engine", WRONG)
@pytest.mark.parametrize(("time_step", "count"), [(None, 10), (1e-3, 40), (1 / 225, 9)])
def test_time_steps_fill_the_control_period(engine, time_step, count):
    simulation = Alone(engine=engine, physics={"time_step": time_step} if time_step else None)
    assert simulation.engine.time_step * count == pytest.approx(0.04)
    # Half a period late, the spline is half of the way there; nothing of it is left out.
    simulation.reset(PAPER_TPM.inverse(PAPER_TPM.home))
    point = PAPER_TPM.home[0] + 0.02, *PAPER_TPM.home[1:]
    state = simulation.move(point)
    assert state.platform_position[0] - PAPER_TPM.home[0] == pytest.approx(0.01, abs=2e-4)


def test_the_ends_of_the_ranges_are_allowed():
    for solver in ("direct", "iterative"):
        Alone(physics={"iterations": 1, "erp": 1.0, "solver": solver, "time_step": 0.04}).close()
    Alone(engine="mujoco", physics={"iterations": 1, "tolerance": 0.0, "time_step": 0.04}).close()
