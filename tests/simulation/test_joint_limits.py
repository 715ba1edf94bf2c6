"""No episode begins or goes beyond a motor's stop, whatever the machine and the engine."""

from operator import attrgetter

import kinematic  # noqa: F401  (registers the engine)
import numpy as np
import pytest
from alone import Alone
from gantry import GANTRY

from tpm_gym.errors import JointLimitError, TPMError
from tpm_gym.mechanism import PAPER_TPM, WIDE_TPM
from tpm_gym.simulation import Plant, Scene

each = pytest.mark.parametrize("machine", [PAPER_TPM, WIDE_TPM, GANTRY], ids=attrgetter("name"))
SIDES = [("lower", -1e-6), ("upper", 1e-6)]


def at_stop(machine, index, side, step):
    """A posture with one motor on its stop, and that a step farther; both can be assembled."""
    rng, motors = np.random.default_rng(index), machine.mechanism.motors
    lower, upper = ([getattr(motor, which) for motor in motors] for which, _ in SIDES)
    while True:
        on = rng.uniform(lower, upper)
        on[index] = getattr(motors[index], side)
        beyond = on + step * np.eye(3)[index]
        try:
            machine.require_evaluate([on, beyond])
        except TPMError:
            continue
        return on, beyond


@pytest.mark.parametrize("engine", ["pybullet", "kinematic"])
@each
def test_beyond_each_stop_of_each_motor_is_refused_by_name_and_on_it_is_not(machine, engine):
    simulation = Alone(Scene(), machine=machine, engine=engine)
    for index, motor in enumerate(machine.mechanism.motors):
        for side, step in SIDES:
            on, beyond = at_stop(machine, index, side, step)
            state = simulation.reset(on)
            np.testing.assert_allclose(state.theta, on, rtol=0, atol=1e-12)
            with pytest.raises(JointLimitError, match=motor.name) as caught:
                simulation.reset(beyond)
            unit = "m" if machine is GANTRY else "rad"
            found = caught.value
            assert vars(found) == {
                "joint": motor.name, "position": beyond[index], "lower": motor.lower,
                "upper": motor.upper, "unit": unit,
            }  # fmt: skip
            np.testing.assert_array_equal(simulation.read().theta, state.theta)


def test_the_stops_are_those_of_the_true_joints_not_of_the_encoders(simulation):
    on, _ = at_stop(PAPER_TPM, 1, "upper", 0.0)
    inwards, outwards = (Plant(encoder_bias=(0.0, bias, 0.0)) for bias in (1e-3, -1e-3))
    simulation.reset(on, plant=inwards)
    with pytest.raises(JointLimitError) as caught:
        simulation.reset(on, plant=outwards)
    assert caught.value.position == on[1] + 1e-3


@pytest.mark.parametrize("engine", ["pybullet", "mujoco", "analytic"])
@each
def test_a_command_beyond_a_stop_is_refused_before_anything_moves(machine, engine):
    simulation = Alone(Scene(), machine=machine, engine=engine)
    rng, motors = np.random.default_rng(0), machine.mechanism.motors
    ranges = np.transpose([(motor.lower, motor.upper) for motor in motors])
    while True:  # a posture in the machine's modes with the second motor on its stop
        on = rng.uniform(*ranges)
        on[1] = motors[1].upper
        point, beyond = machine.forward([on, on + [0.0, 1e-6, 0.0]])
        theta = machine.inverse(point)
        if np.isfinite(beyond).all() and np.allclose(theta, on, rtol=0, atol=1e-9):
            break
    before = simulation.reset(machine.inverse(machine.home))
    with pytest.raises(JointLimitError, match=motors[1].name) as caught:
        simulation.move(beyond)
    assert caught.value.position == pytest.approx(on[1] + 1e-6, abs=1e-9)
    np.testing.assert_array_equal(simulation.read().theta, before.theta)
    simulation.move(machine.home)
