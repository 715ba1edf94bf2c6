"""The vacuum's law: how fast it comes and goes, what a seal bears, when it is made and lost."""

import math

import numpy as np
import pytest

from tpm_gym.mechanism.cup import CUP
from tpm_gym.simulation.vacuum import EMPTY, Hold, Load, hold_after, holds, pressure_after

STEP = 1 / 250
FULL = Hold(0, CUP.vacuum)
NOTHING = Load()


@pytest.mark.parametrize("time_step", [1 / 250, 1 / 1000, 1 / 25])
def test_it_builds_up_and_falls_in_the_stated_times_at_any_time_step(time_step):
    times = time_step * np.arange(1, round(0.12 / time_step) + 1)
    rising, falling = [0.0], [CUP.vacuum]
    for _ in times:
        rising.append(pressure_after(rising[-1], time_step, pumped=True))
        falling.append(pressure_after(falling[-1], time_step, pumped=False))
    np.testing.assert_allclose(rising[1:], CUP.vacuum * (1 - np.exp(-times / 0.020)))
    np.testing.assert_allclose(falling[1:], CUP.vacuum * np.exp(-times / 0.010))


@pytest.mark.parametrize("angle", np.radians([0.0, 30.0, 45.0, 60.0, 90.0]))
@pytest.mark.parametrize("share", [0.3, 1.0])
def test_the_length_of_the_pull_counts_and_the_pressure(angle, share):
    limit = share * 12.0  # N: 60 kPa on 200 mm^2
    for force, expected in ((0.999 * limit, True), (1.001 * limit, False)):
        load = Load(force * math.cos(angle), force * math.sin(angle))
        assert holds(share * CUP.vacuum, load) is expected


def test_pressing_is_no_pull_and_the_lip_bears_more_shear_for_it():
    assert holds(0.0, Load(-1000.0, 0.0))
    for press in (1.0, 15.0):
        limit = 12.0 + CUP.seal_friction * press
        assert holds(CUP.vacuum, Load(-press, 0.999 * limit))
        assert not holds(CUP.vacuum, Load(-press, 1.001 * limit))


def test_it_seals_on_what_it_touches_while_on_and_keeps_its_first_choice():
    assert hold_after(EMPTY, STEP, on=False, load=NOTHING, touched=1) == EMPTY
    assert hold_after(EMPTY, STEP, on=True, load=NOTHING, touched=-1) == EMPTY
    hold = hold_after(EMPTY, STEP, on=True, load=NOTHING, touched=1)
    assert hold == (1, pressure_after(0.0, STEP, pumped=True))
    assert hold_after(hold, STEP, on=True, load=NOTHING, touched=0).which == 1


def test_switched_off_it_holds_for_some_milliseconds_and_a_heavy_load_for_fewer():
    left = {}
    for weight in (0.0, 0.49, 5.0):
        hold, steps = FULL, 0
        while hold.which == 0:
            hold = hold_after(hold, STEP, on=False, load=Load(weight), touched=-1)
            steps += 1
        left[weight] = steps
        assert hold.vacuum == pytest.approx(CUP.vacuum * math.exp(-steps * STEP / 0.010))
    # Until 3 kPa are left, and until 25 kPa are
    assert left == {
        0.0: math.ceil(0.010 * math.log(20) / STEP),
        0.49: math.ceil(0.010 * math.log(20) / STEP),
        5.0: math.ceil(0.010 * math.log(12 / 5) / STEP),
    }


def test_what_is_pulled_off_vents_the_cup_before_it_can_seal_again():
    hold = hold_after(FULL, STEP, on=True, load=Load(12.1), touched=-1)
    assert hold == (-1, pressure_after(CUP.vacuum, STEP, pumped=False))
    steps = 1
    while hold.which < 0:
        before = hold.vacuum
        hold = hold_after(hold, STEP, on=True, load=NOTHING, touched=0)
        steps += 1
    assert before <= CUP.least_vacuum < before * math.exp(STEP / 0.010)
    assert steps == math.ceil(0.010 * math.log(20) / STEP) + 1
