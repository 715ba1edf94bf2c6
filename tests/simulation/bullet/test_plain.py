"""urdf/tpm.urdf in plain PyBullet, as its header says."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pybullet
import pytest
import yaml
from pybullet_utils.bullet_client import BulletClient

import tpm_gym
from tpm_gym.mechanism.urdf import LOOPS_FILE, URDF_FILE
from tpm_gym.resources import URDF as FOLDER

RATE = 240


@pytest.fixture
def client() -> Iterator[Any]:
    connected = BulletClient(connection_mode=pybullet.DIRECT)
    yield connected
    connected.disconnect()


def largest_gap(client: Any) -> float:
    """Over a second in which the motors swing by 0.1 rad, m."""
    client.setGravity(0, 0, 9.81)
    client.setTimeStep(1 / RATE)
    body = client.loadURDF(
        str(FOLDER / URDF_FILE), useFixedBase=True, flags=client.URDF_USE_INERTIA_FROM_FILE
    )
    infos = [client.getJointInfo(body, index) for index in range(client.getNumJoints(body))]
    joints = {info[1].decode(): info[0] for info in infos}
    links = {info[12].decode(): info[0] for info in infos}
    loops = yaml.safe_load((FOLDER / LOOPS_FILE).read_text(encoding="utf-8"))
    pairs = [[links[name] for name in pair] for pair in loops["closed_loop"]]

    theta = tpm_gym.PAPER_TPM.inverse(tpm_gym.PAPER_TPM.home)
    for name, angle in tpm_gym.PAPER_TPM.joint_positions(theta).items():
        client.resetJointState(body, joints[name], angle)
        client.setJointMotorControl2(body, joints[name], client.VELOCITY_CONTROL, force=0)
    for one, other in pairs:
        ball = client.JOINT_POINT2POINT
        client.createConstraint(body, one, body, other, ball, (0, 0, 0), (0, 0, 0), (0, 0, 0))

    def gap() -> float:
        places = np.array([[client.getLinkState(body, i)[4] for i in pair] for pair in pairs])
        return float(np.linalg.norm(places[:, 0] - places[:, 1], axis=1).max())

    gaps = [gap()]
    for step in range(RATE):
        swing = 0.05 * (1 - math.cos(2 * math.pi * step / RATE))
        for name, start, way in zip(loops["name_mot"], theta, (1, -1, 0.5), strict=True):
            client.setJointMotorControl2(
                body, joints[name], client.POSITION_CONTROL, start + way * swing, force=100
            )
        client.stepSimulation()
        gaps.append(gap())
    return max(gaps)


def test_the_loops_hold_with_the_header_s_solver_and_not_with_a_direct_one(client: Any) -> None:
    client.setPhysicsEngineParameter(numSolverIterations=300, erp=1.0)
    assert 0 < largest_gap(client) < 0.5e-3
    client.resetSimulation()
    client.setPhysicsEngineParameter(constraintSolverType=client.CONSTRAINT_SOLVER_LCP_DANTZIG)
    assert largest_gap(client) > 10e-3
