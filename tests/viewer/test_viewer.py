"""The viewer without a browser: its controls act, what it draws closes, and it plays every task."""

import time
from contextlib import closing
from dataclasses import replace
from html import escape
from itertools import product
from typing import Any, ClassVar

import msgspec
import numpy as np
import pytest
import viser
from browser import until
from gantry import GANTRY
from postures import drawn_gap
from websockets.sync.client import connect

import tpm_gym
from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics import RotatedMode
from tpm_gym.viewer import open_viewer
from tpm_gym.viewer.kinds import KINDS, Kind
from tpm_gym.viewer.kinds.kind import Margin
from tpm_gym.viewer.layers import LAYERS
from tpm_gym.viewer.player import Player, installed_engines, policies_for
from tpm_gym.viewer.viewer import Viewer


@pytest.fixture(scope="module")
def shared():
    with closing(open_viewer("wide", port=0)) as viewer:
        yield viewer


@pytest.fixture
def viewer(shared):
    """Return the viewer at its home."""
    choose(shared, shared.machine, "wide")
    for name, box in shared.shown.items():
        choose(shared, box, name == "region")
    do(shared, shared.explore.go_home)
    return shared


def choose(viewer: Viewer, control: Any, value: Any) -> None:
    """Choose a value, as a user does, and wait until it is drawn."""
    control.value = value
    assert viewer.worker.wait()


def do(viewer: Viewer, job: Any) -> None:
    viewer.worker.put("test", job)
    assert viewer.worker.wait()


def test_every_choice_of_modes_draws_a_posture_in_them_or_says_why(viewer):
    explore, drawn = viewer.explore, set()
    elbows, link_7 = explore.working_lists
    for operation in ("translating", "rotated"):
        do(viewer, explore.go_home)
        choose(viewer, explore.operation, operation)
        for bends, side in product(elbows.options, link_7.options):
            choose(viewer, elbows, bends)
            choose(viewer, link_7, side)
            if explore.problem:
                assert escape(explore.problem) in explore.refusal.content
            else:
                posture = explore.posture
                assert posture.operation == operation
                assert (elbows.value, link_7.value) == (bends, side)
                assert posture.working == explore.working
                drawn.add((operation, posture.working))
            assert drawn_gap(viewer) < 1e-9
    assert len(drawn) >= 12


def test_elbows_out_is_the_working_mode_of_the_machines(viewer):
    assert viewer.explore.working_lists[0].value == "out / out / out"
    theta = viewer.explore.posture.theta
    outwards = np.cos(theta) * [1, -1, 1]  # level components of the arms, away from the centre
    assert (outwards > 0).all()


def test_a_motor_turns_in_the_assembly_mode_of_the_panel(viewer):
    explore = viewer.explore
    before, mode = explore.posture.position, explore.posture.assembly
    choose(viewer, explore.motors[0], explore.motors[0].value + 2.0)
    assert explore.posture.assembly == mode
    assert np.linalg.norm(explore.posture.position - before) > 1e-3
    assert explore.gizmo.position == pytest.approx(explore.posture.position)
    other = next(label for label in explore.assembly.options if label != explore.assembly.value)
    theta = explore.posture.theta
    choose(viewer, explore.assembly, other)
    assert explore.posture.assembly != mode
    assert explore.posture.theta == pytest.approx(theta, abs=1e-3)  # the slider's step
    assert drawn_gap(viewer) < 1e-9


def test_rotated_assemblies_are_offered_in_rotated_operation(viewer):
    explore = viewer.explore
    assert len(explore.assembly.options) == 4
    choose(viewer, explore.operation, "rotated")
    assert len(explore.assembly.options) == 8
    assert isinstance(explore.posture.assembly, RotatedMode)
    assert explore.posture.tilt != 0


def test_out_of_reach_the_robot_stays_and_the_panel_says_why(viewer):
    explore = viewer.explore
    before = explore.posture
    do(viewer, lambda: explore.drag((0.3, 2.0, 0.7)))
    assert explore.posture is before
    assert "beta" in explore.problem
    assert "beta" in explore.refusal.content
    do(viewer, lambda: explore.drag(before.position))
    assert explore.problem == ""
    assert explore.refusal.content == ""


def test_a_page_that_drags_p_moves_the_robot(viewer):
    target = viewer.explore.posture.position + [0.02, -0.03, 0.01]
    message = {
        "type": "TransformControlsUpdateMessage", "name": "/robot/P", "owner": "",
        "wxyz": (1.0, 0.0, 0.0, 0.0), "position": target.tolist(),
    }  # fmt: skip
    address = viewer.address.replace("http", "ws")
    with connect(address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None) as page:
        page.send(msgspec.msgpack.encode(message))
        until(lambda: np.allclose(viewer.explore.posture.position, target))
    assert viewer.worker.wait()
    assert drawn_gap(viewer) < 1e-9


def test_layers_are_drawn_when_shown_and_gone_when_hidden(viewer):
    nodes = {
        "parallel": "singular/level3", "serial": "singular/leg2", "aspects": "aspects/0",
        "constraint": "singular/elevation", "workspace": "workspace", "region": "regions/goals",
        "conditioning": "conditioning", "margin": "margin",
    }  # fmt: skip
    assert nodes.keys() == LAYERS.keys()

    def drawn():
        find = viewer.server.scene.get_handle_by_name
        return {name for name, node in nodes.items() if find(f"/robot/{node}") is not None}

    assert drawn() == {"region"}
    for box in viewer.shown.values():
        choose(viewer, box, True)
    assert drawn() == nodes.keys()
    choose(viewer, viewer.explore.operation, "rotated")
    assert drawn() == {"region"}
    choose(viewer, viewer.explore.operation, "translating")
    for name, box in viewer.shown.items():
        choose(viewer, box, name == "margin")
    assert drawn() == {"margin"}
    label = viewer.server.scene.get_handle_by_name("/robot/margin_text")
    assert label.text.startswith("240.0 mm to ")


def test_another_machine_is_shown_at_its_home(viewer):
    do(viewer, viewer.play.step)
    assert viewer.server.scene.get_handle_by_name("/objects/object") is not None
    choose(viewer, viewer.machine, "paper")
    assert viewer.server.scene.get_handle_by_name("/objects/object") is None
    assert viewer.explore.posture.machine is tpm_gym.PAPER_TPM
    assert viewer.explore.posture.position == pytest.approx(tpm_gym.PAPER_TPM.home)
    assert drawn_gap(viewer) < 1e-9


def test_a_machine_with_the_name_of_another_is_shown_beside_it():
    heavier = replace(tpm_gym.PAPER_TPM, payload=2.5)
    with closing(open_viewer(heavier, port=0)) as viewer:
        assert viewer.machine.value == "paper (own)"
        assert viewer.explore.posture.machine == heavier
        choose(viewer, viewer.machine, "paper")
        assert viewer.explore.posture.machine is tpm_gym.PAPER_TPM


def test_a_delta_is_dragged_turned_and_plays_the_expert(viewer):
    choose(viewer, viewer.machine, "delta")
    explore = viewer.explore
    elbows, link_7 = explore.working_lists
    assert not link_7.visible
    do(viewer, lambda: explore.drag((0.2, -0.1, 1.0)))
    assert explore.posture.position == pytest.approx((0.2, -0.1, 1.0))
    choose(viewer, elbows, "out / in / out")
    assert explore.posture.working == (1.0, -1.0, 1.0)
    do(viewer, explore.go_home)
    assert explore.assembly.value == "det A > 0"
    choose(viewer, explore.assembly, "det A < 0")
    assert explore.posture.position[2] < 0
    for name in LAYERS:
        choose(viewer, viewer.shown[name], True)
    find = viewer.server.scene.get_handle_by_name
    assert all(find(f"/robot/{name}") for name in ("aspects/0", "workspace", "conditioning"))
    assert drawn_gap(viewer) < 1e-9
    choose(viewer, viewer.play.env_id, "TPMPickAndPlace-v0")
    for _ in range(3):
        do(viewer, viewer.play.step)
        assert drawn_gap(viewer) < 1e-9
    assert explore.posture.theta == pytest.approx(viewer.play.player.state.theta)
    do(viewer, viewer.play.discard)


@pytest.mark.parametrize("env_id", tpm_gym.ENV_IDS)
def test_every_task_is_played_with_closed_loops(viewer, env_id):
    play = viewer.play
    choose(viewer, play.env_id, env_id)
    assert play.policy.value == "expert"
    for _ in range(3):
        do(viewer, play.step)
        assert drawn_gap(viewer) < 1e-9
    player = play.player
    assert len(player.records) == 3
    state = player.state
    assert viewer.explore.posture.theta == pytest.approx(state.theta)
    for index, block in enumerate(player.task.scene.objects):
        node = viewer.server.scene.get_handle_by_name(f"/objects/{block.name}")
        assert node.position == pytest.approx(state.object_position[index])
    paint, scene = viewer.server.scene.get_handle_by_name("/paint/0"), player.task.scene
    assert (paint is None) == (scene.belt is None and not scene.patches)
    terms, torques = (p.data for plots in play.plots for p in plots.values() if p.visible)
    drawn = np.array(terms[1:]).sum(axis=0)
    assert drawn == pytest.approx([sum(r.reward_terms.values()) for r in player.records])
    assert pytest.approx(np.array([r.torque for r in player.records])) == np.array(torques[1:]).T
    do(viewer, play.discard)


@pytest.mark.parametrize("engine", installed_engines())
@pytest.mark.parametrize("policy", ["expert", "random", "TPMReach-v0"])
def test_every_engine_plays_every_kind_of_policy_the_same_twice(engine, policy):
    machine, last = tpm_gym.PAPER_TPM, []
    with closing(Player("TPMReach-v0", engine, machine, policy)) as player:
        for _ in range(2):
            player.reset(7)
            for _ in range(4):
                player.step()
            last.append(player.state.platform_position)
    assert np.array_equal(*last)


def test_the_choice_of_engines_begins_with_the_analytic_one_and_lists_what_is_there(monkeypatch):
    assert installed_engines()[0] == "analytic"
    monkeypatch.setattr("tpm_gym.viewer.player.find_spec", lambda name: name == "tpm_gym" or None)
    assert "pybullet" not in installed_engines()
    assert "mujoco" not in installed_engines()


def test_published_policies_are_offered_for_their_task_and_control():
    assert policies_for("TPMReachDense-v0") == ("expert", "random", "TPMReach-v0")
    assert policies_for("TPMPickAndPlaceJoints-v0")[2:] == ("TPMPickAndPlaceJoints-v0",)


def test_play_goes_on_with_the_next_seed_pauses_and_begins_anew(viewer):
    play = viewer.play
    choose(viewer, play.env_id, "TPMReach-v0")
    choose(viewer, play.seed, 3)
    choose(viewer, play.speed, 4.0)
    do(viewer, play.play)
    until(lambda: play.seed.value >= 4)
    do(viewer, play.pause)
    count = len(play.player.records)
    time.sleep(0.1)
    assert len(play.player.records) == count
    do(viewer, play.new)
    seed = play.seed.value
    do(viewer, play.step)
    do(viewer, play.step)
    assert (len(play.player.records), play.seed.value) == (2, seed)
    do(viewer, play.new)
    assert (len(play.player.records), play.seed.value) == (0, seed + 1)
    do(viewer, play.discard)


def test_a_seed_that_is_chosen_is_the_next_that_is_played(viewer):
    play = viewer.play
    choose(viewer, play.env_id, "TPMReach-v0")
    do(viewer, play.step)
    choose(viewer, play.seed, 70)
    do(viewer, play.new)
    assert (len(play.player.records), play.seed.value) == (0, 70)
    do(viewer, play.step)
    do(viewer, play.discard)


def test_another_environment_has_its_own_policies_whatever_is_chosen_after_it(viewer):
    play = viewer.play
    choose(viewer, play.env_id, "TPMReach-v0")
    viewer.worker.put("test", lambda: time.sleep(0.2))  # both choices wait for the worker
    play.env_id.value = "TPMPickAndPlace-v0"
    choose(viewer, play.engine, "pybullet" if play.engine.value == "analytic" else "analytic")
    assert play.policy.options == policies_for("TPMPickAndPlace-v0")
    choose(viewer, play.engine, "analytic")


def test_a_page_cannot_choose_what_is_imported(viewer, tmp_path, monkeypatch):
    (tmp_path / "evil_module.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    play = viewer.play
    choose(viewer, play.env_id, "evil_module:TPMReach-v0")  # no such entry in the list
    do(viewer, play.step)
    assert "evil_module:TPMReach-v0" in play.status.content
    choose(viewer, play.env_id, "TPMReach-v0")
    do(viewer, play.step)
    assert len(play.player.records) == 1
    do(viewer, play.discard)


@pytest.mark.parametrize("speed", [0.0, -1.0, 100.0, float("nan")])
def test_a_speed_that_is_not_on_the_slider_is_refused(viewer, speed):
    play = viewer.play
    choose(viewer, play.env_id, "TPMReach-v0")
    choose(viewer, play.speed, speed)
    do(viewer, play.play)
    assert "speed" in play.status.content
    assert not play.playing
    choose(viewer, play.speed, 1.0)
    do(viewer, play.step)
    do(viewer, play.discard)


def test_a_periodic_job_that_is_always_late_keeps_no_job_waiting(viewer):
    viewer.worker.tick(0.001, lambda: time.sleep(0.01))
    time.sleep(0.05)
    viewer.worker.put("pause", viewer.worker.stop_ticking)
    assert viewer.worker.wait(2.0)


def test_a_policy_that_is_not_there_is_reported_and_the_viewer_goes_on(viewer):
    play = viewer.play
    choose(viewer, play.file, "nowhere/policy.json")
    do(viewer, play.step)
    assert "nowhere/policy.json" in play.status.content
    choose(viewer, play.file, "")
    do(viewer, play.step)
    assert len(play.player.records) == 1
    do(viewer, play.discard)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"machine": "nothing"}, "machine"),
        ({"port": -1}, "port"),
        ({"port": 70_000}, "port"),
        ({"host": "192.0.2.1"}, "host"),  # an address for documentation
        ({"host": "no such host"}, "host"),
        ({"host": 70 * "a" + ".b"}, "host"),
        ({"host": None}, "host"),
    ],
)
def test_options_that_are_not_possible_are_refused(options, name):
    with pytest.raises(ConfigurationError) as refused:
        open_viewer(**options)
    assert refused.value.name == name


def test_a_machine_without_a_kind_is_shown_in_its_own_modes():
    with closing(open_viewer(GANTRY, port=0)) as viewer:
        explore = viewer.explore
        assert [motor.label for motor in explore.motors] == [f"Motor {k}, mm" for k in (1, 2, 3)]
        choose(viewer, explore.motors[0], 30.0)
        assert explore.posture.position == pytest.approx((0.03, 0.0, 0.80))
        do(viewer, lambda: explore.drag((0.1, -0.05, 0.7)))
        assert [motor.value for motor in explore.motors] == pytest.approx([100.0, -50.0, 700.0])
        assert [name for name, box in viewer.shown.items() if box.visible] == ["region"]


def test_a_mechanism_with_a_kind_of_its_own_has_its_modes_and_layers(monkeypatch):
    class Own(Kind):
        lists: ClassVar = {"Operation": "", "Side": "Of the slides", "Assembly": ""}
        working: ClassVar = {("left",): 1, ("right",): None}

        def layers(self, posture):
            where = tuple(posture.position)
            return {"margin": (where, lambda: Margin(0.1, posture.position + [0.1, 0, 0], "end"))}

    monkeypatch.setitem(KINDS, type(GANTRY), Own)
    with closing(open_viewer(GANTRY, port=0)) as viewer:
        side, other = viewer.explore.working_lists
        assert (side.label, side.options, other.visible) == ("Side", ("left", "right"), False)
        choose(viewer, viewer.shown["margin"], True)
        assert viewer.server.scene.get_handle_by_name("/robot/margin") is not None


def test_a_taken_port_gives_another(viewer):
    taken = viewer.server.get_port()
    with closing(open_viewer(port=taken)) as other:
        assert other.server.get_port() != taken
