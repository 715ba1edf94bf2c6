"""With a shield, no action leads near a singularity, and the nearest safe one is played."""

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from examples import examples
from hypothesis import strategies as st

import tpm_gym
from tpm_gym.arrays import FloatArray
from tpm_gym.envs.shield import Shield
from tpm_gym.envs.testing import bits, fingerprint, random_episode
from tpm_gym.envs.vector import TPMVectorEnv
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism import PAPER_TPM, WIDE_TPM, Machine
from tpm_gym.simulation.engine import spline_weights
from tpm_gym.tasks.control import Control, make_control
from tpm_gym.tasks.expert import Expert
from tpm_gym.tasks.reach import Reach

CLOSE = 0.003  # in units of the action


CASES = [
    pytest.param(machine, kind, id=f"{machine.name}-{kind}")
    for machine in (PAPER_TPM, WIDE_TPM)
    for kind in ("cartesian", "joints")
]


def on_the_path(recent: FloatArray, command: FloatArray, count: int) -> FloatArray:
    """Points (n, 2 count, 3) of a control period, and of the next one with the command held."""
    last = recent[:, 1]
    commands = np.stack([recent[:, 0], last, command, command], axis=1)
    weights = spline_weights(count)
    periods = [np.einsum("kc,nci->nki", weights, commands[:, k : k + 3]) for k in (0, 1)]
    return np.concatenate(periods, axis=1)


def lowest(
    machine: Machine, recent: FloatArray, command: FloatArray, count: int = 24
) -> FloatArray:
    """The smallest conditioning (n,) on the path."""
    found: FloatArray = machine.conditioning_at(on_the_path(recent, command, count)).min(axis=1)
    return found


def walk(machine: Machine, control: Control, shield: Shield, seed: int, steps: int = 60) -> Any:
    """Yield recent, wanted and played commands of 64 robots that lean somewhere for 10 steps."""
    rng, count = np.random.default_rng(seed), 64
    recent = np.tile(machine.home, (count, 2, 1))
    for step in range(steps):
        if step % 10 == 0:
            lean = rng.choice([-1.0, 1.0], (count, 3))
        actions = np.clip(lean + rng.uniform(-1, 1, (count, 3)), -1, 1)
        wanted = control.command(actions, recent[:, 1])
        played = shield.command(wanted, recent)
        yield recent, wanted, played
        recent = np.stack([recent[:, 1], played], axis=1)


@pytest.mark.parametrize(("machine", "kind"), CASES)
@examples(5, seed=st.integers(0, 10**6))
def test_no_path_comes_below_the_safe_conditioning(machine: Machine, kind: str, seed: int) -> None:
    control = make_control(kind, machine)
    shield = Shield(machine, control, machine.safe_conditioning)
    changed = 0
    for recent, wanted, played in walk(machine, control, shield, seed):
        assert lowest(machine, recent, played).min() >= machine.safe_conditioning
        step = np.abs(played - recent[:, 1]) / machine.step_limit
        assert step.max() <= 1 + 1e-9
        assert all(machine.region.contains(point) for point in played)
        changed += int((played != wanted).any(axis=1).sum())
    assert changed > 50


@pytest.mark.parametrize(("machine", "kind"), CASES)
def test_no_safe_command_is_nearer(machine: Machine, kind: str) -> None:
    rng, control = np.random.default_rng(0), make_control(kind, machine)
    shield = Shield(machine, control, machine.safe_conditioning)
    tried = nearer = 0
    for recent, wanted, played in walk(machine, control, shield, seed=1, steps=40):
        for row in np.flatnonzero((played != wanted).any(axis=1))[:3]:
            last = np.tile(recent[row, 1], (2000, 1))
            # All over what the control can command, and around what is played.
            others = control.command(rng.uniform(-1, 1, (2000, 3)), last)
            around = (
                played[row]
                + rng.normal(0, 1, (2000, 3))
                * machine.step_limit
                * np.geomspace(1e-3, 0.3, 2000)[:, None]
            )
            low, high = last - machine.step_limit, last + machine.step_limit
            around = machine.region.project(np.clip(around, low, high))
            turned = np.abs(control.scaled(around) - control.scaled(last)).max(axis=1)
            others = np.concatenate([others, around[turned <= 1]])
            aim = control.scaled(wanted[[row]])
            far = np.linalg.norm(control.scaled(others) - aim, axis=1)
            own = np.linalg.norm(control.scaled(played[[row]]) - aim)
            rest = others[far < own - CLOSE]
            past = np.tile(recent[row], (len(rest), 1, 1))
            nearer += int((lowest(machine, past, rest) >= machine.safe_conditioning).sum())
            tried += len(rest)
    assert tried > 1000
    assert nearer == 0


@pytest.mark.parametrize(("machine", "kind"), CASES)
def test_safe_commands_stay_as_they_are(machine: Machine, kind: str) -> None:
    control = make_control(kind, machine)
    shield, again = (Shield(machine, control, machine.safe_conditioning) for _ in range(2))
    kept = 0
    for recent, wanted, played in walk(machine, control, shield, seed=2):
        np.testing.assert_array_equal(again.command(played, recent), played)
        safe = lowest(machine, recent, wanted) > 1.001 * machine.safe_conditioning
        np.testing.assert_array_equal(played[safe], wanted[safe])
        kept += int(safe.sum())
    assert kept > 1000


def dipping(where: float) -> Any:
    """A machine whose conditioning is 0.2 nearly everywhere, but for a dip beside home, m."""

    def conditioning_at(points: Any) -> Any:
        along = np.asarray(points)[..., 0] - PAPER_TPM.home[0]
        return 0.2 - 0.15 * np.exp(-(((along - where) / 0.006) ** 2))

    names = ("name", "home", "region", "step_limit")
    own = {name: getattr(PAPER_TPM, name) for name in names}
    return SimpleNamespace(conditioning_at=conditioning_at, **own)


# Far from the border, a shield leaves out what it has seen; a reset or a restored state may bring
# the robot elsewhere between two steps.
@pytest.mark.parametrize("steps_elsewhere", [0, 1, 2, 5])
@pytest.mark.parametrize("dip", [0.015, 0.0225])  # at the end of the curve, and on the line
@pytest.mark.parametrize("steps_here", [0, 1])  # after a second one, the shield trusts the region
def test_the_path_is_safe_where_its_ends_are_and_its_middle_is_not(
    steps_elsewhere: int, steps_here: int, dip: float
) -> None:
    machine, home = dipping(dip), np.array(PAPER_TPM.home)
    shield = Shield(machine, make_control("cartesian", PAPER_TPM), 0.08)
    elsewhere = np.tile(home - (0.02, 0.0, 0.0), (1, 2, 1))
    for _ in range(steps_elsewhere):
        np.testing.assert_array_equal(shield.command(elsewhere[:, 1], elsewhere), elsewhere[:, 1])
    recent = np.tile(home, (1, 2, 1))
    for _ in range(steps_here):
        shield.command(recent[:, 1], recent)
    wanted = home + [[PAPER_TPM.step_limit[0], 0.0, 0.0]]
    assert machine.conditioning_at(wanted) > 0.15
    assert lowest(machine, recent, wanted) < 0.08
    for _ in range(3):
        played = shield.command(wanted, recent)
        assert lowest(machine, recent, played) >= 0.08
        recent = np.stack([recent[:, 1], played], axis=1)


@pytest.mark.parametrize("kind", ["cartesian", "joints"])
def test_a_row_has_the_same_bits_alone_and_among_many(kind: str) -> None:
    control = make_control(kind, PAPER_TPM)
    many, alone = (Shield(PAPER_TPM, control, 0.08) for _ in range(2))
    for recent, wanted, played in walk(PAPER_TPM, control, many, seed=3):
        np.testing.assert_array_equal(alone.command(wanted[[7]], recent[[7]]), played[[7]])
        fresh = Shield(PAPER_TPM, control, 0.08)  # which remembers nothing
        np.testing.assert_array_equal(fresh.command(wanted, recent), played)


@pytest.mark.parametrize("env_id", [name for name in tpm_gym.ENV_IDS if "Crossing" not in name])
def test_every_id_takes_a_shield(env_id: str) -> None:
    options = {"engine": "analytic", "machine": "paper"}
    with gym.make(env_id, shield=True, **options) as env:
        infos = [info for *_, info in random_episode(env, 1)]
        assert min(info["conditioning"] for info in infos) >= 0.08
        assert not any(info["singularity_penalty"] for info in infos)
    with gym.make(env_id, **options) as env, gym.make(env_id, shield=False, **options) as off:
        assert fingerprint(random_episode(env, 1, 5)) == fingerprint(random_episode(off, 1, 5))


def push(envs: Any, steps: int) -> FloatArray:
    """Push towards y = 0 along the whole region; return the true conditioning, (steps, n)."""
    rng, found = np.random.default_rng(0), []
    envs.reset(seed=0)
    for step in range(steps):
        if step % 7 == 0:
            actions = rng.choice([-1.0, 1.0], envs.action_space.shape)
            actions[:, 1] = -1.0
        envs.step(actions)
        found.append(envs.machine.conditioning(envs.state.theta))
    return np.array(found)


@pytest.mark.parametrize("engine", ["pybullet", "mujoco", "analytic"])
def test_no_engine_comes_below_safe_with_ideal_drives(engine: str) -> None:
    options = {"num_envs": 4, "engine": engine, "max_episode_steps": 1000}
    with_shield = gym.make_vec("TPMReach-v0", shield=True, **options)
    without = gym.make_vec("TPMReach-v0", **options)
    assert push(with_shield, 100).min() >= 0.08
    assert push(without, 100).min() < 0.06
    with_shield.close()
    without.close()


@pytest.mark.parametrize("machine", ["paper", "wide"])
@pytest.mark.parametrize("env_id", ["TPMCycle-v0", "TPMCycleJoints-v0"])
def test_robots_at_full_speed_brake_in_time(env_id: str, machine: str) -> None:
    # Motors cannot stop a robot in one control step of 4 ms.
    options = {"num_envs": 64, "engine": "analytic", "machine": machine}
    envs: Any = gym.make_vec(env_id, shield=True, **options)
    envs.reset(seed=0)
    rng, fastest = np.random.default_rng(0), 0.0
    for step in range(75):
        if step % 10 == 0:
            actions = rng.choice([-1.0, 1.0], (64, 3))
        before = envs.state.command
        *_, infos = envs.step(actions)
        assert infos["conditioning"].min() >= 0.08
        # The motors are strong enough for the whole path, which ends between two commands.
        path_end = (before + envs.state.command) / 2
        np.testing.assert_allclose(envs.state.platform_position, path_end, atol=1e-4)
        fastest = max(fastest, float(np.abs(envs.state.fk_velocity).max()))
    assert fastest > 2.0
    envs.close()


def test_a_shield_that_brakes_leaves_safe_commands_as_they_are() -> None:
    found = []
    for shield in (False, True):
        with gym.make("TPMCycle-v0", engine="analytic", shield=shield) as env:
            expert = Expert(env)
            observation, _ = env.reset(seed=1)
            for _ in range(75):
                observation, *_ = env.step(expert.act(observation))
            found.append(bits(observation))
    assert found[0] == found[1]


@pytest.mark.parametrize(
    ("options", "least", "most"),
    [
        ({"drive": "servo", "machine": "paper"}, 0.08, 0.092),
        ({"drive": "servo", "machine": "wide"}, 0.08, 0.092),
        ({"randomisation": {"link_mass": 2.0}}, 0.092, 0.093),  # follows its commands exactly
    ],
    ids=str,
)
def test_the_margin_is_enough_for_servo_drives_and_kept_with_randomisation(
    options: dict[str, Any], least: float, most: float
) -> None:
    options = {"num_envs": 64, "engine": "analytic", "max_episode_steps": 1000, **options}
    envs = gym.make_vec("TPMReach-v0", shield=True, **options)
    low = push(envs, 200).min()
    envs.close()
    assert least <= low < most


@pytest.mark.parametrize("value", [0.0, -0.1, 1.5, float("nan"), "on", None, 0.5, [0.1]])
def test_other_values_are_refused(value: Any) -> None:
    with pytest.raises(ConfigurationError, match="shield"):
        gym.make("TPMReach-v0", engine="analytic", shield=value)


def test_short_control_periods_need_accelerations() -> None:
    # Else torques are limited, and robots fall below the safe conditioning.
    quick = type("Quick", (Reach,), {"control_period": 0.01})
    with pytest.raises(ConfigurationError, match=r"shield = True .*accelerations"):
        tpm_gym.TPMEnv(quick, engine="analytic", shield=True)
    limits = (20.0, 5.0, 20.0), (10.0, 2.0, 10.0)
    steady = type("Steady", (quick,), {"accelerations": limits})
    envs: Any = TPMVectorEnv(steady, num_envs=64, engine="analytic", shield=True)
    assert push(envs, 200).min() >= 0.08


def test_a_number_is_the_conditioning_that_is_kept() -> None:
    with gym.make("TPMReachJoints-v0", engine="analytic", shield=0.12) as env:
        low = min(info["conditioning"] for *_, info in random_episode(env, 2))
    assert 0.12 <= low < 0.125
