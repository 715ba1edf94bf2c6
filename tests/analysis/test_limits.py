"""Stops agree with the machine's, and distances of links with MuJoCo's bodies."""

import re
from itertools import combinations

import mujoco
import numpy as np
import oracle
import pytest
from clearance import clear_of_links, clearance
from paths import ROOT

from tpm_gym.analysis import aspects
from tpm_gym.analysis.limits import within_stops
from tpm_gym.arrays import FloatArray
from tpm_gym.errors import JointLimitError
from tpm_gym.kinematics import ASSEMBLY_MODES, ELBOWS_OUT, WORKING_MODES, inverse, workspace
from tpm_gym.kinematics.geometry import PAPER, WIDE
from tpm_gym.mechanism import PAPER_TPM, WIDE_TPM, Machine
from tpm_gym.mechanism.mjcf import mjcf_text
from tpm_gym.mechanism.tpm.bodies import joint_angles

COARSE = (32, 8, 48)
JOINED = [  # by a joint, a closure, or the cross between an arm and its rod
    *(("arm_2", "rod_4a"), ("arm_2", "rod_4b"), ("arm_5", "rod_6"), ("rod_6", "link_3p")),
    *(("rod_4a", "link_3p"), ("rod_4b", "link_3p"), ("link_3p", "link_7"), ("link_7", "platform")),
    *(("platform", "cup"), ("platform", "end_link_10"), ("arm_12", "end_link_9")),
    *((end, rod) for end in ("end_link_9", "end_link_10") for rod in ("rod_11a", "rod_11b")),
]


def some_points(count: int, machine: Machine, mode: object = ELBOWS_OUT) -> FloatArray:
    g = machine.geometry
    points = oracle.reachable_points(np.random.default_rng(0), 4 * count, g)
    return points[workspace.reachable(points, mode, g)][:count]


@pytest.mark.parametrize("machine", [PAPER_TPM, WIDE_TPM])
def test_stops_are_those_that_the_machine_enforces(machine):
    g = PAPER if machine is PAPER_TPM else WIDE
    points = some_points(400, machine)
    inside = within_stops(points, ELBOWS_OUT, g)
    assert 0.1 < inside.mean() < 0.9
    for point, expected in zip(points, inside, strict=True):
        theta = machine.inverse(tuple(point.tolist()))
        if expected:
            machine.require_within_stops(theta)
        else:
            with pytest.raises(JointLimitError):
                machine.require_within_stops(theta)


def slender(model: mujoco.MjModel) -> list[int]:
    """Return geoms at least twice as long as wide, without those of the base and the world."""
    found = []
    for index in range(model.ngeom):
        geom = model.geom(index)
        name, size = model.body(geom.bodyid.item()).name, geom.size
        if geom.type.item() == mujoco.mjtGeom.mjGEOM_CYLINDER:
            size = np.array([size[1], size[0], size[0]])
        long, wide, _ = np.sort(size)[::-1] if size[0] < size.max() else size
        if name not in ("world", "base") and long >= 2 * wide:
            found.append(index)
    return found


def nearest_geoms(machine: Machine, points: FloatArray, mode: int) -> list[float]:
    """Return the least distance of MuJoCo's unjoined bodies in each posture, m."""
    g = PAPER if machine is PAPER_TPM else WIDE
    model = mujoco.MjModel.from_xml_string(mjcf_text(machine))
    data = mujoco.MjData(model)
    geoms = slender(model)
    owner = {index: model.body(model.geom(index).bodyid.item()).name for index in geoms}
    joined = {frozenset(pair) for pair in JOINED} | {frozenset([name]) for name in owner.values()}
    result = []
    for point in points:
        theta = inverse(point, WORKING_MODES[mode], g)
        slot = int(workspace.assembly_of(point, WORKING_MODES[mode], g))
        for name, angle in joint_angles(theta, ASSEMBLY_MODES[slot], g).items():
            data.joint(name).qpos = angle
        mujoco.mj_kinematics(model, data)
        gaps = [
            mujoco.mj_geomDistance(model, data, one, other, 2.0, np.zeros(6))
            for one, other in combinations(geoms, 2)
            if frozenset((owner[one], owner[other])) not in joined
        ]
        result.append(min(gaps))
    return result


@pytest.mark.parametrize(
    ("machine", "mode"),
    [(PAPER_TPM, ELBOWS_OUT.index), (PAPER_TPM, 0), (WIDE_TPM, ELBOWS_OUT.index)],
)
def test_clearance_is_that_of_mujoco_s_bodies(machine, mode):
    g = PAPER if machine is PAPER_TPM else WIDE
    points = some_points(40, machine, WORKING_MODES[mode])
    found = clearance(points, WORKING_MODES[mode], g)
    bodies = np.array(nearest_geoms(machine, points, mode))
    apart, known = bodies > 0, bodies != 0  # 0 is what MuJoCo says where its search went astray
    assert apart.any()
    assert known.mean() > 0.8
    assert (found < 0).any()
    # Capsules lie within the boxes and cylinders; what they leave out is at most a corner.
    assert (found[apart] > bodies[apart] - 1e-6).all()
    assert (found < np.maximum(bodies, 0.0) + 0.010)[known].all()
    np.testing.assert_array_equal(clear_of_links(points, WORKING_MODES[mode], g), found > 0)


def test_task_regions_are_within_all_limits():
    for machine, g in ((PAPER_TPM, PAPER), (WIDE_TPM, WIDE)):
        points = oracle.grid(machine.region.low, machine.region.high, (5, 5, 5)).reshape(-1, 3)
        assert within_stops(points, ELBOWS_OUT, g).all()
        assert clear_of_links(points, ELBOWS_OUT, g).all()


def test_limits_leave_parts_of_sets_and_of_aspects():
    whole = aspects.reachable_set(shape=COARSE)
    left = [
        aspects.reachable_set(shape=COARSE, limits=limits)
        for limits in ((within_stops,), (clear_of_links,), (within_stops, clear_of_links))
    ]
    np.testing.assert_array_equal(left[2].mask, left[0].mask & left[1].mask)
    assert left[2].volume < left[0].volume < 0.5 * whole.volume
    for part, limit in zip(left, (within_stops, clear_of_links), strict=False):
        np.testing.assert_array_equal(
            limit(whole.centres(), ELBOWS_OUT, PAPER), part.mask[whole.mask]
        )
    parts = aspects.aspects(shape=COARSE, min_cells=1, limits=(within_stops,))
    np.testing.assert_array_equal(sum(a.cells.mask.astype(int) for a in parts), left[0].mask)
    for part in parts[:2]:
        points = aspects.sample(np.random.default_rng(0), part, 200)
        assert within_stops(points, ELBOWS_OUT, PAPER).all()
        assert aspects.largest_box(part, 0.02).volume < part.cells.volume


def test_the_figures_page_says_what_the_limits_leave():
    """It has percentages of the elbows-out mode, and of its regions with z_C1 > z_B1."""
    text = " ".join((ROOT / "docs" / "figures.md").read_text(encoding="utf-8").split())
    said = re.search(r"(\d+)% of it lies within the motors' stops, and (\d+)% if also no", text)
    dark = re.search(r"lie (\d+)% of the largest aspect, (\d+)% of the dark orange one", text)
    assert said
    assert dark
    left = []
    for aspect in aspects.aspects(shape=(64, 8, 96)):
        points = aspect.cells.centres()
        stops = within_stops(points, ELBOWS_OUT, PAPER)
        clear = clear_of_links(points[stops], ELBOWS_OUT, PAPER)
        left.append((aspect.elevation, len(points), stops.sum(), clear.sum()))
    elevation, whole, stops, clear = np.array(left).T
    both = [100 * part.sum() / whole.sum() for part in (stops, clear)]
    assert both == pytest.approx([float(n) for n in said.groups()], abs=1)
    shares = (100 * stops / whole)[elevation > 0]
    assert shares[[0, 2]] == pytest.approx([float(n) for n in dark.groups()], abs=1.5)
