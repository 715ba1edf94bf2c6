"""The vacuum cup takes, holds, lets go, and never presses harder than its spring."""

import numpy as np
import pytest
from alone import Alone
from inside_bullet import around_each_step

from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.mechanism.cup import CUP
from tpm_gym.simulation import Block, Scene

PLACE = np.array([-0.04, 0.028])  # x, y of the block and of P, machine's frame


def level(height):
    """Point P (machine's frame) with the lip at ``height`` above the table."""
    return np.array([*PLACE, PAPER_TPM.mount.height - height - CUP.length])


def start(block=None, offset=(0.0, 0.0), height=0.10):
    block = block or Block()
    simulation = Alone(Scene(objects=(block,)))
    position = (PLACE[0] + offset[0], -PLACE[1] + offset[1], block.height / 2)
    simulation.reset(PAPER_TPM.inverse(level(height)), {"object": position})
    return simulation


def start_holding():
    """The block is in the cup and still on the table."""
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


def test_the_block_does_not_jump_when_it_is_taken():
    simulation = start(offset=(0.006, 0.004), height=0.05)
    before = go(simulation, 0.031, 4, vacuum=True)
    after = go(simulation, 0.031, 3, vacuum=True)
    assert after.held == 0
    assert np.linalg.norm(after.object_position - before.object_position) < 1e-3


def test_a_held_block_stays_put_at_full_speed():
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
    """Rows for every time step: force on the block (N), the cup's slide (m), block's height (m)."""
    client, (block,), rows = simulation.engine.client, simulation.engine.bodies, []
    body, link = simulation.engine.robot.tool

    def note():
        contacts = client.getContactPoints(bodyA=body, bodyB=block, linkIndexA=link)
        force = sum(contact[9] for contact in contacts)
        slide = client.getJointState(body, link)[0]
        rows.append((force, slide, client.getBasePositionAndOrientation(block)[0][2]))

    around_each_step(simulation, after=note)
    return rows


@pytest.mark.parametrize("speed", [0.005, 0.03])  # m a control period; the second is full speed
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.012, 0.012)])
def test_the_cup_yields_to_the_block_at_its_preload(speed, offset):
    simulation = start(offset=offset, height=0.06)
    rows = record(simulation)
    for height in np.arange(0.06, 0.012, -speed):
        simulation.move(level(height))
    go(simulation, 0.012, 10, vacuum=False)  # 18 mm below the top of the block
    force, slide, height = np.transpose(rows)
    cup = PAPER_TPM.mechanism.link("cup")
    resting = CUP.preload + cup.mass * 9.81
    blow = cup.mass * speed / 0.04 / simulation.engine.physics.time_step  # stopped in one time step
    assert force.max() <= resting + blow + 0.1
    assert force[-1] == pytest.approx(resting, rel=1e-3)
    assert slide.min() == slide[-1] == pytest.approx(-0.018, abs=1e-4)
    # The block stays on the table: 0.16 mm into it at the blow, then as if nothing pressed.
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


def test_beyond_its_stroke_the_cup_stops_and_the_block_holds():
    simulation = start(height=0.05)
    state = go(simulation, 0.006, 12, vacuum=False)  # 24 mm below the top, 4 mm beyond the stroke
    slide = simulation.engine.client.getJointState(*simulation.engine.robot.tool)[0]
    assert slide == pytest.approx(-CUP.stroke, abs=1e-6)
    assert state.object_position[0, 2] == pytest.approx(0.015, abs=0.1e-3)
    assert state.closure_error < 1e-5


def test_a_held_block_pressed_on_the_table_stays_held_and_the_cup_yields():
    simulation = start_holding()
    assert go(simulation, 0.06, 5, vacuum=True).held == 0
    rows = record(simulation)
    for height in np.arange(0.06, 0.012, -0.006):
        assert simulation.move(level(height), vacuum=True).held == 0
    state = go(simulation, 0.012, 5, vacuum=True)
    assert state.held == 0
    assert state.object_position[0, 2] == pytest.approx(0.015, abs=0.1e-3)
    assert -0.020 < rows[-1][1] <= -0.018  # and what was between lip and block when it sealed
    lifted = [simulation.move(level(height), vacuum=True) for height in (0.02, 0.03, 0.04, 0.05)]
    assert all(state.held == 0 for state in lifted)


def pressed_at_full_speed(**of_block):
    """Sealed when the cup had come down at full speed, and was half a millimetre in the block."""
    simulation = start(Block(**of_block), height=0.09)
    for height in (0.06, 0.03, 0.012):
        simulation.move(level(height), vacuum=False)
    assert between(simulation)[1] > 0.5e-3
    state = go(simulation, 0.012, 5, vacuum=True)
    assert state.held == 0
    assert state.vacuum == pytest.approx(CUP.vacuum, rel=1e-2)
    return simulation


def weld(simulation):
    """Force of the weld on the block, N, world."""
    return np.array(simulation.engine.client.getConstraintState(simulation.engine._cup._weld)[:3])


def between(simulation):
    """Force with which cup and block push each other apart, N, and how deep they overlap, m."""
    client, (block,) = simulation.engine.client, simulation.engine.bodies
    body, link = simulation.engine.robot.tool
    force = sum(contact[9] for contact in client.getContactPoints(body, block, link, -1))
    near = client.getClosestPoints(body, block, 0.01, link, -1)
    return force, max((-point[8] for point in near), default=-0.01)


def test_weld_and_contact_do_not_fight():
    simulation = pressed_at_full_speed()
    # Pressed on the table, taken off it, and at rest.
    for height in (0.012, 0.02, 0.03, 0.03, 0.045, 0.06, 0.06, 0.06, 0.06, 0.06):
        assert go(simulation, height, 1, vacuum=True).held == 0
        assert between(simulation)[0] == 0
    np.testing.assert_allclose(weld(simulation), (0, 0, -0.05 * 9.81), atol=1e-3)
    assert between(simulation)[1] < 0.02e-3


def test_what_is_let_go_does_not_pop():
    simulation = pressed_at_full_speed()
    before = go(simulation, 0.028, 6, vacuum=True).object_position
    rows = record(simulation)
    after = go(simulation, 0.028, 3, vacuum=False)
    assert after.held == -1
    assert np.linalg.norm(after.object_position - before) < 0.05e-3
    assert max(height for _, _, height in rows) < 0.01505


def test_in_the_air_it_falls_from_rest():
    simulation = pressed_at_full_speed()
    go(simulation, 0.06, 3, vacuum=True)
    go(simulation, 0.09, 8, vacuum=True)
    step, speeds = simulation.engine.physics.time_step, []
    around_each_step(
        simulation,
        after=lambda: speeds.append(simulation.engine.read().object_velocity[0, 0, 2]),
    )
    go(simulation, 0.09, 2, vacuum=False)
    z = np.array(speeds)
    begun = int(np.argmax(z < -1e-3))
    # The vacuum lasts 30 ms: 7 whole time steps; it is let go at the end of the eighth.
    assert begun == 8
    np.testing.assert_allclose(
        z[begun:], -9.81 * step * np.arange(1, len(z) - begun + 1), atol=1e-3
    )


@pytest.mark.parametrize("direction", [(0, 0, -1), (1, 0, 0), (0, -1, 0), (1, 1, 0), (1, 0, -1)])
@pytest.mark.parametrize("mass", [0.05, 0.3, 1.0])
def test_a_held_block_comes_off_at_the_pull_off_force(direction, mass):
    # Measured: weight and pull together are 12.000 to 12.002 N when it is let go.
    simulation = start(Block(mass=mass), height=0.05)
    go(simulation, 0.03, 8, vacuum=True)
    for height in np.arange(0.03, 0.06, 0.001):
        assert go(simulation, height, 1, vacuum=True).held == 0
    go(simulation, 0.06, 3, vacuum=True)
    client, (body,), load = simulation.engine.client, simulation.engine.bodies, [11.5]
    along = np.array(direction) / np.linalg.norm(direction)

    def pull():
        if simulation.engine._cup.grip.hold.which == 0:
            load[0] += 0.002  # N a time step
            force = load[0] * along + (0, 0, mass * 9.81)
            position, _ = client.getBasePositionAndOrientation(body)
            client.applyExternalForce(body, -1, force, position, client.WORLD_FRAME)

    around_each_step(simulation, before=pull)
    while simulation.move(level(0.06), vacuum=True).held == 0 and load[0] < 20:
        pass
    assert load[0] == pytest.approx(12.0, abs=0.01)


@pytest.mark.parametrize(("mass", "kept"), [(0.2, True), (0.3, False)])
def test_who_pulls_too_hard_loses_the_block(mass, kept):
    # Down at full speed and up again: 37.5 m/s^2 and the weight are 9.5 N, and 14.2 N.
    simulation = pressed_at_full_speed(mass=mass)
    for height in np.arange(0.012, 0.25, 0.012):
        assert simulation.move(level(height), vacuum=True).held == 0
    for height in (0.22, 0.19, 0.16, 0.19, 0.22):
        state = simulation.move(level(height), vacuum=True)
    assert (state.held == 0) == kept
    assert (state.vacuum > 0.99 * CUP.vacuum) == kept
    state = go(simulation, 0.22, 8, vacuum=True)
    assert state.object_position[0, 2] == pytest.approx(0.205 if kept else 0.015, abs=2e-3)
    assert state.vacuum > 0.99 * CUP.vacuum if kept else state.vacuum < 1


@pytest.mark.parametrize("steps", [1, 3, 5])
def test_a_moment_of_any_pressure_is_gone_back_to_exactly(steps):
    simulation = start(height=0.0315)
    moments = []
    for index, vacuum in enumerate((True, True, False, True, True, True)):
        if index == steps:
            moments.append(simulation.save())
        state = simulation.move(level(0.03), vacuum)
    assert 0 < state.vacuum < CUP.vacuum
    again = simulation.restore(moments[0])
    assert again.vacuum > 0
    for vacuum in (True, True, False, True, True, True)[steps:]:
        again = simulation.move(level(0.03), vacuum)
    for name, value in vars(state).items():
        np.testing.assert_array_equal(getattr(again, name), value, err_msg=name)


def test_a_reset_while_holding_lets_go():
    simulation = start_holding()
    state = simulation.reset(PAPER_TPM.inverse(level(0.1)), {"object": (0.0, -0.03, 0.015)})
    assert state.held == -1
    assert state.vacuum == 0
    state = go(simulation, 0.1, 5, vacuum=True)
    assert np.allclose(state.object_position, (0.0, -0.03, 0.015), atol=1e-3)
