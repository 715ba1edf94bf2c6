"""The tree of links closes its loops, stands where the kinematics say, and can be a machine."""

import numpy as np
import oracle
import pytest
from examples import examples
from hypothesis import example
from machines import each_machine
from walk import gaps, place, walk

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import InputError
from tpm_gym.kinematics import (
    ASSEMBLY_MODES,
    ROTATED_MODES,
    AssemblyMode,
    forward,
    forward_all,
    forward_rotated,
    inverse_all,
)
from tpm_gym.kinematics.geometry import PAPER, WIDE, Geometry
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.motor import TORQUE_MOTOR
from tpm_gym.mechanism.tpm.bodies import ACTUATED_JOINTS, build, joint_angles, rotated_joint_angles

GAP = 1e-9
# Link of the paper's Fig. 1 -> bodies; 3 is rigid with arm 2, 8 with platform 1.
FIG_1 = {
    "0": ["base"],
    "1, 8": ["platform"],
    "2, 3": ["arm_2"],
    "3'": ["link_3p"],
    "4": ["rod_4a", "rod_4b"],
    "5": ["arm_5"],
    "6": ["rod_6"],
    "7": ["link_7"],
    "9": ["end_link_9"],
    "10": ["end_link_10"],
    "11": ["rod_11a", "rod_11b"],
    "12": ["arm_12"],
}
UNIVERSAL_CROSSES = ["cross_4a", "cross_4b"]
TOOL = ["cup"]


def assert_assembled(theta: FloatArray, branch: AssemblyMode, g: Geometry) -> None:
    mechanism = build(g)
    joints = joint_angles(theta, branch, g)
    assert np.linalg.norm(gaps(mechanism, joints), axis=-1).max() < GAP
    frames = walk(mechanism, joints)
    found = place(frames, mechanism.platform, mechanism.point_p)
    np.testing.assert_allclose(found, forward(theta, branch, g), rtol=0, atol=GAP)
    for level in (mechanism.platform, "link_3p"):
        np.testing.assert_allclose(frames[level][1], np.eye(3), rtol=0, atol=GAP)
    roll = [frames[link][1] for link in ("end_link_9", "end_link_10")]
    np.testing.assert_allclose(*roll, rtol=0, atol=GAP)  # idle, but set parallel
    solutions = forward_all(theta, g)
    (x_c, z_c), beta = solutions.link3[branch.index], solutions.beta[branch.index]
    p = oracle.points(theta, x_c, z_c, beta, g)
    origins = {"arm_2": "A1", "arm_5": "A2", "arm_12": "A3", "rod_6": "B2", "link_3p": "C2"}
    origins |= {"end_link_9": "B3", "link_7": "D1", "platform": "E1", "end_link_10": "C3"}
    for link, point in origins.items():
        np.testing.assert_allclose(frames[link][0], p[point], rtol=0, atol=GAP, err_msg=point)
    half = np.array([g.l5, 0, 0])
    for suffix, side in (("a", 1), ("b", -1)):
        foot = frames[f"rod_4{suffix}"][0]
        np.testing.assert_allclose(foot, p["B1"] + side * half, rtol=0, atol=GAP)
    np.testing.assert_allclose(
        place(frames, "rod_4a", (0, g.l4, 0)) - half, p["C1"], rtol=0, atol=GAP
    )


@examples(40, oracle.geometries(), oracle.seeds())
def test_joint_angles_close_every_loop_and_place_the_platform(g, seed):
    solutions = inverse_all(oracle.reachable_points(np.random.default_rng(seed), 1, g), g)
    for theta in solutions.theta[solutions.valid][:4]:
        for branch in ASSEMBLY_MODES:
            # Where a factor vanishes, rounding of theta moves the platform more than GAP.
            if forward_all(theta, g).valid[branch.index]:
                assert_assembled(theta, branch, g)


def test_every_link_of_figure_1_is_there_and_nothing_else():
    bodies = [name for names in FIG_1.values() for name in names]
    assert sorted(link.name for link in build().links) == sorted(bodies + UNIVERSAL_CROSSES + TOOL)


@examples(20, oracle.geometries())
def test_inertias_of_moving_links_are_along_their_axes(g):
    for link in build(g).links[1:]:
        assert link.mass > 0
        # The URDF gives no rotation of the inertial frame.
        off_diagonal = link.inertia - np.diag(np.diag(link.inertia))
        assert np.abs(off_diagonal).max() <= 1e-12


def test_legs_part_the_links_and_every_closure_joins_two_of_them():
    # What makes the direct solver exact: no closure has both ends in one multibody.
    mechanism = build()
    legs = mechanism.legs()
    moving = [[link.name for link in leg.links[1:]] for leg in legs]
    leg_of = {name: i for i, names in enumerate(moving) for name in names}
    assert sum(len(names) for names in moving) == len(leg_of) == len(mechanism.links) - 1
    for names, leg, motor in zip(moving, legs, ACTUATED_JOINTS, strict=True):
        assert leg.links == (mechanism.links[0], *(mechanism.link(name) for name in names))
        joints = [link.joint for link in leg.links[1:] if link.joint]
        assert (joints[0].name, joints[0].parent) == (motor, "base")
        for i, joint in enumerate(joints[1:], start=1):
            assert joint.parent in names[:i]  # one tree, parents first
    for closure in mechanism.closures:
        assert leg_of[closure.link_a] != leg_of[closure.link_b], closure.name
    assert len({closure.name for closure in mechanism.closures}) == len(mechanism.closures) == 4
    with pytest.raises(KeyError):
        mechanism.link("arm_3")


@each_machine
def test_only_the_three_motors_drive(machine):
    joints = {link.joint.name: link.joint for link in machine.mechanism.links if link.joint}
    assert machine.mechanism.actuated == ACTUATED_JOINTS
    for joint in (joints.pop(name) for name in ACTUATED_JOINTS):
        assert (joint.kind, joint.parent) == ("revolute", "base")
        assert joint.effort == TORQUE_MOTOR.peak_torque
        assert (joint.corner, joint.speed) == (
            TORQUE_MOTOR.corner_speed,
            TORQUE_MOTOR.no_load_speed,
        )
    del joints["cup_slide"]
    assert {(joint.kind, joint.effort, joint.speed) for joint in joints.values()} == {
        ("continuous", 0, 0)
    }


@each_machine
def test_the_cup_is_under_point_p_slides_back_along_its_axis_and_alone_collides(machine):
    mechanism = machine.mechanism
    rest = machine.joint_positions(machine.inverse(machine.home))
    joint = mechanism.link(mechanism.tool).joint
    assert joint is not None
    assert (joint.kind, joint.parent) == ("prismatic", mechanism.platform)
    assert joint.lower == -CUP.stroke
    assert 0 < joint.upper <= 0.001  # the stop must not fight the spring at rest
    assert joint.effort == CUP.preload
    point_p = place(walk(mechanism, rest), mechanism.platform, mechanism.point_p)
    for slide in (0.0, -CUP.stroke):
        lip = place(walk(mechanism, rest | {"cup_slide": slide}), mechanism.tool, mechanism.lip)
        np.testing.assert_allclose(lip - point_p, [0, 0, CUP.length + slide], atol=1e-9)
    colliding = [(link, s) for link in mechanism.links for s in link.solids if s.collides]
    assert [link.name for link, _ in colliding] == [mechanism.tool]
    bellows = colliding[0][1]
    assert bellows.centre[2] + bellows.size[1] / 2 == pytest.approx(mechanism.lip[2])


@examples(4, oracle.geometries(), oracle.seeds())
@example(PAPER, 1)
@example(WIDE, 1)
def test_rotated_joint_angles_close_every_loop_and_turn_the_platform(g, seed):
    mechanism = build(g)
    for theta in np.random.default_rng(seed).uniform(-np.pi, np.pi, (20, 3)):
        found = forward_rotated(theta, g)
        for branch in ROTATED_MODES:
            if not found.valid[branch.index]:
                with pytest.raises(InputError, match="exists at theta"):
                    rotated_joint_angles(theta, branch, g)
                continue
            joints = rotated_joint_angles(theta, branch, g)
            assert np.abs(gaps(mechanism, joints)).max() < 1e-13
            frames = walk(mechanism, joints)
            point_p = place(frames, mechanism.platform, mechanism.point_p)
            np.testing.assert_allclose(point_p, found.position[branch.index], atol=1e-13)
            for level in (mechanism.platform, "link_3p"):
                turned = found.orientation[branch.index]
                np.testing.assert_allclose(frames[level][1], turned, atol=1e-13)
            roll = [frames[link][1] for link in ("end_link_9", "end_link_10")]
            np.testing.assert_allclose(*roll, atol=1e-13)  # idle, but set parallel
