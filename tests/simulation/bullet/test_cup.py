"""The vacuum cup takes, holds, lets go, and never presses harder than its spring."""

import numpy as np
import pytest
from inside_bullet import around_each_step

from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.mechanism.cup import CUP
from tpm_gym.simulation import Block, Scene, Simulation

PLACE = np.array([-0.04, 0.028])  # x, y of the puck and of P, machine's frame


def level(height):
    """Point P (machine's frame) with the lip at ``height`` above the table."""
    return np.array([*PLACE, PAPER_TPM.mount.height - height - CUP.length])


def start(puck=None, offset=(0.0, 0.0), height=0.10):
    puck = puck or Block()
    simulation = Simulation(Scene(objects=(puck,)))
    position = (PLACE[0] + offset[0], -PLACE[1] + offset[1], puck.height / 2)
    simulation.reset(PAPER_TPM.inverse(level(height)), {"object": position})
    return simulation


def start_holding():
    """The puck is in the cup and still on the table."""
    simulation = start(height=0.05)
    assert go(simulation, 0.03, 4, vacuum=True).held == 0
    return simulation


def go(simulation, height, steps, vacuum):
    for _ in range(steps):
        state = simulation.move(level(height), vacuum)
    return state


def test_it_takes_what_it_touches_lifts_it_and_lets_go():
    simulation = start(height=0.05)
    assert go(simulation, 0.04, 3, vacuum=True).held == -1  # 10 mm above: nothing to suck on
    assert go(simulation, 0.03, 4, vacuum=True).held == 0
    lifted = go(simulation, 0.06, 8, vacuum=True)
    lifted = go(simulation, 0.09, 8, vacuum=True)
    assert lifted.held == 0
    assert lifted.object_position[0, 2] == pytest.approx(0.075, abs=2e-3)
    dropped = simulation.move(level(0.09), vacuum=False)
    assert dropped.held == -1
    assert go(simulation, 0.09, 15, vacuum=False).object_position[0, 2] == pytest.approx(
        0.015, abs=1e-3
    )


def test_the_puck_does_not_jump_when_it_is_taken():
    simulation = start(offset=(0.006, 0.004), height=0.05)
    before = go(simulation, 0.031, 4, vacuum=True)
    after = go(simulation, 0.031, 3, vacuum=True)
    assert after.held == 0
    assert np.linalg.norm(after.object_position - before.object_position) < 1e-3


def test_a_held_puck_stays_put_at_full_speed():
    simulation = start_holding()
    state = go(simulation, 0.06, 5, vacuum=True)
    grip = state.object_position - state.platform_position
    point = level(0.06)
    for step in (1, 1, 1, -1, -1, -1, 1, -1, 1, -1):
        point = point + (0.03 * step, 0.0, -0.02 * step)
        state = simulation.move(point, vacuum=True)
        assert state.held == 0
        assert np.linalg.norm(state.object_position - state.platform_position - grip) < 2e-3
    assert state.closure_error < 0.5e-3


def record(simulation):
    """Rows for every time step: force on the puck (N), the cup's slide (m), puck's height (m)."""
    client, (puck,), rows = simulation.engine.client, simulation.engine.bodies, []
    body, link = simulation.engine.robot.tool

    def note():
        contacts = client.getContactPoints(bodyA=body, bodyB=puck, linkIndexA=link)
        force = sum(contact[9] for contact in contacts)
        slide = client.getJointState(body, link)[0]
        rows.append((force, slide, client.getBasePositionAndOrientation(puck)[0][2]))

    around_each_step(simulation, after=note)
    return rows


@pytest.mark.parametrize("speed", [0.005, 0.03])  # m a control period; the second is full speed
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.012, 0.012)])
def test_the_cup_yields_to_the_puck_at_its_preload(speed, offset):
    simulation = start(offset=offset, height=0.06)
    rows = record(simulation)
    for height in np.arange(0.06, 0.012, -speed):
        simulation.move(level(height))
    go(simulation, 0.012, 10, vacuum=False)  # 18 mm below the top of the puck
    force, slide, height = np.transpose(rows)
    cup = PAPER_TPM.mechanism.link("cup")
    resting = CUP.preload + cup.mass * 9.81
    blow = cup.mass * speed / 0.04 / simulation.engine.physics.time_step  # stopped in one time step
    assert force.max() <= resting + blow + 0.1
    assert force[-1] == pytest.approx(resting, rel=1e-3)
    assert slide.min() == slide[-1] == pytest.approx(-0.018, abs=1e-4)
    # The puck stays on the table: 0.16 mm into it at the blow, then as if nothing pressed.
    assert (abs(height - 0.015) < 0.2e-3).all()
    assert height[-1] == pytest.approx(0.015, abs=0.03e-3)
    assert np.allclose(simulation.read().object_quaternion, (0, 0, 0, 1), atol=1e-3)
    assert simulation.read().closure_error < 1e-6


def test_the_cup_comes_out_again():
    simulation = start(height=0.05)
    rows = record(simulation)
    go(simulation, 0.015, 8, vacuum=False)
    assert rows[-1][1] == pytest.approx(-0.015, abs=1e-4)
    state = go(simulation, 0.05, 10, vacuum=False)
    assert state.held == -1  # without vacuum
    force, slide, height = rows[-1]
    assert force == 0
    assert slide == pytest.approx(0, abs=1e-6)
    assert height == pytest.approx(0.015, abs=0.03e-3)
    assert np.linalg.norm(state.object_position[0, :2] - (PLACE[0], -PLACE[1])) < 1e-4


def test_the_cup_stays_out_in_free_motion_at_full_speed():
    simulation = start(height=0.2)
    rows = record(simulation)
    for step in (1, 1, 1, 1, -1, -1, -1, -1, 1, -1, 1, -1, 1, 1, -1):
        simulation.move(PAPER_TPM.mount.to_paper(simulation.read().command) + (0, 0, 0.03 * step))
    assert max(abs(slide) for _, slide, _ in rows) < 1e-6


def test_beyond_its_stroke_the_cup_stops_and_the_puck_holds():
    simulation = start(height=0.05)
    state = go(simulation, 0.006, 12, vacuum=False)  # 24 mm below the top, 4 mm beyond the stroke
    slide = simulation.engine.client.getJointState(*simulation.engine.robot.tool)[0]
    assert slide == pytest.approx(-CUP.stroke, abs=1e-6)
    assert state.object_position[0, 2] == pytest.approx(0.015, abs=0.1e-3)
    assert state.closure_error < 1e-5


def test_a_held_puck_pressed_on_the_table_stays_held_and_the_cup_yields():
    simulation = start_holding()
    assert go(simulation, 0.06, 5, vacuum=True).held == 0
    rows = record(simulation)
    for height in np.arange(0.06, 0.012, -0.006):
        assert simulation.move(level(height), vacuum=True).held == 0
    state = go(simulation, 0.012, 5, vacuum=True)
    assert state.held == 0
    assert state.object_position[0, 2] == pytest.approx(0.015, abs=0.1e-3)
    assert -0.020 < rows[-1][1] <= -0.018  # and what was between lip and puck when it sealed
    lifted = [simulation.move(level(height), vacuum=True) for height in (0.02, 0.03, 0.04, 0.05)]
    assert all(state.held == 0 for state in lifted)


def test_a_reset_while_holding_lets_go():
    simulation = start_holding()
    state = simulation.reset(PAPER_TPM.inverse(level(0.1)), {"object": (0.0, -0.03, 0.015)})
    assert state.held == -1
    state = go(simulation, 0.1, 5, vacuum=True)
    assert np.allclose(state.object_position, (0.0, -0.03, 0.015), atol=1e-3)
