"""The page in Chromium: it loads, is dragged, switches modes and plays, without a complaint."""

from contextlib import closing

import numpy as np
import pytest
from browser import CHROMIUM, Browser, until
from postures import drawn_gap

from tpm_gym.viewer import ViewConfig, open_viewer, run
from tpm_gym.viewer.viewer import Viewer

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")]


@pytest.fixture(scope="module")
def viewer():
    with closing(open_viewer("paper", port=0)) as viewer:
        yield viewer


@pytest.fixture
def browser(viewer):
    with closing(Browser(viewer.address)) as browser:
        until(viewer.server.get_clients)
        yield browser
        assert browser.complaints == []
        assert browser.requested <= {"http://127.0.0.1", "data:", "blob:"}


def on_screen(viewer: Viewer, point: np.ndarray) -> tuple[float, float]:
    """Return where the camera of the page sees a point of the machine's frame, pixels."""
    (client,) = viewer.server.get_clients().values()
    camera, machine = client.camera, viewer.explore.posture.machine
    width, height = camera.image_width, camera.image_height
    forward = camera.look_at - camera.position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    way = machine.mount.to_world(point) - camera.position
    scale = height / 2 / np.tan(camera.fov / 2) / (way @ forward)
    up = np.cross(right, forward)
    return width / 2 + scale * (way @ right), height / 2 - scale * (way @ up)


def test_the_gizmo_drags_the_robot(viewer, browser):
    before = viewer.explore.posture.position

    until(lambda: browser.frames(5) < 4.0, 180.0)  # the scene is there

    def dragged():
        """Take the arrow along the machine's x, some way from P."""
        ends = (on_screen(viewer, before + [reach, 0, 0]) for reach in (0.09, 0.15))
        (x, y), (u, v) = ends
        for share in (-0.05, 0.0):
            browser.move(x + share * (u - x), y)
            browser.frames(4)
        browser.press(x, y)
        for share in np.linspace(0.0, 1.0, 9):
            browser.frames(2)
            browser.drag_to(x + share * (u - x), y + share * (v - y))
        browser.frames(4)
        browser.release(u, v)
        viewer.worker.wait()
        return viewer.explore.posture.position[0] > before[0] + 0.01

    until(dragged, 120.0)
    assert viewer.explore.posture.position[1:] == pytest.approx(before[1:], abs=1e-6)
    assert drawn_gap(viewer) < 1e-9


def test_modes_are_switched_from_the_lists(viewer, browser):
    browser.click("Back to the machine's home")
    browser.select("Elbows 1 / 2 / 3", "in / out / out")
    until(lambda: viewer.explore.posture.working.leg1 == -1)
    browser.select("Operation", "rotated")
    until(lambda: viewer.explore.posture.operation == "rotated")
    assert drawn_gap(viewer) < 1e-9
    browser.click("Back to the machine's home")
    until(lambda: viewer.explore.posture.operation == "translating")


def test_an_episode_is_played_with_plots(viewer, browser):
    browser.click("Show")
    browser.click("Play")
    browser.click("Step")
    until(lambda: viewer.play.player and viewer.play.player.records, 180.0)
    until(lambda: browser.evaluate("document.querySelectorAll('.uplot canvas').length") == 2)
    buttons = "[...document.querySelectorAll('button')].filter(e => e.innerText === 'Play').at(-1)"
    browser.evaluate(f"{buttons}.click()")
    until(lambda: viewer.play.playing and len(viewer.play.player.records) > 5)
    browser.click("Pause")
    until(lambda: not viewer.play.playing)
    assert drawn_gap(viewer) < 1e-9


def test_the_exported_page_moves_without_a_server(tmp_path):
    run(ViewConfig(export=tmp_path))
    with closing(Browser((tmp_path / "index.html").as_uri())) as browser:
        until(lambda: browser.evaluate("!!document.querySelector('canvas')"))
        seen = set()

        def moved():
            browser.picture(tmp_path / "shot.png")
            seen.add((tmp_path / "shot.png").read_bytes())
            return len(seen) > 5

        until(moved, 90.0)
        assert browser.complaints == []
        assert browser.requested <= {"file://", "data:", "blob:"}
