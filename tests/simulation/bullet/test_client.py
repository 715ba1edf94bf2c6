"""The client of the physics engine: private, quiet, given back."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pybullet
import pytest

from tpm_gym.errors import ConfigurationError
from tpm_gym.simulation.bullet.client import Client, has_display
from tpm_gym.simulation.physics import GRAVITY, REGULARISATION, Physics


@pytest.fixture
def client() -> Iterator[Client]:
    client = Client(Physics())
    yield client
    client.close()


def drop(client: Client) -> int:
    """A ball in the air."""
    shape = client.createCollisionShape(client.GEOM_SPHERE, radius=0.1)
    body: int = client.createMultiBody(1.0, shape, basePosition=(0.0, 0.0, 1.0))
    client.changeDynamics(body, -1, linearDamping=0.0)
    return body


def test_functions_act_on_this_client_alone_and_constants_pass_through(client: Client) -> None:
    other = Client(Physics())
    assert other._number != client._number
    ball = drop(client)
    assert (client.getNumBodies(), other.getNumBodies()) == (1, 0)
    other.stepSimulation()
    assert client.getBasePositionAndOrientation(ball)[0] == (0.0, 0.0, 1.0)
    assert client.GEOM_SPHERE == pybullet.GEOM_SPHERE
    assert client.stepSimulation is client.stepSimulation  # looked up once
    with pytest.raises(AttributeError, match="stepBackwards"):
        _ = client.stepBackwards
    other.close()
    client.stepSimulation()


@pytest.mark.parametrize(
    "physics", [Physics(), Physics(time_step=1 / 500, solver="iterative", iterations=17, erp=0.3)]
)
def test_settings_are_in_force_and_again_after_a_reset_of_the_client(physics: Physics) -> None:
    client = Client(physics)
    for _ in range(2):
        settings = client.getPhysicsEngineParameters()
        assert settings["fixedTimeStep"] == physics.time_step
        assert settings["numSolverIterations"] == physics.iterations
        assert settings["gravityAccelerationZ"] == -GRAVITY
        ball = drop(client)
        client.stepSimulation()
        speed = client.getBaseVelocity(ball)[0][2]
        assert speed == pytest.approx(-GRAVITY * physics.time_step)
        client.resetSimulation()
        assert client.getPhysicsEngineParameters()["gravityAccelerationZ"] == 0
        client.configure(physics)
    client.close()


def test_the_solver_that_was_asked_for_is_the_one_that_is_set(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[dict[str, Any]] = []
    true = pybullet.setPhysicsEngineParameter

    def spy(**settings: Any) -> None:
        asked.append(settings)
        true(**settings)

    monkeypatch.setattr(pybullet, "setPhysicsEngineParameter", spy)
    for solver in ("direct", "iterative"):
        asked.clear()
        Client(Physics(solver=solver, erp=0.7)).close()
        merged = {name: value for settings in asked for name, value in settings.items()}
        direct = merged.get("constraintSolverType") == pybullet.CONSTRAINT_SOLVER_LCP_DANTZIG
        assert direct is (solver == "direct")
        assert (merged["erp"], merged["globalCFM"]) == (0.7, REGULARISATION)
        assert merged["deterministicOverlappingPairs"] == 1


def test_nothing_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    print("before", end=" ")
    client = Client(Physics())
    client.configure(Physics())
    client.close()
    print("after")
    assert capfd.readouterr() == ("before after\n", "")


def test_closing_twice_is_harmless_and_closed_means_closed(client: Client) -> None:
    client.stepSimulation()
    client.close()
    client.close()
    with pytest.raises(pybullet.error):
        client.stepSimulation()


@pytest.mark.parametrize("renderer", ["raytracer", "", None])
def test_an_unknown_renderer_is_refused_and_the_client_given_back(renderer: Any) -> None:
    first = Client(Physics())
    free = first._number
    first.close()
    with pytest.raises(ConfigurationError, match="'tiny' or 'egl'") as caught:
        Client(Physics(), renderer=renderer)
    assert (caught.value.name, caught.value.value) == ("renderer", renderer)
    again = Client(Physics())
    assert again._number == free
    again.close()


def test_egl_that_is_not_there_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigurationError, match="no EGL"):
        Client(Physics(), renderer="egl")


def test_a_window_that_does_not_open_is_a_typed_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pybullet, "connect", lambda mode: -1)
    with pytest.raises(ConfigurationError, match="no window") as caught:
        Client(Physics(), gui=True)
    assert caught.value.name == "render_mode"


@pytest.mark.parametrize(
    ("platform", "display", "expected"),
    [("linux", None, False), ("linux", "", False), ("linux", ":0", True), ("darwin", None, True)],
)
def test_linux_needs_a_display(
    monkeypatch: pytest.MonkeyPatch, platform: str, display: str | None, expected: bool
) -> None:
    monkeypatch.setattr("sys.platform", platform)
    if display is None:
        monkeypatch.delenv("DISPLAY", raising=False)
    else:
        monkeypatch.setenv("DISPLAY", display)
    assert has_display() is expected
