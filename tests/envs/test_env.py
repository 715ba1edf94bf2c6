"""What the environment does with its options, its episodes and its snapshots; its datasheet."""

import inspect
import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from episodes import EVERYTHING, bits, play
from gymnasium.envs.registration import EnvSpec

from tpm_gym import TPMEnv
from tpm_gym.envs.rendering import RENDER_MODES
from tpm_gym.errors import ConfigurationError, InputError
from tpm_gym.mechanism.machine import Machine
from tpm_gym.mechanism.tpm import PAPER_TPM
from tpm_gym.simulation import Plant
from tpm_gym.simulation.settings import Numerics
from tpm_gym.simulation.state import State
from tpm_gym.tasks import Cycle, Entry, PickAndPlace, Reach, Task, Throw
from tpm_gym.tasks.sampling import APART

BLOCK = PickAndPlace.block


@pytest.fixture
def env():
    return TPMEnv("pick_and_place")


# -- options ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        *({"penalty_weight": value} for value in (-1.0, np.nan, "much", 10**400, True)),
        *({"physics": value} for value in (5, {"gravity": 0}, Numerics)),
        {"renderer": "raytracer"},
        {"control": "torque"},
        {"reward": "none"},
        {"goals": "hard"},
        {"goals": "tempting", "machine": "wide"},
        {"task": "juggle"},
        *({"engine": value} for value in ("havok", None, 3)),
        *({"machine": value} for value in ("hexapod", 3, object, Machine, {"name": "paper"})),
    ],
    ids=lambda options: str(options)[:50],
)
def test_bad_options_are_refused_by_name(options):
    with pytest.raises(ConfigurationError) as caught:
        TPMEnv(**options)
    name = next(iter(options))
    assert caught.value.name == name
    assert repr(options[name])[:20] in repr(caught.value.value)


def test_human_mode_without_a_display_is_refused_instead_of_ending_the_process(monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    for engine in ("pybullet", "mujoco", "analytic"):
        with pytest.raises(ConfigurationError, match="display") as caught:
            TPMEnv(engine=engine, render_mode="human")
        assert (caught.value.name, caught.value.value) == ("render_mode", "human")
    env = TPMEnv()
    assert env.metadata["render_modes"] == list(RENDER_MODES[1:])
    assert TPMEnv.metadata["render_modes"] == list(RENDER_MODES)


PHYSICS = {"time_step": 1 / 500, "erp": 0.9}


def test_a_spec_with_physics_and_randomisation_survives_json():
    from tpm_gym.simulation.bullet.physics import Physics

    physics = Physics(**PHYSICS)
    env = gym.make("TPMReach-v0", physics=physics, randomisation=EVERYTHING, machine="wide")
    spec = env.spec
    again = gym.make(EnvSpec.from_json(spec.to_json()))
    inner, other = env.unwrapped, again.unwrapped
    assert inner.simulation.engine.physics == other.simulation.engine.physics == physics
    assert (inner.randomisation, inner.machine) == (other.randomisation, other.machine)
    actions = [np.full(3, 0.5)] * 5
    inner.reset(seed=1)
    snapshot = inner.save_state()
    again.reset()
    other.restore_state(snapshot)
    assert inner.np_random_seed == other.np_random_seed == 1
    assert play(again.unwrapped, actions) == play(env.unwrapped, actions)


# -- episodes --------------------------------------------------------------------------------------


class Far(Reach):
    """Its observations lie beyond the space."""

    size = 1.0

    def achieved(self, state: Any) -> Any:
        return state.fk_position + (0.0, self.size, -self.size)

    def observe(self, state: Any) -> Any:
        return super().observe(state) + np.eye(9)[4] * self.size - np.eye(9)[7] * self.size


@pytest.mark.parametrize("size", [1e2, 1e5, 1e30])
def test_observations_are_clipped_into_their_space_and_else_exact(size):
    env = TPMEnv(Far)
    env.task.size = size
    env.reset(seed=0)
    seen = env.step(np.array([1.0, -1.0, 0.5]))[0]
    assert env.observation_space.contains(seen)
    exact = env.task.observe(env._core.state)[0]
    inside = np.abs(exact) < 10
    assert inside.sum() == 7
    np.testing.assert_array_equal(seen["observation"][inside], exact[inside].astype(np.float32))
    np.testing.assert_array_equal(seen["observation"][~inside], [10, -10])
    np.testing.assert_array_equal(seen["achieved_goal"][1:], [2, -2])


BAD_TERMS = {"reward_terms": None}, {"reward_terms": {"singularity": 10**400}}
MASKED = np.ma.array(np.zeros(3), mask=[True, False, False])


def test_goals_that_do_not_go_together_are_refused_and_what_is_nowhere_is_no_success():
    env, goals = TPMEnv("reach"), np.zeros((4, 3))
    for wrong in (MASKED, "far", [10**400, 0, 0], np.zeros(2), 0.0, None, [1j] * 3):
        for pair in ((wrong, goals[0]), (goals[0], wrong)):
            with pytest.raises(InputError, match="_goal"):
                env.compute_reward(*pair, {})
    with pytest.raises(InputError, match="desired_goal"):
        env.compute_reward(goals, goals[:3], {})
    for info in (None, [{}] * 3, 4, [None] * 4, "four", *BAD_TERMS):
        with pytest.raises(InputError, match="info must be"):
            env.compute_reward(goals, goals, info)
    assert env.compute_reward([np.nan] * 3, [0.0, 0.0, 0.0], {}) == -1.0
    assert env.compute_reward(goals[0], goals[0], [{}]) == 0.0
    with pytest.raises(InputError, match="info must be"):
        env.compute_reward(goals[0], goals[0], [{}, {}])


class Broken(Reach):
    """One of its methods gives what is no number."""

    where = ""

    def achieved(self, state: State) -> Any:
        return super().achieved(state) * self._factor("achieved")

    def shaping(self, state: State) -> Any:
        ones = np.ones(len(state.held))
        return {"near": self._factor("reward_terms") * ones, "far": -ones}

    def observed(self) -> Any:
        def source(state):
            return np.full((len(state.held), 1), self._factor("observed"))

        return (*super().observed(), Entry("extra", "-", "", (0.0,), (1.0,), source))

    def _factor(self, where: str) -> float:
        return np.nan if self.where == where else 1.0


@pytest.mark.parametrize(
    ("where", "what"),
    [
        ("achieved", "achieved()"),
        ("reward_terms", "reward_terms()['near']"),
        ("observed", "observed(), 'extra'"),
    ],
)
def test_what_a_task_gives_that_is_no_number_is_named(where, what):
    env = TPMEnv(Broken)
    env.reset(seed=0)
    env.task.where = where
    with pytest.raises(ConfigurationError, match="nan") as caught:
        env.step(np.zeros(3))
    assert caught.value.name == what
    env.task.where = ""
    env.reset(seed=0)
    env.step(np.zeros(3))


class Single(Reach):
    """With a term in single precision."""

    def shaping(self, state: State) -> Any:
        return {"own": np.full(len(state.held), -0.1, dtype=np.float32)}


def test_a_term_in_single_precision_takes_nothing_from_the_others():
    env = TPMEnv(Single)
    env.reset(seed=0)
    _, reward, _, _, info = env.step(np.ones(3))
    assert reward == pytest.approx(sum(info["reward_terms"].values()), rel=1e-14)


@pytest.mark.parametrize("x", [0.2, 0.6], ids=["on the table", "beside it"])
def test_a_block_that_is_pushed_off_is_lost(env, x):
    env.reset(seed=0)
    body, client = env.simulation.engine.bodies[0], env.simulation.engine.client
    client.resetBasePositionAndOrientation(body, (x, -0.03, 0.016), (0, 0, 0, 1))
    for _ in range(10):
        info = env.step(np.zeros(4))[4]
        assert info["object_lost"] is True
    assert env.reset(seed=0)[1]["object_lost"] is False


def test_info_tells_the_machine_that_was_drawn():
    env = TPMEnv("pick_and_place", randomisation=EVERYTHING)
    told = [env.reset(seed=seed)[1]["randomisation"] for seed in (1, 2, None, None, 1)]
    first, *others, again = told
    assert all(told.count(other) == 1 for other in others)
    assert first == again
    assert first.keys() == {*Plant.__dataclass_fields__, "latency"}
    assert first["block_mass"] != 1
    assert len(first["link_masses"]) == len(env.machine.mechanism.links) - 1
    assert "randomisation" not in env.step(np.zeros(4))[4]
    nominal = TPMEnv()
    assert "randomisation" not in nominal.reset(seed=0)[1]


# -- snapshots -------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", [None, "x", {}, 10**5000, object()], ids=type)
def test_what_is_no_snapshot_is_refused_and_touches_nothing(env, wrong):
    env.reset(seed=5)
    before = bits(vars(env.state)), env.goal.tolist(), env.np_random.bit_generator.state
    with pytest.raises(InputError, match="snapshot"):
        env.restore_state(wrong)
    after = bits(vars(env.state)), env.goal.tolist(), env.np_random.bit_generator.state
    assert after == before


def test_a_snapshot_of_another_kind_of_environment_is_refused(env):
    env.reset(seed=0)
    others: list[dict[str, Any]] = [
        {"task": "reach"},
        {"machine": "wide"},
        {"reward": "dense"},
        {"goals": "tempting"},
        {"penalty_weight": 0.5},
        {"control": "joints"},
        {"engine": "analytic"},
        {"drive": "servo"},
        {"randomisation": {"latency": 1}},
        {"physics": PHYSICS},
        {"shield": True},
        {"observations": "pixels"},
    ]
    for options in others:
        other = TPMEnv(**{"task": "pick_and_place", **options})
        other.reset(seed=0)
        with pytest.raises(
            InputError, match=f"same task and options, got 'another {next(iter(options))}'"
        ):
            env.restore_state(other.save_state())
    env.step(np.zeros(4))


# -- the datasheet ---------------------------------------------------------------------------------


def test_the_datasheet_lists_the_entries_and_numbers_that_the_code_uses():
    text = inspect.getdoc(TPMEnv) or ""
    task, machine = PickAndPlace(PAPER_TPM), PAPER_TPM
    entries = text[text.index("## Observation") : text.index("## Reward")]
    rows = re.findall(r"^\| (\w+) \| (\d) \| (.+) \|$", entries, flags=re.MULTILINE)
    assert rows == [(e.name, str(len(e.scale)), e.meaning) for e in task.entries]
    steps = ", ".join(f"{1e3 * step:g}" for step in machine.step_limit)
    assert f"at most {steps} mm" in text
    assert f"at most {machine.joint_limit} rad" in text
    safe = machine.safe_conditioning
    assert f"(1 - (c / {safe})^4) where c = 1/cond(J) < {safe}, else 0" in text
    assert f"1/cond(J) >= {safe}" in text
    (x0, y0, z1), (x1, y1, z0) = (
        machine.mount.to_world(end) for end in vars(machine.region).values()
    )
    box = f"{x0:.4g} <= x <= {x1:.4g}, {y1:.4g} <= y <= {y0:.4g}, {z0:.4g} <= z <= {z1:.4g} m"
    assert box in text
    size = (1e3 * BLOCK.width, 1e3 * BLOCK.height, 1e3 * BLOCK.mass)
    assert "(square, {:.0f} mm wide, {:.0f} mm high, {:.0f} g)".format(*size) in text
    limits = (1e3 * kind.tolerance for kind in (Task, Throw, Cycle))
    assert "{:.0f} mm, Throw {:.0f}, Cycle {:.0f} |".format(*limits) in text
    assert f"at least {1e3 * APART:.0f} mm" in text


def test_the_datasheet_lists_all_of_info_and_every_option():
    text = inspect.getdoc(TPMEnv) or ""
    env = TPMEnv(randomisation=EVERYTHING)
    info = text[text.index("## Info") : text.index("Args:")]
    assert re.findall(r"^\| ``(\w+)`` \|", info, re.M) == list(env.reset(seed=0)[1])
    options = list(inspect.signature(TPMEnv).parameters)
    assert (
        re.findall(r"^    (\w+): ", text[text.index("Args:") : text.index("Raises:")], re.M)
        == options
    )
