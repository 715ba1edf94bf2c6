"""Whatever the action, the next command is one that the simulation can follow."""

from itertools import pairwise

import numpy as np
import pytest
from examples import examples
from hypothesis import strategies as st
from machines import each_machine, within
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.machine import Machine
from tpm_gym.mechanism.tpm import PAPER_TPM, WIDE_TPM
from tpm_gym.tasks.control import CartesianControl, Control, JointControl, make_control


class One:
    """A control, for one robot."""

    def __init__(self, kind: Control) -> None:
        self.kind, self.steps = kind, kind.steps

    def command(self, action: ArrayLike, current: FloatArray) -> FloatArray:
        return self.kind.command(np.array([action]), current[None])[0]

    def action(self, wanted: FloatArray, current: FloatArray) -> FloatArray:
        return self.kind.action(wanted[None], current[None])[0]


CONTROLS = [
    pytest.param(One(kind(machine)), machine, id=f"{machine.name}-{kind.__name__}")
    for machine in (PAPER_TPM, WIDE_TPM)
    for kind in (CartesianControl, JointControl)
]

shares = st.tuples(*[st.one_of(st.floats(0, 1), st.sampled_from([0.0, 1.0]))] * 3)
actions = st.tuples(*[st.one_of(st.floats(-1, 1), st.sampled_from([-1.0, 1.0]))] * 3)


def turn(machine: Machine, start: FloatArray, end: FloatArray) -> FloatArray:
    """Difference of the joints between two points, rad."""
    return machine.inverse(end) - machine.inverse(start)


@pytest.mark.parametrize(("kind", "machine"), CONTROLS)
@examples(300, action=actions, share=shares)
def test_commands_stay_in_the_region_and_within_the_step_limit(kind, machine, action, share):
    current = within(machine, share)
    before = current.copy()
    command = kind.command(action, current)
    assert command.shape == (3,)
    assert machine.region.contains(command)
    assert (np.abs(command - current) <= np.array(machine.step_limit) * (1 + 1e-9)).all()
    np.testing.assert_array_equal(current, before)
    np.testing.assert_allclose(kind.command(np.zeros(3), current), current, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("kind", "machine"), CONTROLS)
@examples(100, share=shares, far=st.tuples(*[st.floats(-0.5, 1.5)] * 3))
def test_a_straight_way_takes_as_many_steps_as_it_says_even_from_beyond_the_region(
    kind, machine, share, far
):
    start, stop = within(machine, share), within(machine, far)
    count = int(np.ceil(kind.steps(stop, start) * 1.1)) + 1  # joints turn nearly evenly
    project = machine.region.project
    points = [project(start + k / count * (stop - start)) for k in range(count + 1)]
    for current, wanted in pairwise(points):
        reached = kind.command(kind.action(wanted, current), current)
        np.testing.assert_allclose(reached, wanted, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("kind", "machine"), CONTROLS)
@examples(200, share=shares, way=actions, far=shares)
def test_actions_are_in_the_unit_box_and_reach_every_wanted_point_nearby(
    kind, machine, share, way, far
):
    current = within(machine, share)
    wanted = machine.region.project(current + 0.1 * np.array(way) * machine.step_limit)
    assert np.abs(turn(machine, current, wanted)).max() < machine.joint_limit
    action = kind.action(wanted, current)
    assert np.abs(action).max() <= 1
    np.testing.assert_allclose(kind.command(action, current), wanted, rtol=0, atol=1e-9)
    towards = kind.action(within(machine, far), current)
    assert towards.shape == (3,)
    assert np.abs(towards).max() <= 1
    if isinstance(kind.kind, JointControl):  # slowed down together, they keep their direction
        joints = turn(machine, current, within(machine, far))
        np.testing.assert_allclose(
            towards * np.abs(joints).max(), joints * np.abs(towards).max(), atol=1e-12
        )


@each_machine
@examples(200, action=actions, share=shares)
def test_cartesian_actions_are_fractions_of_the_step_limit(machine, action, share):
    current = within(machine, share)
    free = current + np.array(action) * machine.step_limit
    expected = np.clip(free, machine.region.low, machine.region.high)
    command = One(CartesianControl(machine)).command(action, current)
    np.testing.assert_allclose(command, expected, rtol=0, atol=1e-15)


@each_machine
def test_joint_actions_at_full_scale_are_slowed_down_to_the_limit(machine):
    rng = np.random.default_rng(1)
    region = machine.region
    current, actions = (
        rng.uniform(region.low, region.high, (2000, 3)),
        rng.uniform(-1, 1, (2000, 3)),
    )
    actions /= np.abs(actions).max(axis=1, keepdims=True)
    theta = machine.inverse(current)
    full = machine.forward(theta + actions * machine.joint_limit)  # NaN where there is none
    far = ~((np.abs(full - current) / machine.step_limit).max(axis=1) <= 1.0)
    commands = JointControl(machine).command(actions, current)
    way = (np.abs(commands - current) / machine.step_limit).max(axis=1)
    assert (way <= 1 + 1e-9).all()
    inside = (commands - region.low > 1e-6) & (np.array(region.high) - commands > 1e-6)
    free = inside.all(axis=1)  # of the region's faces
    assert (far & free).sum() > 300
    assert (~far & free).sum() > 20
    slowed = way[far & free]
    assert slowed.min() > 0.995
    np.testing.assert_allclose(commands[~far & free], full[~far & free], rtol=0, atol=1e-12)
    joints = machine.inverse(commands) - theta
    cosine = (joints * actions).sum(axis=1) / np.prod(
        [np.linalg.norm(rows, axis=1) for rows in (joints, actions)], axis=0
    )
    assert cosine[far & free & (way > 0.1)].min() > np.cos(np.deg2rad(0.1))


@pytest.mark.parametrize(("kind", "machine"), CONTROLS)
def test_a_row_has_the_bits_that_it_has_alone(kind, machine):
    rng = np.random.default_rng(2)
    current, wanted = rng.uniform(machine.region.low, machine.region.high, (2, 200, 3))
    actions = rng.uniform(-1, 1, (200, 3))
    commands, back = kind.kind.command(actions, current), kind.kind.action(wanted, current)
    for row in range(0, 200, 7):
        one = kind.command(actions[row], current[row]), kind.action(wanted[row], current[row])
        np.testing.assert_array_equal(one, (commands[row], back[row]))


def test_controls_are_made_by_name():
    assert isinstance(make_control("cartesian", PAPER_TPM), CartesianControl)
    assert isinstance(make_control("joints", PAPER_TPM), JointControl)
    with pytest.raises(ConfigurationError, match="'cartesian' or 'joints'") as caught:
        make_control("torque", PAPER_TPM)
    assert (caught.value.name, caught.value.value) == ("control", "torque")
