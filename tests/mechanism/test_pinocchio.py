"""Pinocchio closes the loops, and holds the robots up, from the two files of each alone."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from machines import anywhere
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics import (
    ASSEMBLY_MODES,
    ROTATED_MODES,
    forward_all,
    forward_rotated,
    inverse,
    workspace,
)
from tpm_gym.kinematics.geometry import PAPER
from tpm_gym.mechanism import DELTA, PAPER_TPM, WIDE_TPM
from tpm_gym.mechanism.export import write
from tpm_gym.mechanism.mount import GRAVITY
from tpm_gym.mechanism.tpm.bodies import joint_angles, rotated_joint_angles
from tpm_gym.resources import URDF as FOLDER

pin = pytest.importorskip(
    "pinocchio", reason="Pinocchio (pip install pin) has no wheels for Windows"
)

LOW, HIGH = (-0.24, 0.012, 0.66), (0.12, 0.046, 0.903)  # m; points P of the paper's cell
START = (-0.04, 0.028, 0.80)
ABOUT = {  # the passive joints at START to ten degrees, all else at 0
    "Sa_swing": 90, "Sa_tilt": -10, "Sb_swing": 90, "Sb_tilt": -10, "R22": -110, "R23": -70,
    "R12": 30, "R13": -30, "R33": 130, "R32": 100,
}  # fmt: skip
CLOSED = 1e-12  # m


class Files:
    """The robot that the two files describe, with gravity as where it hangs upside down."""

    def __init__(self, folder: Path, name: str = "tpm") -> None:
        loops = yaml.safe_load((folder / f"{name}.loops.yaml").read_text(encoding="utf-8"))
        assert loops["type"] == ["3d"] * len(loops["closed_loop"])
        self.model = pin.buildModelFromUrdf(str(folder / f"{name}.urdf"))
        self.model.gravity.linear = np.array([0.0, 0.0, GRAVITY])
        self.data = self.model.createData()
        self.motors = loops["name_mot"]
        self.pairs = [
            [self.model.getFrameId(name) for name in pair] for pair in loops["closed_loop"]
        ]
        self.driven = [self.column(name) for name in self.motors]
        self.passive = np.delete(np.arange(self.model.nv), self.driven)

    def column(self, joint: str) -> int:
        assert self.model.existJointName(joint)
        return int(self.model.joints[self.model.getJointId(joint)].idx_v)

    def posture(self, angles: dict[str, float]) -> FloatArray:
        turn = np.zeros(self.model.nv)
        for name, angle in angles.items():
            turn[self.column(name)] = angle
        return np.asarray(pin.integrate(self.model, pin.neutral(self.model), turn))

    def loops(self, posture: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gaps (3 k,) m of k closures, and what the joints' rates do to them, (3 k, nv)."""
        pin.computeJointJacobians(self.model, self.data, posture)
        pin.updateFramePlacements(self.model, self.data)
        gaps, rows = [], []
        for pair in self.pairs:
            a, b = (self.data.oMf[frame].translation for frame in pair)
            along_a, along_b = (
                pin.getFrameJacobian(self.model, self.data, frame, pin.LOCAL_WORLD_ALIGNED)[:3]
                for frame in pair
            )
            gaps.append(a - b)
            rows.append(along_a - along_b)
        return np.concatenate(gaps), np.vstack(rows)

    def open_by(self, posture: FloatArray) -> float:
        """The widest gap, m."""
        return float(np.linalg.norm(self.loops(posture)[0].reshape(-1, 3), axis=1).max())

    def close(self, posture: FloatArray) -> FloatArray:
        """Newton's method on the passive joints."""
        for _ in range(30):
            gaps, rows = self.loops(posture)
            if np.abs(gaps).max() < CLOSED / 10:
                break
            turn = np.zeros(self.model.nv)
            turn[self.passive] = -np.linalg.pinv(rows[:, self.passive], rcond=1e-9) @ gaps
            posture = pin.integrate(self.model, posture, turn)
        return posture

    def turn_to(self, posture: FloatArray, theta: ArrayLike) -> FloatArray:
        """The same but for the motors, at ``theta`` (3,) rad; loops open."""
        turn = np.zeros(self.model.nv)
        at = [self.model.joints[self.model.getJointId(name)].idx_q for name in self.motors]
        turn[self.driven] = theta - posture[at]
        return np.asarray(pin.integrate(self.model, posture, turn))

    def torque(
        self, posture: FloatArray, rate: ArrayLike, change: ArrayLike, roll: float = 0.0
    ) -> FloatArray:
        """(3,) N m, of the motors: inverse dynamics of the tree, less the forces in the closures.

        End link 10 of a TPM rolls as it likes, and the cup's slide is at rest.
        """
        idle = [self.column(name) for name in ("cup_slide", "R33") if name in self.model.names]
        passive = [k for k in self.passive.tolist() if k not in idle]
        v, a = np.zeros((2, self.model.nv))
        v[self.driven], v[idle[1:]], a[self.driven] = rate, roll, change
        rows = self.loops(posture)[1]
        v[passive] = np.linalg.lstsq(rows[:, passive], -rows @ v)[0]
        pin.forwardKinematics(self.model, self.data, posture, v, a)
        drift = np.concatenate([self.acceleration(one) - self.acceleration(other)
                                for one, other in self.pairs])  # fmt: skip
        a[passive] = np.linalg.lstsq(rows[:, passive], -drift)[0]
        efforts = pin.rnea(self.model, self.data, posture, v, a)
        forces = np.linalg.lstsq(rows[:, passive].T, efforts[passive])[0]
        return np.asarray((efforts - rows.T @ forces)[self.driven])

    def acceleration(self, frame: int) -> FloatArray:
        axes = pin.LOCAL_WORLD_ALIGNED
        found = pin.getFrameClassicalAcceleration(self.model, self.data, frame, axes)
        return np.array(found.linear)


@pytest.fixture(scope="module")
def files():
    return Files(FOLDER)


@pytest.fixture(scope="module")
def found(files):
    """Random points P with the posture that Pinocchio finds, on a straight way from START."""
    rough = {name: float(np.deg2rad(angle)) for name, angle in ABOUT.items()}
    start = files.close(files.turn_to(files.posture(rough), inverse(START)))
    pairs = []
    for point in np.random.default_rng(0).uniform(LOW, HIGH, (300, 3)):
        posture = start
        for between in np.linspace(START, point, 9)[1:]:
            posture = files.close(files.turn_to(posture, inverse(between)))
        pairs.append((point, posture))
    return pairs


def test_the_files_close_where_the_closed_form_has_the_platform(files, found):
    platform = files.model.getFrameId("platform")
    for point, posture in found:
        assert files.open_by(posture) < CLOSED
        placed = files.data.oMf[platform]
        np.testing.assert_allclose(placed.act(np.array([PAPER.l2, 0, PAPER.l6])), point, atol=1e-10)
        np.testing.assert_allclose(placed.rotation, np.eye(3), atol=1e-10)


def test_the_files_close_at_our_joint_angles_all_over_the_workspace(files):
    cloud = np.random.default_rng(1).uniform((-0.5, -0.05, 0.1), (0.5, 0.05, 1.1), (2000, 3))
    points = cloud[workspace.reachable(cloud)][:300]
    assert len(points) == 300
    modes = workspace.assembly_of(points)
    assert len(set(modes.tolist())) > 1
    for point, mode in zip(points, modes, strict=True):
        angles = joint_angles(inverse(point), ASSEMBLY_MODES[mode])
        assert files.open_by(files.posture(angles)) < CLOSED


@pytest.mark.parametrize(
    ("machine", "roll", "share"),  # of the largest torque; the digits of the URDF
    [(machine, roll, 1e-8) for machine in (PAPER_TPM, WIDE_TPM) for roll in (0.0, 30.0)]
    + [(DELTA, 0.0, 1e-6)],
    ids=lambda value: str(getattr(value, "name", value)),
)
def test_torques_are_those_of_pinocchio_on_the_files(machine, roll, share, tmp_path):
    write(tmp_path, machine)
    files, rng = Files(tmp_path, machine.mechanism.name), np.random.default_rng(0)
    for theta in machine.inverse(anywhere(machine, 10)):
        rate, change = rng.normal(size=3), 10 * rng.normal(size=3)
        posture = files.posture(machine.joint_positions(tuple(theta.tolist())))
        assert files.open_by(posture) < 1e-8
        expected = files.torque(posture, rate, change, roll)
        found = machine.torque(theta, rate, change)
        assert np.abs(found - expected).max() < share * np.abs(expected).max()


def test_the_files_close_with_link_3p_turned(files):
    platform, closed = files.model.getFrameId("platform"), 0
    for theta in np.random.default_rng(2).uniform(-np.pi, np.pi, (300, 3)):
        solutions = forward_rotated(theta)
        for branch in (mode for mode in ROTATED_MODES if solutions.valid[mode.index]):
            posture = files.posture(rotated_joint_angles(theta, branch))
            assert files.open_by(posture) < CLOSED
            placed, closed = files.data.oMf[platform], closed + 1
            point_p = placed.act(np.array([PAPER.l2, 0, PAPER.l6]))
            np.testing.assert_allclose(point_p, solutions.position[branch.index], atol=1e-10)
            np.testing.assert_allclose(
                placed.rotation, solutions.orientation[branch.index], atol=1e-10
            )
    assert closed > 50


def test_from_wherever_it_starts_pinocchio_closes_the_loops_in_one_of_the_two_modes(files):
    """Newton's method on all passive joints, which knows of no mode."""
    rng, platform, seen = np.random.default_rng(3), files.model.getFrameId("platform"), set()
    for theta in ([-2.22, -1.27, -2.11], inverse(START)):
        level, turned = forward_all(theta), forward_rotated(theta)
        points = np.concatenate([level.position[level.valid], turned.position[turned.valid]])
        tilts = np.concatenate([np.zeros(level.valid.sum()), turned.tilt[turned.valid]])
        names = [(len(points), i) for i in range(len(points))]
        for start in rng.uniform(-np.pi, np.pi, (60, files.model.nv)):
            neutral = pin.integrate(files.model, pin.neutral(files.model), start)
            posture = files.close(files.turn_to(neutral, theta))
            if files.open_by(posture) > CLOSED:
                continue
            placed = files.data.oMf[platform]
            point_p = placed.act(np.array([PAPER.l2, 0, PAPER.l6]))
            rotations = [pin.utils.rotate("y", float(tilt)) for tilt in tilts]
            apart = np.abs(points - point_p).max(axis=-1)
            apart += [np.abs(placed.rotation - rotation).max() for rotation in rotations]
            assert apart.min() < 1e-8
            seen.add(names[apart.argmin()])
    assert len(seen) > 8
