"""Postures close, are in the modes that were asked for, and say why there are none."""

from itertools import product

import numpy as np
import pytest

from tpm_gym import PAPER_TPM, WIDE_TPM, TPMError
from tpm_gym.errors import InputError, UnreachableError
from tpm_gym.kinematics import ELBOWS_OUT, WORKING_MODES
from tpm_gym.mechanism import DELTA
from tpm_gym.mechanism.delta import geometry as delta
from tpm_gym.viewer.kinds import Posture, find_kind

MACHINES = PAPER_TPM, WIDE_TPM
OPERATIONS = "translating", "rotated"


def postures(machine, count: int = 25) -> list[Posture]:
    """Return postures all over the reach, in all modes."""
    rng = np.random.default_rng(0)
    reach = np.array([1.0, machine.geometry.l7, 1.1])
    found = []
    for operation, mode in product(OPERATIONS, WORKING_MODES):
        for point in rng.uniform(-reach, reach, (count, 3)):
            try:
                found.append(find_kind(machine).at_point(point, operation, mode))
            except TPMError:
                continue
            assert found[-1].operation == operation
            assert found[-1].working == mode
            assert found[-1].position == pytest.approx(point, abs=1e-9)
    return found


@pytest.mark.parametrize("machine", MACHINES, ids=lambda machine: machine.name)
def test_every_posture_closes_with_p_on_the_platform(machine):
    found = postures(machine)
    assert {posture.operation for posture in found} == set(OPERATIONS)
    assert len({(posture.operation, posture.working) for posture in found}) > 24
    for posture in found:
        assert posture.gap < 1e-9
        platform = posture.places["platform"].point(machine.mechanism.point_p)
        assert platform == pytest.approx(posture.position, abs=1e-7)  # sqrt of rounding at y = 0


@pytest.mark.parametrize("machine", MACHINES, ids=lambda machine: machine.name)
def test_the_joints_of_a_posture_lead_back_to_it_in_its_assembly_mode(machine):
    for posture in postures(machine, count=10):
        if posture.conditioning < 1e-3:
            continue  # two assemblies merge
        back = find_kind(machine).at_joints(posture.theta, posture.assembly)
        assert back.position == pytest.approx(posture.position, abs=1e-6)
        assert back.working == posture.working


def test_a_delta_closes_in_all_modes_and_its_joints_lead_back():
    rng, found = np.random.default_rng(0), []
    for mode in delta.WORKING_MODES:
        for point in rng.uniform((-0.8, -0.8, -1.4), (0.8, 0.8, 1.4), (25, 3)):
            try:
                posture = find_kind(DELTA).at_point(point, "translating", mode)
            except UnreachableError:
                continue
            found.append(posture)
            assert posture.working == mode
            assert posture.gap < 1e-9
            assert posture.places["platform"].point(DELTA.mechanism.point_p) == pytest.approx(point)
            if posture.conditioning > 1e-3:
                back = find_kind(DELTA).at_joints(posture.theta, posture.assembly)
                assert back.position == pytest.approx(point, abs=1e-9)
    assert len({(posture.working, posture.assembly) for posture in found}) == 16
    home = find_kind(DELTA).at_point(DELTA.home, "translating", delta.ELBOWS_OUT)
    assert home.conditioning == pytest.approx(float(DELTA.conditioning_at(DELTA.home)))
    with pytest.raises(UnreachableError):
        find_kind(DELTA).at_joints((3.0, 0.0, 0.0), 1.0)


def test_of_several_tilts_the_nearest_is_taken():
    machine, home = WIDE_TPM, WIDE_TPM.home
    tilts = {
        find_kind(machine).at_point(home, "rotated", ELBOWS_OUT, tilt).tilt
        for tilt in np.linspace(-np.pi, np.pi, 25)
    }
    for tilt in tilts:
        near = find_kind(machine).at_point(home, "rotated", ELBOWS_OUT, tilt + 1e-3)
        assert near.tilt == pytest.approx(tilt, abs=1e-9)


def test_margins_are_those_of_the_machine():
    posture = find_kind(PAPER_TPM).at_point(PAPER_TPM.home, "translating", ELBOWS_OUT)
    _, find = find_kind(PAPER_TPM).layers(posture)["margin"]
    margin = find()
    assert margin is not None
    # y = l7 is nearer than y = 0
    assert margin.distance == pytest.approx(PAPER_TPM.geometry.l7 - posture.position[1])
    assert margin.factor == "cos_beta"
    low, high = PAPER_TPM.stops
    assert (posture.theta - posture.stop_margins == low).any() or (
        posture.theta + posture.stop_margins == pytest.approx(high)
    )
    assert posture.conditioning == pytest.approx(float(PAPER_TPM.conditioning_at(posture.position)))


def test_what_does_not_exist_is_refused_with_the_reason():
    with pytest.raises(UnreachableError, match="beta"):
        find_kind(PAPER_TPM).at_point((0.0, 0.3, 0.8), "translating", ELBOWS_OUT)
    with pytest.raises(InputError, match=r"other working modes|none has"):
        find_kind(WIDE_TPM).at_point((0.0, 0.55, -0.9), "rotated", ELBOWS_OUT)
    rotated = find_kind(PAPER_TPM).at_point(PAPER_TPM.home, "rotated", ELBOWS_OUT)
    with pytest.raises(InputError, match="rotated assembly"):
        find_kind(PAPER_TPM).at_joints(rotated.theta + [1.5, 0.0, 0.0], rotated.assembly)
    with pytest.raises(InputError, match="position"):
        find_kind(PAPER_TPM).at_point((0.0, np.nan, 0.8), "translating", ELBOWS_OUT)
