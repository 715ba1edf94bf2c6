"""The vacuum cup takes, holds, lets go, and never presses harder than its spring."""

import numpy as np
import pytest

from tpm_gym import kinematics
from tpm_gym.mechanism.links import CUP_LENGTH, CUP_PRELOAD, CUP_STROKE
from tpm_gym.simulation.simulation import Simulation
from tpm_gym.simulation.state import Puck, Scene

PLACE = np.array([-0.04, 0.028])  # x, y of the puck and of P, paper frame


def level(height):
    """Point P (paper frame) with the lip at ``height`` above the table."""
    return np.array([*PLACE, 0.97 - height - CUP_LENGTH])


def start(puck=None, offset=(0.0, 0.0), height=0.10):
    puck = puck or Puck()
    simulation = Simulation(Scene(puck=puck))
    position = (PLACE[0] + offset[0], -PLACE[1] + offset[1], puck.height / 2)
    simulation.reset(kinematics.inverse(level(height)), position)
    return simulation


def go(simulation, height, steps, vacuum):
    for _ in range(steps):
        state = simulation.move(level(height), vacuum)
    return state


def test_it_takes_what_it_touches_lifts_it_and_lets_go():
    simulation = start(height=0.05)
    assert not go(simulation, 0.04, 3, vacuum=True).holding  # 10 mm above: nothing to suck on
    assert go(simulation, 0.03, 4, vacuum=True).holding
    lifted = go(simulation, 0.06, 8, vacuum=True)
    lifted = go(simulation, 0.09, 8, vacuum=True)
    assert lifted.holding
    assert lifted.object_position[2] == pytest.approx(0.075, abs=2e-3)
    dropped = simulation.move(level(0.09), vacuum=False)
    assert not dropped.holding
    assert go(simulation, 0.09, 15, vacuum=False).object_position[2] == pytest.approx(
        0.015, abs=1e-3
    )
    simulation.close()


def test_without_vacuum_nothing_is_held():
    simulation = start(height=0.05)
    assert not go(simulation, 0.03, 4, vacuum=False).holding
    assert go(simulation, 0.06, 6, vacuum=False).object_position[2] == pytest.approx(
        0.015, abs=1e-3
    )
    simulation.close()


@pytest.mark.parametrize(("offset", "seals"), [(0.0, True), (0.008, True), (0.014, False)])
def test_the_whole_lip_must_lie_on_the_puck(offset, seals):
    simulation = start(offset=(offset, 0.0), height=0.05)
    assert go(simulation, 0.031, 4, vacuum=True).holding is seals
    simulation.close()


def test_the_puck_does_not_jump_when_it_is_taken():
    simulation = start(offset=(0.006, 0.004), height=0.05)
    before = go(simulation, 0.031, 4, vacuum=True)
    after = go(simulation, 0.031, 3, vacuum=True)
    assert after.holding
    assert np.linalg.norm(after.object_position - before.object_position) < 1e-3
    simulation.close()


@pytest.mark.parametrize(("mass", "lifted"), [(0.05, True), (0.8, True), (2.0, False)])
def test_the_pull_off_force_decides_what_can_be_lifted(mass, lifted):
    # The cup holds 12 N: 1.22 kg at rest, less what acceleration takes.
    simulation = start(Puck(mass=mass), height=0.05)
    assert go(simulation, 0.03, 4, vacuum=True).holding
    for height in np.arange(0.03, 0.07, 0.002):
        state = simulation.move(level(height), vacuum=True)
    assert state.holding is lifted
    assert bool(state.object_position[2] > 0.04) is lifted
    simulation.close()


def test_a_held_puck_stays_put_at_full_speed():
    simulation = start(height=0.05)
    go(simulation, 0.03, 4, vacuum=True)
    go(simulation, 0.06, 5, vacuum=True)
    state = simulation.read()
    grip = state.object_position - state.platform_position
    point = level(0.06)
    for step in (1, 1, 1, -1, -1, -1, 1, -1, 1, -1):
        point = point + (0.03 * step, 0.0, -0.02 * step)
        state = simulation.move(point, vacuum=True)
        assert state.holding
        assert np.linalg.norm(state.object_position - state.platform_position - grip) < 2e-3
    assert state.closure_error < 0.5e-3
    simulation.close()


class Recorder:
    """What the cup does in every time step: force on the puck (N), slide (m), puck's height (m)."""

    def __init__(self, simulation):
        self._simulation, self._step = simulation, simulation._client.stepSimulation
        self.rows = []
        simulation._client.stepSimulation = self.step

    def step(self):
        self._step()
        client, puck = self._simulation._client, self._simulation._scenery.puck
        body, link = self._simulation._robot.tool
        contacts = client.getContactPoints(bodyA=body, bodyB=puck, linkIndexA=link)
        force = sum(contact[9] for contact in contacts)
        slide = client.getJointState(body, link)[0]
        height = client.getBasePositionAndOrientation(puck)[0][2]
        self.rows.append((force, slide, height))


@pytest.mark.parametrize("speed", [0.005, 0.03])  # m a control period; the second is full speed
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.012, 0.012)])
def test_the_cup_yields_to_the_puck_at_its_preload(speed, offset):
    simulation = start(offset=offset, height=0.06)
    record = Recorder(simulation)
    for height in np.arange(0.06, 0.012, -speed):
        simulation.move(level(height))
    go(simulation, 0.012, 10, vacuum=False)  # 18 mm below the top of the puck
    force, slide, height = np.transpose(record.rows)
    cup = simulation.mechanism.link("cup")
    resting = CUP_PRELOAD + cup.mass * 9.81
    blow = cup.mass * speed / 0.04 / simulation.physics.time_step  # stopped in one time step
    assert force.max() <= resting + blow + 0.1
    assert force[-1] == pytest.approx(resting, rel=1e-3)
    assert slide.min() == slide[-1] == pytest.approx(-0.018, abs=1e-4)
    # The puck stays on the table: 0.16 mm into it at the blow, then as if nothing pressed.
    assert (abs(height - 0.015) < 0.2e-3).all()
    assert height[-1] == pytest.approx(0.015, abs=0.03e-3)
    assert np.allclose(simulation.read().object_quaternion, (0, 0, 0, 1), atol=1e-3)
    assert simulation.read().closure_error < 1e-6
    simulation.close()


def test_the_cup_comes_out_again():
    simulation = start(height=0.05)
    record = Recorder(simulation)
    go(simulation, 0.015, 8, vacuum=False)
    assert record.rows[-1][1] == pytest.approx(-0.015, abs=1e-4)
    state = go(simulation, 0.05, 10, vacuum=False)
    force, slide, height = record.rows[-1]
    assert force == 0
    assert slide == pytest.approx(0, abs=1e-6)
    assert height == pytest.approx(0.015, abs=0.03e-3)
    assert np.linalg.norm(state.object_position[:2] - (PLACE[0], -PLACE[1])) < 1e-4
    simulation.close()


def test_the_cup_stays_out_in_free_motion_at_full_speed():
    simulation = start(height=0.2)
    record = Recorder(simulation)
    for step in (1, 1, 1, 1, -1, -1, -1, -1, 1, -1, 1, -1, 1, 1, -1):
        simulation.move(simulation.mount.to_paper(simulation.read().command) + (0, 0, 0.03 * step))
    assert max(abs(slide) for _, slide, _ in record.rows) < 1e-6
    simulation.close()


def test_beyond_its_stroke_the_cup_stops_and_the_puck_holds():
    simulation = start(height=0.05)
    state = go(simulation, 0.006, 12, vacuum=False)  # 24 mm below the top, 4 mm beyond the stroke
    slide = simulation._client.getJointState(*simulation._robot.tool)[0]
    assert slide == pytest.approx(-CUP_STROKE, abs=1e-6)
    assert state.object_position[2] == pytest.approx(0.015, abs=0.1e-3)
    assert state.closure_error < 1e-5
    simulation.close()


def test_a_held_puck_pressed_on_the_table_stays_held_and_the_cup_yields():
    simulation = start(height=0.05)
    go(simulation, 0.03, 4, vacuum=True)
    assert go(simulation, 0.06, 5, vacuum=True).holding
    record = Recorder(simulation)
    for height in np.arange(0.06, 0.012, -0.006):
        assert simulation.move(level(height), vacuum=True).holding
    state = go(simulation, 0.012, 5, vacuum=True)
    assert state.holding
    assert state.object_position[2] == pytest.approx(0.015, abs=0.1e-3)
    assert record.rows[-1][1] == pytest.approx(-0.018, abs=1e-3)
    lifted = [simulation.move(level(height), vacuum=True) for height in (0.02, 0.03, 0.04, 0.05)]
    assert all(state.holding for state in lifted)
    simulation.close()


def test_a_reset_while_holding_lets_go():
    simulation = start(height=0.05)
    assert go(simulation, 0.03, 4, vacuum=True).holding
    state = simulation.reset(kinematics.inverse(level(0.1)), (0.0, -0.03, 0.015))
    assert not state.holding
    state = go(simulation, 0.1, 5, vacuum=True)
    assert np.allclose(state.object_position, (0.0, -0.03, 0.015), atol=1e-3)
    simulation.close()


def test_a_snapshot_remembers_the_grasp():
    simulation = start(height=0.05)
    go(simulation, 0.03, 4, vacuum=True)
    held = go(simulation, 0.06, 5, vacuum=True)
    snapshot = simulation.save()
    go(simulation, 0.06, 10, vacuum=False)
    again = simulation.restore(snapshot)
    assert again.holding
    assert np.allclose(again.object_position, held.object_position, atol=1e-9)
    state = go(simulation, 0.06, 5, vacuum=True)
    assert state.holding
    assert np.allclose(state.object_position, held.object_position, atol=1e-3)
    simulation.close()
