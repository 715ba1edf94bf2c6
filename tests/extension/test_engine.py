"""An engine that was written outside the package, and engines that are refused."""

import pytest
from alone import Alone
from kinematic import KinematicEngine

import tpm_gym
from tpm_gym.errors import ConfigurationError
from tpm_gym.simulation import Engine, Servo


@pytest.mark.parametrize(
    ("option", "value"),
    [("physics", {"time_step": 0.01}), ("renderer", "egl"), ("gui", True), ("drive", Servo())],
)
def test_an_option_that_it_does_not_take_is_refused_by_name(option, value):
    told = "render_mode" if option == "gui" else option
    with pytest.raises(ConfigurationError, match=f"^{told} = .*'kinematic' (has no|opens no)"):
        Alone(tpm_gym.tasks.Reach.scene, engine="kinematic", **{option: value})


def test_what_it_cannot_randomise_it_refuses_by_name():
    env = tpm_gym.TPMEnv(engine="kinematic", randomisation={"link_mass": (0.9, 1.1)})
    with pytest.raises(ConfigurationError, match="randomisation"):
        env.reset(seed=0)


class Derived(Engine):
    """Of the protocol, whose methods do nothing, and of no others."""

    time_step = 0.04


@pytest.mark.parametrize(
    ("engine", "lacking"),
    [
        (type("NoSave", (KinematicEngine,), {"save": None}), ["save"]),
        (type("NoStep", (KinematicEngine,), {"time_step": None}), ["time_step"]),
        (Derived, ["load", "advance", "close"]),
    ],
)
def test_an_engine_that_lacks_a_part_is_refused_by_name(engine, lacking):
    name = engine.__name__
    tpm_gym.register_engine(name, engine)
    with pytest.raises(ConfigurationError, match=f"engine = '{name}'") as caught:
        tpm_gym.TPMEnv(engine=name)
    for part in lacking:
        assert part in caught.value.valid
    assert ("time_step" in caught.value.valid) == ("time_step" in lacking)


@pytest.mark.parametrize(
    ("name", "engine", "blamed"),
    [
        *((name, KinematicEngine, "name") for name in (None, "", 3)),
        *(("other", engine, "engine") for engine in (None, 3, "module", {})),
    ],
)
def test_what_is_no_engine_is_not_registered(name, engine, blamed):
    with pytest.raises(ConfigurationError) as caught:
        tpm_gym.register_engine(name, engine)
    assert caught.value.name == blamed


@pytest.mark.parametrize("place", ["nixmod:Engine", "kinematic:Engines"])
def test_one_that_cannot_be_imported_is_refused_by_name(place):
    tpm_gym.register_engine(place, place)
    said = f"engine = '{place}'.*for '{place}' Python says: .*(nixmod|Engines)"
    with pytest.raises(ConfigurationError, match=said):
        tpm_gym.TPMEnv(engine=place)


def test_names_are_taken_once():
    tpm_gym.register_engine("kinematic", KinematicEngine)
    with pytest.raises(ConfigurationError, match="a name other than"):
        tpm_gym.register_engine("pybullet", KinematicEngine)
    with pytest.raises(ConfigurationError, match="'pybullet'"):
        tpm_gym.TPMEnv(engine="mujoco2000")


def test_an_engine_of_several_robots_gets_several():
    """Its number of robots says how many environments share one; the rest get another."""
    counts = []

    class Counted(KinematicEngine):
        def load(self, machine, scene, count):
            counts.append(count)
            super().load(machine, scene, count)

    tpm_gym.register_engine("counted", Counted, robots=1)
    tpm_gym.TPMVectorEnv(engine="counted", num_envs=3).close()
    assert counts == [1, 1, 1]
    counts.clear()
    tpm_gym.register_engine("counted", Counted, robots=2)
    tpm_gym.TPMVectorEnv(engine="counted", num_envs=3).close()
    assert counts == [2, 1]
    for robots in (0, 1.5, "many"):
        with pytest.raises(ConfigurationError, match="robots"):
            tpm_gym.register_engine("counted", Counted, robots=robots)


def test_a_control_period_that_is_shorter_than_its_time_step_is_refused():
    task = type("Quick", (tpm_gym.tasks.Reach,), {"control_period": 0.004})
    with pytest.raises(ConfigurationError, match=r"time_step = 0\.04"):
        tpm_gym.TPMEnv(task, engine="kinematic")
