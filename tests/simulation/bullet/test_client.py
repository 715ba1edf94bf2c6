"""The client of the physics engine: private, quiet, given back; and what it makes of windows."""

import gc
import os
import shutil
import subprocess
import sys
import tempfile

import pybullet
import pytest
from alone import Alone

from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.mount import GRAVITY
from tpm_gym.simulation import Scene
from tpm_gym.simulation.bullet import client as client_module
from tpm_gym.simulation.bullet.client import Client
from tpm_gym.simulation.bullet.physics import Physics

posix = pytest.mark.skipif(os.name != "posix", reason="descriptors and X11")


def in_a_process(script: str, **variables: str) -> tuple[str, str]:
    """What a script says on stdout and stderr."""
    begin = "import os, sys\nimport gymnasium as gym\nimport tpm_gym\n"
    command, environment = [sys.executable, "-c", begin + script], os.environ | variables
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    return done.stdout, done.stderr.strip()


@pytest.fixture
def client():
    gc.collect()  # clients that earlier tests left
    client = Client(Physics())
    yield client
    client.close()


def drop(client: Client) -> int:
    """A ball in the air."""
    shape = client.createCollisionShape(client.GEOM_SPHERE, radius=0.1)
    body: int = client.createMultiBody(1.0, shape, basePosition=(0.0, 0.0, 1.0))
    client.changeDynamics(body, -1, linearDamping=0.0)
    return body


def test_functions_act_on_this_client_alone(client):
    other = Client(Physics())
    ball = drop(client)
    assert (client.getNumBodies(), other.getNumBodies()) == (1, 0)
    other.stepSimulation()
    assert client.getBasePositionAndOrientation(ball)[0] == (0.0, 0.0, 1.0)
    with pytest.raises(AttributeError, match="stepBackwards"):
        _ = client.stepBackwards
    other.close()
    client.stepSimulation()


@pytest.mark.parametrize(
    "physics", [Physics(), Physics(time_step=1 / 500, solver="iterative", iterations=17, erp=0.3)]
)
def test_settings_are_in_force_and_again_after_a_reset_of_the_client(physics):
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


def test_nothing_is_printed(capfd):
    print("before", end=" ")
    client = Client(Physics())
    client.configure(Physics())
    client.close()
    print("after")
    assert capfd.readouterr() == ("before after\n", "")


def test_closed_means_closed_and_twice_is_harmless(client):
    numbers = {client.number}
    client.stepSimulation()
    for _ in range(20):
        client.close()
        client.close()
        with pytest.raises(pybullet.error):
            client.stepSimulation()
        client = Client(Physics())
        numbers.add(client.number)
    client.close()
    assert len(numbers) == 1  # given back each time


def test_what_is_dropped_is_given_back():
    gc.collect()  # clients that earlier tests left
    free = Client(Physics()).number
    kept = Client(Physics())
    assert kept.number == free
    first = Alone(Scene())
    number = first.engine.client.number
    del first
    assert Alone(Scene()).engine.client.number == number
    kept.stepSimulation()


@pytest.mark.parametrize("renderer", ["raytracer", "", 1])
def test_an_unknown_renderer_is_refused_and_the_client_given_back(renderer):
    first = Client(Physics())
    free = first.number
    first.close()
    with pytest.raises(ConfigurationError, match="'tiny' or 'egl'") as caught:
        Client(Physics(), renderer=renderer)
    assert (caught.value.name, caught.value.value) == ("renderer", renderer)
    again = Client(Physics())
    assert again.number == free
    again.close()


def test_egl_that_is_not_there_is_refused(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigurationError, match="no EGL"):
        Client(Physics(), renderer="egl")


def test_where_no_file_can_be_written_the_error_says_so(monkeypatch, tmp_path):
    free = Client(Physics()).number
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    with pytest.raises(ConfigurationError, match="folder that can be written to") as caught:
        Alone(Scene())
    assert caught.value.name == "TMPDIR"
    assert Client(Physics()).number == free
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    Alone(Scene())
    assert not list(tmp_path.iterdir())  # nothing is left there


# -- standard output -------------------------------------------------------------------------------


@posix
@pytest.mark.parametrize("gone", ["sys.stdout.close()", "os.close(1); sys.stdout = None"])
def test_environments_are_made_where_there_is_no_standard_output(gone):
    made = f"{gone}\nenv = gym.make('TPMReach-v0')\nenv.reset(seed=0)\nsys.stderr.write('made')"
    assert "made" in in_a_process(made)[1]


@posix
def test_silence_takes_what_c_writes_too_and_may_be_nested():
    said, _ = in_a_process("""
import ctypes
from tpm_gym.simulation.bullet.silence import silence
c = ctypes.CDLL(None)
with silence():
    with silence():
        print("python")
    c.puts(b"c")
print("after")
c.puts(b"c after")
""")
    assert sorted(said.splitlines()) == ["after", "c after"]


@posix
def test_threads_that_make_environments_leave_standard_output_as_it_was():
    _, said = in_a_process("""
import time
from threading import Thread
from tpm_gym.simulation.bullet import pybullet
quick = pybullet.setPhysicsEngineParameter
def slow(**settings):
    if "constraintSolverType" in settings:
        time.sleep(0.3)  # where it is silent, so that the threads meet there
    quick(**settings)
pybullet.setPhysicsEngineParameter = slow
before = os.fstat(1)
threads = [Thread(target=gym.make, args=("TPMReach-v0",)) for _ in range(6)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
sys.stderr.write(str(os.path.samestat(os.fstat(1), before)))
""")
    assert said == "True"


# -- windows ---------------------------------------------------------------------------------------

OPEN = """
def window():
    try:
        env = gym.make("TPMReach-v0", render_mode="human")
        sys.stderr.write("opened;")
        return env
    except tpm_gym.TPMError as error:
        sys.stderr.write(f"{type(error).__name__} {error.name};")
"""
REFUSED = "ConfigurationError render_mode;"


@posix
def test_a_display_that_does_not_answer_is_a_typed_error():
    _, said = in_a_process(
        OPEN
        + """
for display in (":987", "localhost:987", "nonsense", ""):
    os.environ["DISPLAY"] = display
    window()
"""
    )
    assert said == 4 * REFUSED


SCREENS = [
    pytest.param((), id="GLX", marks=pytest.mark.slow),  # 20 s, drawn in software
    pytest.param(("-extension", "GLX"), id="no GLX"),
]


@pytest.fixture(params=SCREENS)
def screen(request):
    """DISPLAY of an X server that draws into memory."""
    if shutil.which("Xvfb") is None:
        pytest.skip("needs Xvfb")
    command = ["Xvfb", "-displayfd", "1", "-screen", "0", "320x240x24", *request.param]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as server:
        assert server.stdout is not None
        yield f":{server.stdout.readline().decode().strip()}"
        server.terminate()


def test_a_second_window_is_a_typed_error_and_the_first_goes_on(screen, request):
    _, said = in_a_process(
        OPEN
        + """
first = window()
second = window()
if first:
    first.reset(seed=0)
    first.step(first.action_space.sample())
    first.close()
    window()
""",
        DISPLAY=screen,
    )
    without_glx = "no GLX" in request.node.name
    assert said == (2 * REFUSED if without_glx else f"opened;{REFUSED}opened;")


@pytest.mark.parametrize("engine", ["pybullet", "mujoco", "analytic"])
def test_a_window_shows_robots_of_all_lengths_and_prints_nothing(screen, engine, request):
    pytest.importorskip("pybullet" if engine == "analytic" else engine)
    printed, said = in_a_process(
        f"""
try:
    env = gym.make(
        "TPMPickAndPlace-v0", engine="{engine}", render_mode="human", camera="cup",
        randomisation={{"length_error": 1e-4}},
    )
    plain = gym.make(env.spec, render_mode=None)
    for one in (env, plain):
        for seed in (0, 1):
            one.reset(seed=seed)
            one.step(one.action_space.sample() * 0 + 1)
        print(one.unwrapped.state.theta.tolist(), file=sys.stderr)
    env.close()
except tpm_gym.TPMError as error:
    print(type(error).__name__, error.name, file=sys.stderr)
""",
        DISPLAY=screen,
    )
    lines = said.splitlines()
    if "no GLX" in request.node.name:
        assert lines == ["ConfigurationError render_mode"]
    else:
        assert lines[0] == lines[1]
        assert lines[0].startswith("[")
    assert printed == ""


@pytest.mark.parametrize("how", ["refuses", "raises"])
def test_a_window_that_does_not_open_is_a_typed_error(monkeypatch, how):
    def connect(mode, options):
        if how == "raises":
            raise pybullet.error("Only one local in-process GUI connection allowed.")
        return -1

    monkeypatch.setattr(client_module, "has_display", lambda: True)
    monkeypatch.setattr(pybullet, "connect", connect)
    with pytest.raises(ConfigurationError, match="no window") as caught:
        Client(Physics(), gui=True)
    assert caught.value.name == "render_mode"
