"""The motor's torque, size, inertia and speed belong together, and it is in the mechanism."""

import math

import numpy as np
import pytest
from machines import each_machine

from tpm_gym.mechanism.motor import TORQUE_MOTOR
from tpm_gym.mechanism.tpm.bodies import ACTUATED_JOINTS


def test_the_torque_is_what_the_air_gap_of_a_torque_motor_gives():
    # Textbooks and makers: 30 to 60 kPa at the peak, 10 to 20 kPa for ever in still air.
    gap = 2 * math.pi * TORQUE_MOTOR.gap_radius**2 * TORQUE_MOTOR.length
    assert 30e3 <= TORQUE_MOTOR.peak_torque / gap <= 60e3
    assert 10e3 <= TORQUE_MOTOR.continuous_torque / gap <= 20e3


def test_the_continuous_torque_loses_what_the_housing_gives_off_in_still_air():
    lost = (TORQUE_MOTOR.continuous_torque / TORQUE_MOTOR.motor_constant) ** 2
    radius, length = TORQUE_MOTOR.stator_radius, TORQUE_MOTOR.reach - TORQUE_MOTOR.clearance
    area = 2 * (2 * math.pi * radius * length + 2 * math.pi * radius**2)
    assert lost / (10.0 * area) < 65.0  # K above the room, at 10 W/(m^2 K)


def test_the_rotor_fits_into_the_housing_round_the_shaft():
    for rotor, stator in zip(
        TORQUE_MOTOR.rotor("x"), TORQUE_MOTOR.stator("x", (0, 0, 0)), strict=True
    ):
        assert rotor.centre == stator.centre
        assert (rotor.half_extent < stator.half_extent).all()
        assert rotor.half_extent[1] == TORQUE_MOTOR.gap_radius


@each_machine
def test_the_rotor_is_part_of_every_arm_which_turns_between_its_halves(machine):
    for link in machine.mechanism.links:
        if link.joint is None or link.joint.name not in ACTUATED_JOINTS:
            continue
        along = np.flatnonzero(link.joint.axis)[0]
        rings = [solid for solid in link.solids if solid.size[0] == TORQUE_MOTOR.gap_radius]
        outer = TORQUE_MOTOR.gap_radius
        inner, length = outer - TORQUE_MOTOR.ring, TORQUE_MOTOR.length
        expected = 7850 * math.pi * length * (outer**4 - inner**4) / 2
        assert sum(ring.moments[along] for ring in rings) == pytest.approx(expected, rel=1e-12)
        for ring in rings:  # about the pivot, where the link's origin is
            assert np.flatnonzero(ring.centre).tolist() == [along]
        (tube,) = (solid for solid in link.solids if solid.kind == "box")
        assert tube.half_extent[along] < TORQUE_MOTOR.clearance
