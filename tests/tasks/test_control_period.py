"""Tasks whose control period is not 40 ms: time steps, speeds and encoders follow it."""

from contextlib import closing

import numpy as np
import pytest

from tpm_gym import PAPER_TPM, TPMEnv, TPMVectorEnv
from tpm_gym.errors import ConfigurationError
from tpm_gym.tasks import Expert, Reach
from tpm_gym.tasks.push import Push

ENGINES = ("pybullet", "mujoco", "analytic")


class Quick(Reach):
    """Reach with ten times as many commands."""

    control_period = 0.004


@pytest.mark.parametrize("engine", ENGINES)
def test_a_full_action_moves_p_at_the_same_speed(engine):
    travelled = {}
    for task, steps in ((Reach, 5), (Quick, 50)):
        with closing(TPMEnv(task, engine=engine)) as env:
            env.reset(seed=0)
            start = env.state.command
            for _ in range(steps):
                observation, *_ = env.step(np.array([1.0, 0.0, 0.0]))
            travelled[task] = env.state.command - start
            assert env.metadata["render_fps"] == round(1 / task.control_period)
            # Once the spline is straight, P moves at full speed, in m/s.
            speed = PAPER_TPM.step_limit[0] / 0.04
            assert env.state.fk_velocity[0] == pytest.approx(speed, rel=5e-3)
            assert observation["observation"][3] == pytest.approx(1.0, rel=5e-3)
    np.testing.assert_allclose(travelled[Quick], travelled[Reach], rtol=0, atol=1e-12)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("drive", ["ideal", "servo"])
def test_the_expert_takes_as_long(engine, drive):
    reached = {}
    for task in (Reach, Quick):
        with closing(TPMEnv(task, engine=engine, drive=drive)) as env:
            observation, _ = env.reset(seed=1, options={"goal": (0.05, -0.03, 0.2)})
            expert, info, steps = Expert(env), {"is_success": False}, 0
            while not info["is_success"]:
                observation, *_, info = env.step(expert.act(observation))
                steps += 1
            reached[task] = steps * task.control_period
    assert reached[Quick] == pytest.approx(reached[Reach], abs=0.05)


class QuickPush(Push):
    """Push with four times as many commands."""

    control_period = 0.010


def test_the_expert_pushes_at_the_same_pace():
    with closing(TPMEnv(QuickPush, engine="analytic")) as env:
        for seed in range(4):
            observation, _ = env.reset(seed=seed)
            expert = Expert(env)
            for _ in range(4 * Push.max_episode_steps):
                observation, *_, info = env.step(expert.act(observation))
            assert info["is_success"]


def test_time_steps_are_a_tenth_of_it_or_as_asked():
    for physics, step in ((None, 4e-4), ({"torques": "every"}, 4e-4), ({"time_step": 1e-3}, 1e-3)):
        with closing(TPMEnv(Quick, engine="analytic", physics=physics)) as env:
            assert env.simulation.engine.time_step == pytest.approx(step)
            env.reset(seed=0)
            env.step(np.zeros(3))


@pytest.mark.parametrize(
    ("engine", "step"), [("pybullet", 3e-3), ("mujoco", 5e-3), ("analytic", 2e-3)]
)
def test_a_time_step_that_does_not_fit_is_refused_by_name(engine, step):
    for make in (TPMEnv, TPMVectorEnv):
        with pytest.raises(ConfigurationError, match=r"0\.004 s \(control period\)") as caught:
            make(Quick, engine=engine, physics={"time_step": step})
        assert (caught.value.name, caught.value.value) == ("time_step", step)


def test_noise_of_encoders_is_a_rate_over_the_period():
    spread = {}
    for task in (Reach, Quick):
        noise = {"encoder_noise": 1e-3}
        with closing(TPMEnv(task, engine="analytic", randomisation=noise)) as env:
            env.reset(seed=0)
            env.step(np.zeros(3))
            rates = []
            for _ in range(200):
                env.step(np.zeros(3))
                rates.append(env.state.theta_dot)
            spread[task] = np.std(rates)
    assert spread[Quick] == pytest.approx(10 * spread[Reach], rel=0.2)


@pytest.mark.parametrize("period", [0.0, -0.04, np.nan, "40 ms", True])
def test_what_is_no_period_is_refused(period):
    with pytest.raises(ConfigurationError, match="control_period"):
        type("Odd", (Reach,), {"control_period": period})(PAPER_TPM)
