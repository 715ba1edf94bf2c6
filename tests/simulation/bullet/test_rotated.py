"""PyBullet's own kinematics close the loops of urdf/tpm.urdf with link 3' turned."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pybullet
import pytest
import yaml
from pybullet_utils.bullet_client import BulletClient

from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics import ROTATED_MODES, forward_rotated
from tpm_gym.kinematics.geometry import PAPER
from tpm_gym.mechanism.tree import rotated_joint_angles
from tpm_gym.mechanism.urdf import LOOPS_FILE, URDF_FILE
from tpm_gym.resources import URDF as FOLDER


@pytest.fixture
def client() -> Iterator[Any]:
    connected = BulletClient(connection_mode=pybullet.DIRECT)
    yield connected
    connected.disconnect()


def test_the_file_closes_in_pybullet_with_link_3p_turned(client: Any) -> None:
    body = client.loadURDF(str(FOLDER / URDF_FILE), useFixedBase=True)
    joints, links = {}, {}
    for index in range(client.getNumJoints(body)):
        info = client.getJointInfo(body, index)
        joints[info[1].decode()] = links[info[12].decode()] = index
    pairs = yaml.safe_load((FOLDER / LOOPS_FILE).read_text(encoding="utf-8"))["closed_loop"]

    def place(link: str) -> FloatArray:
        return np.array(client.getLinkState(body, links[link], computeForwardKinematics=True)[4])

    closed = 0
    for theta in np.random.default_rng(4).uniform(-np.pi, np.pi, (300, 3)):
        found = forward_rotated(theta)
        for branch in (mode for mode in ROTATED_MODES if found.valid[mode.index]):
            for name, angle in rotated_joint_angles(theta, branch).items():
                client.resetJointState(body, joints[name], angle)
            gaps = [place(one) - place(other) for one, other in pairs]
            assert np.abs(gaps).max() < 1e-12
            # The cup hangs at P and end link 10 at C3, l2 along the platform and l6 back from there
            back = found.orientation[branch.index] @ [PAPER.l2, 0, -PAPER.l6]
            np.testing.assert_allclose(place("cup"), found.position[branch.index], atol=1e-6)
            np.testing.assert_allclose(place("end_link_10") - place("cup"), back, atol=1e-6)
            closed += 1
    assert closed > 50
