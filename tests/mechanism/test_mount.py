"""The mount is a rigid motion, there and back, that hangs the base over the table."""

import numpy as np
import pytest
from examples import examples
from hypothesis import strategies as st
from machines import each_machine

from tpm_gym.arrays import rotate
from tpm_gym.mechanism import Mount
from tpm_gym.mechanism.cup import CUP

coordinates = st.tuples(*[st.floats(-3, 3)] * 3)


@examples(100, st.floats(0.1, 2), coordinates, coordinates)
def test_mounts_are_rigid_and_round_trip(height, p, q):
    mount = Mount(height)
    np.testing.assert_allclose(mount.to_paper(mount.to_world(p)), p, atol=1e-14)
    np.testing.assert_allclose(mount.to_world(mount.to_paper(p)), p, atol=1e-14)
    turn, origin = mount.frame
    np.testing.assert_array_equal(turn * p + origin, mount.to_world(p))
    matrix = mount.rotate(np.eye(3)).T
    assert np.linalg.det(matrix) == pytest.approx(1)
    np.testing.assert_allclose(mount.rotate(p), rotate(mount.quaternion, p), atol=1e-15)
    np.testing.assert_allclose(mount.to_world(p), matrix @ p + [0, 0, height], atol=1e-14)
    moved = np.subtract(mount.to_world(p), mount.to_world(q))
    np.testing.assert_allclose(moved, mount.rotate(np.subtract(p, q)), atol=1e-14)


def test_the_mount_hangs_the_base_upside_down():
    mount = Mount(1.5)
    np.testing.assert_array_equal(mount.to_world([0, 0, 0]), [0, 0, 1.5])
    np.testing.assert_array_equal(mount.to_world([0.1, 0.2, 0.5]), [0.1, -0.2, 1.0])
    np.testing.assert_array_equal(mount.rotate(np.eye(3)), np.diag([1, -1, -1]))
    assert mount.free_fall == (0.0, 0.0, 9.81)
    assert mount.to_world(np.zeros((4, 2, 3))).shape == (4, 2, 3)


@each_machine
def test_over_the_whole_region_the_lip_is_above_the_table_and_at_its_end_within_reach(machine):
    highest, lowest = machine.mount.to_world([machine.region.low, machine.region.high])[:, 2]
    assert 0 < lowest - CUP.length < 0.030 < highest - CUP.length
    assert (np.abs([machine.region.low, machine.region.high])[:, :2] <= machine.table).all()
