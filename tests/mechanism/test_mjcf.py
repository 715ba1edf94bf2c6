"""The MJCF file is what the mechanism's data give, and MuJoCo alone loads and moves it."""

from typing import Any

import mujoco
import numpy as np
import pytest
from paths import ROOT

from tpm_gym.mechanism import PAPER_TPM, WIDE_TPM, Machine
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.export import SHIPPED
from tpm_gym.mechanism.mjcf import mjcf_text, site_names
from tpm_gym.resources import URDF as FOLDER

MECHANISM = PAPER_TPM.mechanism
both = pytest.mark.parametrize("machine", SHIPPED, ids=lambda machine: machine.name)


@pytest.fixture(params=[*SHIPPED, WIDE_TPM], ids=lambda machine: machine.name)
def machine(request):
    machine: Machine = request.param
    return machine


def shipped(machine: Machine = PAPER_TPM) -> tuple[Any, Any]:
    """Model and data of the file, at its key frame."""
    model = mujoco.MjModel.from_xml_path(str(FOLDER / f"{machine.mechanism.name}.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    return model, data


def gap(data: Any, machine: Machine = PAPER_TPM) -> float:
    """The widest of the closures, m."""
    sides = [site_names(closure.name) for closure in machine.mechanism.closures]
    return max(float(np.linalg.norm(data.site(a).xpos - data.site(b).xpos)) for a, b in sides)


def angles(data: Any, machine: Machine = PAPER_TPM) -> tuple[float, float, float]:
    a, b, c = (data.joint(name).qpos.item() for name in machine.mechanism.actuated)
    return a, b, c


def miss(data: Any, machine: Machine = PAPER_TPM) -> float:
    """From P of the simulated platform to the forward kinematics of the motors' angles, m."""
    platform = data.body(machine.mechanism.platform)
    position = platform.xpos + platform.xmat.reshape(3, 3) @ machine.mechanism.point_p
    known = machine.mount.to_world(machine.forward(angles(data, machine)))
    return float(np.linalg.norm(position - known))


def test_links_are_those_of_the_mechanism(machine):
    model = mujoco.MjModel.from_xml_string(mjcf_text(machine))
    for link in machine.mechanism.links[1:]:
        body, joint = model.body(link.name), link.joint
        assert joint is not None
        assert body.mass.item() == pytest.approx(link.mass, rel=1e-8)
        assert body.ipos == pytest.approx(link.centre_of_mass, abs=1e-9)
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, body.iquat)
        axes = turn.reshape(3, 3)
        found = axes @ np.diag(body.inertia) @ axes.T
        np.testing.assert_allclose(found, link.inertia, rtol=1e-7, atol=1e-12)
        assert model.body(body.parentid.item()).name == joint.parent
        assert body.pos == pytest.approx(joint.origin, abs=1e-9)
        assert model.joint(joint.name).axis == pytest.approx(joint.axis)
        if joint.kind == "revolute":
            assert model.joint(joint.name).range == pytest.approx((joint.lower, joint.upper))
            assert model.actuator(joint.name).forcerange.tolist() == [-joint.effort, joint.effort]


def test_solids_are_drawn_where_they_are_and_the_lip_alone_collides():
    model, _ = shipped()
    solids = [(link, solid) for link in MECHANISM.links for solid in link.solids]
    found = [index for index in range(model.ngeom) if model.geom(index).name != "table"]
    colliding = [index for index in found if model.geom_contype[index]]
    assert [model.geom(index).name for index in colliding] == [MECHANISM.tool]
    assert len(found) == len(solids)
    for link in MECHANISM.links:
        body = model.body(link.name)
        rows = range(body.geomadr.item(), body.geomadr.item() + body.geomnum.item())
        for index, solid in zip(rows, link.solids, strict=True):
            turn = np.empty(9)
            mujoco.mju_quat2Mat(turn, model.geom_quat[index])
            radius, *_ = model.geom_size[index]
            if solid.kind == "cylinder":
                _, half, _ = model.geom_size[index]
                along = np.abs(turn.reshape(3, 3)[:, 2])
                extent = half * along + radius * (1 - along)
            else:
                extent = model.geom_size[index]
            np.testing.assert_allclose(extent, solid.half_extent, atol=1e-9)
            np.testing.assert_allclose(model.geom_pos[index], solid.centre, atol=1e-9)


@both
def test_at_home_loops_are_closed_and_p_is_at_home(machine):
    _, data = shipped(machine)
    assert gap(data, machine) < 1e-8
    assert miss(data, machine) < 1e-8
    found = angles(data, machine)
    np.testing.assert_allclose(machine.forward(found), machine.home, atol=1e-8)
    np.testing.assert_allclose(data.ctrl, found, atol=1e-9)


@both
def test_it_is_moved_by_ctrl_with_its_loops_closed(machine):
    """Out 150 mm and back within 2 s; measured: loops within 0.02 um, 5 mrad behind."""
    model, data = shipped(machine)
    gaps, misses, lags = [], [], []
    for share in (1 - np.cos(np.linspace(0, 2 * np.pi, 4000))) / 2:
        point = np.add(machine.home, share * np.array((-0.15, 0.012, 0.08)))
        data.ctrl[:] = machine.inverse(tuple(point))
        mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        gaps.append(gap(data, machine))
        misses.append(miss(data, machine))
        lags.append(np.abs(np.subtract(angles(data, machine), data.ctrl)).max())
    assert max(gaps) < 1e-6
    assert max(misses) < 1e-6
    assert max(lags) < 0.01
    assert lags[-1] < 0.002


def test_torques_at_rest_are_those_of_the_closed_form_and_limited():
    model, data = shipped()
    for _ in range(1000):
        mujoco.mj_step(model, data)
    expected = PAPER_TPM.torque(angles(data), (0, 0, 0), (0, 0, 0))
    np.testing.assert_allclose(data.actuator_force, expected, atol=1e-3)
    data.ctrl[0] += 0.5
    mujoco.mj_step(model, data)
    assert data.actuator_force[0] == model.actuator("R11").forcerange[1]


def test_the_cup_yields_at_its_preload():
    model, data = shipped()
    slide = data.joint("cup_slide")
    weight = 9.81 * model.body(MECHANISM.tool).mass.item()
    for share, expected in ((0.95, 0.0), (1.05, -0.010)):
        mujoco.mj_resetDataKeyframe(model, data, 0)
        force = share * CUP.preload + weight
        data.xfrc_applied[model.body(MECHANISM.tool).id, 2] = force
        positions = []
        for _ in range(4000):
            mujoco.mj_step(model, data)
            positions.append(slide.qpos.item())
        # 75 N/m: 5% more than the preload takes it in by 10 mm, about which it swings.
        assert np.mean(positions) == pytest.approx(expected, abs=1e-3)


def test_the_scene_shows_the_robot_and_touches_nothing():
    model = mujoco.MjModel.from_xml_path(str(FOLDER / "scene.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_step(model, data, nstep=400)
    assert data.ncon == 0
    assert np.abs(data.qvel).max() < 0.02
    assert (FOLDER / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()
