"""What a user registers with Gymnasium is trained, resumed and evaluated like our own ids."""

import json
import os
import shlex
import shutil
import signal
import sys
from typing import Any

import gymnasium as gym
import pytest
from gymnasium.wrappers import TransformReward
from processes import PYTHON, printed_by
from registries import registries_put_back
from trainings import SAC_RECIPE, interrupt_at, uninterrupted

from tpm_gym.learning import TrainingConfig
from tpm_gym.learning.command_line import main
from tpm_gym.learning.configuration import complete
from tpm_gym.learning.environments import check_env_id, make_env
from tpm_gym.learning.errors import ConfigError
from tpm_gym.policy.files import digest
from tpm_gym.resources import POLICIES
from tpm_gym.simulation import Servo

pytestmark = pytest.mark.usefixtures("no_pictures")

MODULE = """
import tpm_gym
from tpm_gym.tasks import Reach

tpm_gym.register_task("Mine", type("Mine", (Reach,), {}), max_episode_steps=20)
tpm_gym.register_machine("mine", tpm_gym.PAPER_TPM)
"""


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Runs the command as in a folder of which Python has imported nothing."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path.copy())  # to which the command adds the folder

    def run_anew(*words):
        with registries_put_back("my_tasks"):
            main(words)

    return run_anew


@pytest.mark.usefixtures("needs_pybullet")
def test_an_id_of_a_users_module_is_trained_in_workers_resumed_and_evaluated(tmp_path, run):
    (tmp_path / "my_tasks.py").write_text(MODULE)
    (tmp_path / "sac.yml").write_text(SAC_RECIPE.format(env="TPMMine-v0", train_freq=5))
    words = ["--env", "my_tasks:TPMMine-v0", "--recipe", "sac.yml", "--envs", "2"]
    words += ["--steps", "120", "--eval-episodes", "1", "--machine", "mine"]
    run("train", *words)
    folder = "runs/TPMMine-v0-sac-s0"
    name = ("--env", "my_tasks:TPMMine-v0")
    run("resume", folder, "--steps", "160", *name)
    words = ["--policy", folder, "expert", "--episodes", "1", "--json", "out.json"]
    run("evaluate", *words, *name)
    content = json.loads((tmp_path / "out.json").read_text())
    assert content["env"] == "my_tasks:TPMMine-v0"
    assert content["env_options"]["machine"] == "mine"  # as in training
    assert [policy["records"][0]["length"] for policy in content["policies"]] == [20, 20]


OWN_ID = """
import gymnasium as gym
import tpm_gym

spec = gym.spec("TPMReach-v0")
gym.register(
    "OwnReach-v0",
    entry_point=spec.entry_point,
    vector_entry_point=spec.vector_entry_point,
    max_episode_steps=20,
    kwargs={
        **spec.kwargs,
        "drive": "servo",
        "goals": "tempting",
        "penalty_weight": 0.5,
        "randomisation": {"latency": 1},
    },
)
"""


@pytest.mark.usefixtures("needs_pybullet")
def test_what_an_id_sets_holds_in_training_and_goes_with_the_policy(tmp_path, run, monkeypatch):
    (tmp_path / "own_id.py").write_text(OWN_ID)
    (tmp_path / "sac.yml").write_text(SAC_RECIPE.format(env="OwnReach-v0", train_freq=5))
    made = []
    make = gym.make_vec
    monkeypatch.setattr(gym, "make_vec", lambda *a, **k: made.append(make(*a, **k)) or made[-1])
    words = ["--env", "own_id:OwnReach-v0", "--recipe", "sac.yml", "--envs", "2"]
    words += ["--steps", "120", "--eval-episodes", "1"]
    run("train", *words)
    for envs in made:
        assert (envs.drive, envs.randomisation.latency) == (Servo(), 1)
        assert (envs.task.goals, envs.task.penalty_weight) == ("tempting", 0.5)
    folder = tmp_path / "runs" / "OwnReach-v0-sac-s0"
    content = json.loads((folder / "config.json").read_text())
    assert (content["goals"], content["penalty_weight"]) == ("tempting", 0.5)
    run("export", str(folder / "best.zip"), "again", "--trust-pickle")
    for policy in (folder / "best.json", "again.json"):
        words = ["--policy", str(policy), "--env", "TPMReach-v0"]
        run("evaluate", *words, "--episodes", "1", "--json", "out.json")
        content = json.loads((tmp_path / "out.json").read_text())
        assert content["env_options"]["drive"] == "servo"
        assert (content["goals"], content["penalty_weight"]) == ("sampled", 1.0)


def test_a_module_that_another_file_hides_is_named():
    with pytest.raises(ConfigError, match=r"'json:TPMMine-v0'; the module is .*json.*py; if you"):
        complete(TrainingConfig(env="json:TPMMine-v0"))


def test_no_file_decides_what_is_imported(tmp_path, run, capsys):
    trace = tmp_path / "trace"
    (tmp_path / "my_tasks.py").write_text(f"{MODULE}\nopen({str(trace)!r}, 'w').close()")
    for suffix in (".json", ".safetensors"):
        (tmp_path / f"best{suffix}").write_bytes((POLICIES / f"TPMReach-v0{suffix}").read_bytes())
    content = json.loads((tmp_path / "best.json").read_text())
    content["env"] = "my_tasks:TPMReach-v0"
    (tmp_path / "best.json").write_text(json.dumps({**content, "sha256": digest(content)}))
    shutil.copytree(uninterrupted("sac"), tmp_path / "a run")
    stored = json.loads((tmp_path / "a run" / "config.json").read_text())
    stored["env"] = content["env"]
    (tmp_path / "a run" / "config.json").write_text(json.dumps(stored))
    commands = [["evaluate", "--episodes", "1", "--policy", "best.json"], ["resume", "a run"]]
    for words in commands:
        with pytest.raises(SystemExit, match=r"'my_tasks'.*give --env my_tasks:TPMReach-v0"):
            run(*words)
        assert not trace.exists()
    for words in commands:
        run(*words, "--env", content["env"])
        assert trace.exists()
        trace.unlink()
    assert "nothing to do" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="--env TPMReach-v0: the run was trained in my_tasks:"):
        run("resume", "a run", "--env", "TPMReach-v0")


@pytest.mark.usefixtures("needs_pybullet")
def test_a_stopped_run_says_how_its_module_is_found_again(tmp_path, run, monkeypatch, capsys):
    (tmp_path / "my_tasks.py").write_text(MODULE)
    (tmp_path / "sac.yml").write_text(SAC_RECIPE.format(env="TPMMine-v0", train_freq=5))
    interrupt_at(monkeypatch, 10, lambda: os.kill(os.getpid(), signal.SIGINT))
    words = ["--env", "my_tasks:TPMMine-v0", "--recipe", "sac.yml", "--eval-episodes", "1"]
    words += ["--steps", "110"]
    with pytest.raises(SystemExit):
        run("train", *words, "--run", "a run")
    _, _, command = capsys.readouterr().out.partition("continue with: ")
    program, *words = shlex.split(command)
    assert program == "tpm-gym"
    assert "to 110" in printed_by(PYTHON, "-m", "tpm_gym.learning", *words, cwd=tmp_path)


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("TPMRech-v0", "unknown environment 'TPMRech-v0'; .*TPMPickAndPlace-v0.*module:id"),
        ("no_such_module:TPMMine-v0", "cannot import 'no_such_module'.*folder that holds it"),
        (".x:TPMReach-v0", "cannot import .*TypeError"),
        ("CartPole-v1", "CartPole-v1 is no environment of tpm_gym"),
        ("not an id", "unknown environment"),
    ],
)
def test_what_is_no_environment_of_ours_is_refused(env_id, message):
    with pytest.raises(ConfigError, match=message):
        complete(TrainingConfig(env=env_id))


def test_a_class_that_derives_from_ours_is_accepted_however_it_is_registered():
    from tpm_gym import TPMEnv
    from tpm_gym.envs.vector import TPMVectorEnv

    class Mine(TPMEnv):
        pass

    registration: dict[str, Any] = {"entry_point": Mine, "kwargs": {"task": "reach"}}
    needed: dict[str, Any] = {"vector_entry_point": TPMVectorEnv, "max_episode_steps": 5}
    try:
        for name in needed:  # without vectors nothing is evaluated, without an end for ever
            others = {key: value for key, value in needed.items() if key != name}
            gym.register(id="Mine-v0", **registration, **others)
            with pytest.raises(ConfigError, match=f"Mine-v0 is registered without .*{name}"):
                check_env_id("Mine-v0")
            del gym.registry["Mine-v0"]
        wrapped = (TransformReward.wrapper_spec(func=None),)
        gym.register(id="Mine-v0", **registration, **needed, additional_wrappers=wrapped)
        with pytest.raises(ConfigError, match="with the wrappers TransformReward, which vector"):
            check_env_id("Mine-v0")
        del gym.registry["Mine-v0"]
        gym.register(id="Mine-v0", **registration, **needed)
        env = make_env(check_env_id("Mine-v0"), penalty_weight=0.5)
        assert isinstance(env.unwrapped, Mine)
        assert env.unwrapped.task.penalty_weight == 0.5
        env.close()
    finally:
        gym.registry.pop("Mine-v0", None)
