"""urdf/tpm.urdf and its loops in plain PyBullet, without this package's engine."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pybullet
import pytest
import yaml
from pybullet_utils.bullet_client import BulletClient

import tpm_gym
from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics import ROTATED_MODES, forward_rotated
from tpm_gym.kinematics.geometry import PAPER
from tpm_gym.mechanism.tpm.bodies import rotated_joint_angles
from tpm_gym.resources import URDF as FOLDER

RATE = 240


class Robot:
    """The two files in a client of their own."""

    def __init__(self) -> None:
        self.client: Any = BulletClient(connection_mode=pybullet.DIRECT)
        flags = self.client.URDF_USE_INERTIA_FROM_FILE
        path = str(FOLDER / "tpm.urdf")
        self.body = self.client.loadURDF(path, useFixedBase=True, flags=flags)
        self.joints, self.links = {}, {}
        for index in range(self.client.getNumJoints(self.body)):
            info = self.client.getJointInfo(self.body, index)
            self.joints[info[1].decode()] = self.links[info[12].decode()] = index
        loops = yaml.safe_load((FOLDER / "tpm.loops.yaml").read_text(encoding="utf-8"))
        self.pairs, self.motors = loops["closed_loop"], loops["name_mot"]

    def put(self, angles: Mapping[str, float]) -> None:
        for name, angle in angles.items():
            self.client.resetJointState(self.body, self.joints[name], angle)

    def place(self, link: str) -> FloatArray:
        state = self.client.getLinkState(self.body, self.links[link], computeForwardKinematics=True)
        return np.array(state[4])

    def gaps(self) -> FloatArray:
        return np.array([self.place(one) - self.place(other) for one, other in self.pairs])

    def largest_gap(self) -> float:
        """Over a second in which the motors swing by 0.1 rad, m."""
        client, body = self.client, self.body
        client.setGravity(0, 0, 9.81)
        client.setTimeStep(1 / RATE)
        theta = tpm_gym.PAPER_TPM.inverse(tpm_gym.PAPER_TPM.home)
        angles = tpm_gym.PAPER_TPM.joint_positions(theta)
        self.put(angles)
        for name in angles:
            client.setJointMotorControl2(body, self.joints[name], client.VELOCITY_CONTROL, force=0)
        for one, other in self.pairs:
            ends = (body, self.links[one], body, self.links[other])
            client.createConstraint(*ends, client.JOINT_POINT2POINT, *[(0, 0, 0)] * 3)
        largest = float(np.linalg.norm(self.gaps(), axis=1).max())
        for step in range(RATE):
            swing = 0.05 * (1 - math.cos(2 * math.pi * step / RATE))
            for name, start, way in zip(self.motors, theta, (1, -1, 0.5), strict=True):
                mode, target = client.POSITION_CONTROL, start + way * swing
                client.setJointMotorControl2(body, self.joints[name], mode, target, force=100)
            client.stepSimulation()
            largest = max(largest, float(np.linalg.norm(self.gaps(), axis=1).max()))
        return largest


@pytest.fixture
def robot():
    loaded = Robot()
    yield loaded
    loaded.client.disconnect()


def test_the_loops_hold_with_the_solver_that_its_head_names(robot):
    robot.client.setPhysicsEngineParameter(numSolverIterations=300, erp=1.0)
    assert 0 < robot.largest_gap() < 0.5e-3


def test_the_loops_do_not_hold_with_a_direct_solver(robot):
    robot.client.setPhysicsEngineParameter(
        constraintSolverType=robot.client.CONSTRAINT_SOLVER_LCP_DANTZIG
    )
    assert robot.largest_gap() > 10e-3


def test_the_file_closes_with_link_3p_turned(robot):
    closed = 0
    for theta in np.random.default_rng(4).uniform(-np.pi, np.pi, (300, 3)):
        found = forward_rotated(theta)
        for branch in (mode for mode in ROTATED_MODES if found.valid[mode.index]):
            robot.put(rotated_joint_angles(theta, branch))
            assert np.abs(robot.gaps()).max() < 1e-12
            # The cup hangs at P and end link 10 at C3, l2 along the platform and l6 back from there
            back = found.orientation[branch.index] @ [PAPER.l2, 0, -PAPER.l6]
            cup = robot.place("cup")
            np.testing.assert_allclose(cup, found.position[branch.index], atol=1e-6)
            np.testing.assert_allclose(robot.place("end_link_10") - cup, back, atol=1e-6)
            closed += 1
    assert closed > 50
