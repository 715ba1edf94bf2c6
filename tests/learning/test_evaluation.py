"""An evaluation writes what it promises: a table, strict JSON and a video, without torch."""

import json
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v3 as imageio
import numpy as np
import pytest
from episodes import expert_episode
from paths import read_strict
from processes import PYTHON, TPM_GYM, printed_by, signalled
from registries import register_like, registries_put_back
from trainings import quiet, said

import tpm_gym
from tpm_gym.errors import ConfigurationError
from tpm_gym.learning import EnvOptions, EvaluationConfig, evaluate, evaluation, provenance
from tpm_gym.learning.command_line import main
from tpm_gym.learning.errors import ConfigError, PolicyError
from tpm_gym.learning.film import write_contact_sheet
from tpm_gym.policy.files import digest
from tpm_gym.tasks import Reach

METRICS = (
    "success_at_end",
    "success_once",
    "return",
    "conditioning_min",
    "conditioning_mean",
    "closure_error_max",
    "unsafe_share",
    "fk_error_max",
)


@pytest.fixture(scope="module")
def written(needs_pybullet, tmp_path_factory):
    """Return the JSON and the output of the command line, run on one policy."""
    path = tmp_path_factory.mktemp("evaluate") / "deep" / "er" / "expert.json"
    options = f"--policy expert --env TPMReach-v0 --episodes 4 --seed 7 --json {path}".split()
    output = printed_by(*TPM_GYM, "evaluate", *options)
    return read_strict(path), output


def test_one_policy_has_its_metrics_at_the_top_and_its_records(written):
    content, _ = written
    records = content["records"]
    assert [record["seed"] for record in records] == [7, 8, 9, 10]
    for name in METRICS:
        estimate = content[name]
        assert estimate["low"] <= estimate["mean"] <= estimate["high"], name
        assert estimate["mean"] == pytest.approx(sum(r[name] for r in records) / 4), name
    assert content["policy"] == "expert"
    assert (content["env"], content["episodes"], content["seed"]) == ("TPMReach-v0", 4, 7)
    assert content["closure_error_max"]["worst"] >= content["closure_error_max"]["mean"]
    assert content["versions"] == provenance.versions()
    assert "git_commit" in content
    words = "tpm-gym evaluate --policy expert --env TPMReach-v0 --episodes 4 --seed 7"
    assert content["command"].startswith(words)
    for folder in (Path.home(), Path(evaluation.__file__).parent):
        assert str(folder) not in json.dumps(content)


def test_table_shows_means_and_intervals(written):
    content, output = written
    errors = [f"{1e3 * content['closure_error_max'][part]:.4f} mm" for part in ("mean", "worst")]
    # The Wilson interval of 4 of 4.
    for shown in ("success at end", "expert", "[51.0, 100.0]", "seeds 7 to 10", *errors):
        assert shown in output


def in_wall(self, state):
    return np.abs(state.fk_position[:, 0] - 0.02) < 0.01


def test_events_of_a_task_are_shown_as_shares_of_episodes(tmp_path):
    path, seeds, console = tmp_path / "wall.json", range(100, 108), quiet()
    wall = type("Wall", (Reach,), {"events": ("in_wall",), "in_wall": in_wall})
    asked = {"episodes": 8, "seed": 100, "env_options": EnvOptions(engine="analytic")}
    with registries_put_back():
        env_id = tpm_gym.register_task("Wall", wall)[0]
        evaluate(EvaluationConfig(("expert",), env=env_id, json=path, **asked), console)
        env = gym.make(env_id, engine="analytic")
        told = [[info["in_wall"] for *_, info in expert_episode(env, seed)] for seed in seeds]
    happened = [any(steps[1:]) for steps in told]  # without the reset
    assert 0 < sum(happened) < 8
    assert happened != [steps[-1] for steps in told]  # once is not at the end
    content = read_strict(path)
    assert [record["in_wall_once"] for record in content["records"]] == happened
    share = content["in_wall_once"]
    assert share["mean"] == sum(happened) / 8
    row = re.search(r"in wall once +. +(\S+)% \[(\S+), (\S+)\]", said(console)).groups()
    expected = [100 * share[end] for end in ("mean", "low", "high")]
    assert [float(number) for number in row] == pytest.approx(expected, abs=0.05)


@pytest.fixture
def short() -> Iterator[str]:
    """Id of a task of six steps, since drawing takes long."""
    with registries_put_back():
        yield tpm_gym.register_task("Short", type("Short", (Reach,), {}), max_episode_steps=6)[0]


# imageio-ffmpeg leaves a pipe to the collector where ffmpeg ends before its reader is closed.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(("episodes", "shown"), [(2, 1), (1, 3)])
def test_video_shows_the_first_episodes(episodes, shown, short, tmp_path):
    path = tmp_path / "films" / "expert.mp4"
    asked = {"policy": ("expert",), "env": short, "episodes": episodes, "video_episodes": shown}
    console = quiet()
    (result,) = evaluate(EvaluationConfig(**asked, video=path), console)
    frames = imageio.imread(path, plugin="FFMPEG")  # (frames, height, width, 3)
    assert len(frames) == result.records[0].length + 1
    assert frames[0].std() > 5  # something is to be seen
    assert (frames[0] != frames[-1]).any()  # and it moves
    assert imageio.immeta(path, plugin="FFMPEG")["fps"] == 25
    assert [entry.name for entry in path.parent.iterdir()] == ["expert.mp4"]
    assert f"video: {path}\n" in said(console)
    waits = [line for line in said(console).splitlines() if line.endswith("...")]
    assert waits == [f"expert: {episodes} episodes ...", f"drawing the video {path} ..."]


@pytest.mark.parametrize(
    ("policies", "names"),
    [
        (("expert",), ["v.mp4"]),
        (("expert", "random"), ["v-expert.mp4", "v-random.mp4"]),
        (("a/best.zip", "b/best.zip"), ["v-1-best.mp4", "v-2-best.mp4"]),
    ],
)
def test_every_policy_gets_its_own_video(policies, names):
    paths = evaluation.paths_per_policy(Path("films", "v.mp4"), policies)
    assert [path.name for path in paths] == names
    assert all(path.parent == Path("films") for path in paths)


def test_picture_shows_six_moments_of_the_first_episode(short, tmp_path):
    path = tmp_path / "new" / "expert.png"
    asked = {"policy": ("expert",), "env": short, "camera": "cup"}
    config = EvaluationConfig(**asked, episodes=1, picture=path)
    evaluate(config, quiet())
    env = gym.make(short, render_mode="rgb_array", camera="cup")
    env.reset(seed=config.seed)
    first = env.render()
    env.close()
    picture = imageio.imread(path)
    height, width = first.shape[:2]
    assert picture.shape[0] > 2 * height
    assert picture.shape[1] > 3 * width
    np.testing.assert_array_equal(picture[:height, :width], first)
    below = picture[height : picture.shape[0] // 2, :width]
    assert below.min() < 50 < 200 < below.mean()  # the time, black on white


def test_picture_shows_the_motion_at_the_start_of_a_long_episode(tmp_path):
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 40, (50, 24, 32, 3)).astype(np.uint8)
    frames[:4] += np.array([200, 150, 100, 50], np.uint8)[:, None, None, None]
    path = tmp_path / "reach.png"

    def play(use):
        for frame in frames:
            use(frame)

    write_contact_sheet(path, play, 25.0)
    shown = imageio.imread(path)
    left = [shown[row : row + 24, column : column + 32]
            for row in (0, 24 + 32) for column in (0, 40, 80)]  # fmt: skip
    for frame, expected in zip(left, (*frames[:4], None, frames[-1]), strict=True):
        assert expected is None or (frame == expected).all()


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"episodes": 0}, ConfigError, "at least 1"),
        ({"policy": ()}, ConfigError, "--policy: give at least one"),
        ({"env": None}, ConfigError, "^expert and random have no .*: give --env ID$"),
        (
            {"env": None, "policy": ("TPMReach-v0", "TPMPickAndPlace-v0")},
            ConfigError,
            "differ in env: TPMReach-v0 .*, TPMPickAndPlace-v0 .*; choose one, as in --env TPMR",
        ),
        ({"env": "TPMRech-v0"}, ConfigError, "TPMReach-v0"),
        ({"policy": ("expert", "gone.zip")}, PolicyError, "no file gone.zip"),
        ({"video": Path("film.xyz")}, ConfigError, "--video"),
        ({"picture": Path("still")}, ConfigError, "--picture"),
        ({"json": Path("/proc/o.json")}, ConfigError, "--json /proc/o.json: cannot be written"),
        ({"json": Path("/proc")}, ConfigError, "--json /proc: .*; choose another name"),
        ({"randomisation": ("block_mass",)}, ConfigError, "--randomisation"),
        ({"randomisation": ("a=1:2:3",)}, ConfigError, "--randomisation"),
        ({"randomisation": ("a=1", "a=2")}, ConfigError, "--randomisation"),
        ({"randomisation": ("puk_mass=2",)}, ConfigurationError, "block_mass"),
        ({"penalty_weight": -1.0}, ConfigurationError, "penalty_weight"),
        ({"env_options": EnvOptions(machine="narrow")}, ConfigurationError, "'paper', 'wide'"),
    ],
)
def test_mistakes_are_named(options, error, message):
    usual = {"policy": ("expert",), "env": "TPMReach-v0"}
    with pytest.raises(error, match=message):
        evaluate(EvaluationConfig(**{**usual, **options}), quiet())


def test_conditions_are_recorded_and_the_defaults_are_the_nominal_machine(
    written, tmp_path, monkeypatch
):
    content, _ = written
    assert (content["goals"], content["penalty_weight"]) == ("sampled", 1.0)
    assert content["randomisation"] == {}
    nominal = {"machine": "paper", "engine": "pybullet", "drive": "ideal"}
    assert content["env_options"] == nominal
    path = tmp_path / "other.json"
    words = ["--policy", "expert", "--env", "TPMReach-v0", "--episodes", "1", "--json", str(path)]
    words += ["--randomisation", "encoder_noise=1e-4", "friction=0.5:1", "latency=1"]
    words += ["--penalty-weight", "0.5", "--goals", "tempting", "--drive", "servo"]
    monkeypatch.setattr(sys, "argv", ["tpm-gym", "evaluate", *words])
    main()
    content = read_strict(path)
    assert content["randomisation"] == {"encoder_noise": 1e-4, "friction": [0.5, 1.0], "latency": 1}
    assert (content["goals"], content["penalty_weight"]) == ("tempting", 0.5)
    assert content["conditioning_min"]["mean"] < 0.09  # of sampled goals, seldom
    assert content["env_options"] == {**nominal, "drive": "servo"}
    assert "--randomisation encoder_noise=1e-4 friction=0.5:1" in content["command"]


def test_an_option_of_the_id_is_recorded(short, tmp_path):
    path = tmp_path / "out.json"
    gym.spec(short).kwargs["machine"] = "wide"
    evaluate(EvaluationConfig(("random",), env=short, episodes=1, json=path), quiet())
    assert read_strict(path)["env_options"]["machine"] == "wide"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return the folder of a run: an untrained policy, as saved and as exported."""
    from stable_baselines3 import PPO

    from tpm_gym.learning import export

    folder = tmp_path_factory.mktemp("runs") / "reach"
    folder.mkdir()
    env = gym.make("TPMReach-v0")
    model = PPO("MultiInputPolicy", env, seed=0, device="cpu")
    env.close()
    model.save(folder / "best.zip")
    export.save(model, folder / "best", env_id="TPMReach-v0", seed=0, recipe={})
    config = {"algo": "ppo", "env": "TPMReach-v0", "seed": 0, "recipe": {}, "env_options": {}}
    config["training_seeds"] = [0, 0]
    (folder / "config.json").write_text(json.dumps(config))
    return folder


def returns(policy: Path | str, **options: Any) -> list[float]:
    config = EvaluationConfig(policy=(str(policy),), episodes=1, **options)
    return [record.total_reward for record in evaluate(config, quiet())[0].records]


def test_a_policy_is_evaluated_on_its_own_machine_and_drive_unless_others_are_given(run, tmp_path):
    shutil.copytree(run, tmp_path / "run")
    path = tmp_path / "run" / "best.json"
    own = {"machine": "wide", "drive": "servo", "engine": "analytic"}
    content = json.loads(path.read_text()) | {"env_options": own}
    path.write_text(json.dumps({**content, "sha256": digest(content)}))
    for given, expected in (
        (EnvOptions(), ("wide", "pybullet", "servo")),
        (EnvOptions(machine="paper"), ("paper", "pybullet", "servo")),
        (EnvOptions(engine="mujoco", drive="ideal"), ("wide", "mujoco", "ideal")),
    ):
        console, out = quiet(), tmp_path / "out.json"
        evaluate(
            EvaluationConfig((str(path.parent),), episodes=1, env_options=given, json=out), console
        )
        names = dict(zip(("machine", "engine", "drive"), expected, strict=True))
        assert read_strict(out)["env_options"] == names
        heading = "machine {}, engine {}, drive {}".format(*expected)
        assert heading in " ".join(said(console).split())
    both = (str(path.parent), "TPMReach-v0")
    with pytest.raises(ConfigError, match=r"in machine: wide \(.*\), paper \(TPMReach-v0\); .*--m"):
        evaluate(EvaluationConfig(both, episodes=1), quiet())
    chosen = EnvOptions("paper", drive="ideal")
    evaluate(EvaluationConfig(both, episodes=1, env_options=chosen), quiet())


@pytest.fixture
def own_id() -> Iterator[Any]:
    """Return a function that registers ids of Reach with options of their own."""

    def register(name: str, **options: Any) -> str:
        reach = "TPMReach-v0"
        register_like(reach, name, steps=3, kwargs={**gym.spec(reach).kwargs, **options})
        return name

    with registries_put_back():
        yield register


def evaluated(policy: Path, env: str | None, out: Path, **options: Any) -> dict[str, str]:
    given = EnvOptions(**options)
    evaluate(EvaluationConfig((str(policy),), env, 1, json=out, env_options=given), quiet())
    return read_strict(out)["env_options"]


OTHER = replace(tpm_gym.PAPER_TPM, table=(0.4, 0.3))  # another machine of the name "paper"


@pytest.mark.parametrize(
    ("options", "elsewhere"),
    [
        ({"machine": "wide", "drive": "servo"}, {"machine": "wide", "drive": "servo"}),
        ({"machine": tpm_gym.WIDE_TPM}, {"machine": "wide"}),
        ({"shield": True}, {"shield": "True"}),
        ({"machine": OTHER}, r"machine = 'paper \([0-9a-f]{8}\)' is not possible"),
        ({"machine": replace(OTHER, name="ångström")}, r"machine = .*ngstr.* is not possible"),
    ],
)
@pytest.mark.parametrize("registered", [True, False])
def test_a_policy_keeps_the_conditions_of_its_id_in_every_id(
    options, elsewhere, registered, run, own_id, tmp_path
):
    from tpm_gym.learning import export

    own, out = own_id("OwnReach-v0", **options), tmp_path / "out.json"
    model = export.load_model(run / "best.zip", "ppo")
    export.save(model, tmp_path / "best", env_id=own, seed=0, recipe={})
    nominal = evaluated(run / "best.json", "TPMReach-v0", out)
    at_home = evaluated(tmp_path / "best.json", own, out)
    assert at_home["machine"] != "paper" or "shield" in at_home
    if not registered:
        del gym.registry[own]
    if isinstance(elsewhere, str):
        with pytest.raises(ConfigurationError, match=elsewhere):
            evaluated(tmp_path / "best.json", "TPMReach-v0", out)
        assert evaluated(tmp_path / "best.json", "TPMReach-v0", out, machine="paper") == nominal
        return
    assert evaluated(tmp_path / "best.json", "TPMReach-v0", out) == nominal | elsewhere


def test_a_policy_of_an_older_file_has_the_conditions_of_its_id(run, own_id, tmp_path):
    own, out = own_id("OwnReach-v0", machine="wide"), tmp_path / "out.json"
    shutil.copytree(run, tmp_path / "run")
    path = tmp_path / "run" / "best.json"
    content = json.loads(path.read_text()) | {"env": own}
    path.write_text(json.dumps({**content, "sha256": digest(content)}))
    assert evaluated(path, "TPMReach-v0", out)["machine"] == "wide"
    assert evaluated(run / "best.json", own, out)["machine"] == "paper"
    assert evaluated(run / "best.json", own, out, machine="wide")["machine"] == "wide"


def test_a_machine_of_an_id_without_a_registered_name_can_be_chosen_by_its_own(
    run, own_id, tmp_path
):
    own = own_id("OwnReach-v0", machine=replace(OTHER, name="nowhere registered"))
    out = tmp_path / "out.json"
    found = evaluated(run / "best.json", own, out, machine="nowhere registered")
    assert found["machine"] == "nowhere registered"


def test_goals_penalty_and_randomisation_of_an_id_hold_unless_others_are_given(
    own_id, tmp_path, monkeypatch
):
    own = {"goals": "tempting", "penalty_weight": 0.0, "randomisation": {"latency": 1}}
    env, out, made = own_id("OwnReach-v0", **own), tmp_path / "out.json", []
    make = gym.make_vec
    monkeypatch.setattr(gym, "make_vec", lambda *a, **k: made.append(make(*a, **k)) or made[-1])
    for given in ({}, {"goals": "sampled", "penalty_weight": 1.0, "randomisation": ("latency=2",)}):
        evaluate(EvaluationConfig(("expert",), env, 1, json=out, **given), quiet())
        latency = 2 if given else 1
        expected = {**own, **given, "randomisation": {"latency": latency}}
        content = read_strict(out)
        assert {name: content[name] for name in own} == expected
        task = made[-1].task
        assert (task.goals, task.penalty_weight) == (expected["goals"], expected["penalty_weight"])
        assert made[-1].randomisation.latency == latency


@pytest.mark.parametrize(
    ("trained", "words", "expected"),
    [
        (True, [], "True"),
        (0.1, [], "0.1"),
        (True, ["--shield", "False"], None),
        (True, ["--shield", "0.104"], "0.104"),
        (False, ["--shield"], "True"),
        (False, [], None),
    ],
)
def test_the_shield_is_the_policys_unless_another_is_given(trained, words, expected, run, tmp_path):
    shutil.copytree(run, tmp_path / "run")
    path, out = tmp_path / "run" / "best.json", tmp_path / "out.json"
    content = json.loads(path.read_text()) | {"env_options": {"shield": trained}}
    path.write_text(json.dumps({**content, "sha256": digest(content)}))
    words = [*words, "--engine", "analytic", "--episodes", "1", "--json", str(out)]
    main(["evaluate", *words, "--policy", str(path)])
    assert read_strict(out)["env_options"].get("shield") == expected
    if trained is True and not expected:
        both = (str(path), "TPMReach-v0")
        with pytest.raises(ConfigError, match=r"in shield: True .*, False .*, as in --shield True"):
            evaluate(EvaluationConfig(both, episodes=1), quiet())


def test_an_exported_policy_goes_by_any_of_its_names(run):
    found = [returns(run / name) for name in ("best.json", "best.safetensors", "best", ".")]
    assert found == [found[0]] * 4


def test_an_archive_is_not_unpickled(run, tmp_path, monkeypatch):
    import torch

    def refuse(*args, **kwargs):
        raise AssertionError("unpickled")

    for owner, name in ((pickle, "load"), (pickle, "loads"), (torch, "load")):
        monkeypatch.setattr(owner, name, refuse)
    assert returns(run / "best.json")
    with pytest.raises(PolicyError, match=r"holds pickles.*tpm-gym export.*--trust-pickle"):
        returns(run / "best.zip")


def test_an_exported_policy_that_is_of_another_task_or_damaged_is_refused(run, tmp_path):
    with pytest.raises(PolicyError, match=r"was trained with observation space .*TPMReach-v0"):
        returns(run / "best.json", env="TPMPickAndPlace-v0")
    (tmp_path / "best.json").write_bytes((run / "best.json").read_bytes())
    (tmp_path / "best.safetensors").write_bytes(b"")
    with pytest.raises(PolicyError, match=r"is not a policy file: .* \(0 of \d+ bytes\)"):
        returns(tmp_path)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("evaluate --policy expert --env Nope-v0", "unknown environment 'Nope-v0'"),
        ("view --machine nothing", "machine = 'nothing' is not possible"),
    ],
)
def test_command_line_errors_are_one_line(words, message):
    with pytest.raises(SystemExit) as caught:
        main(words.split())
    assert str(caught.value).startswith(f"error: {message}")
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(sys.platform == "win32", reason="it has no such files")
def test_a_pipe_or_a_device_is_not_replaced_by_a_file(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(ConfigError, match=r"--json .*pipe: is a device or a pipe"):
        evaluate(EvaluationConfig(("expert",), "TPMReach-v0", json=pipe), quiet())
    assert pipe.is_fifo()


def test_files_are_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "result.json"
    provenance.write_json(path, {"value": 1})
    with pytest.raises(ValueError, match="not JSON compliant"):
        provenance.write_json(path, {"value": float("nan")})

    def fail(part):
        part.write_text("half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        provenance.write_whole(path, fail)
    assert read_strict(path) == {"value": 1}
    assert [entry.name for entry in tmp_path.iterdir()] == ["result.json"]


def test_a_link_stays_and_its_target_is_written(tmp_path):
    link, target = tmp_path / "link.json", tmp_path / "elsewhere" / "target"
    link.symlink_to(target)
    for value in (1, 2):  # the target is missing, then it is there
        provenance.require_writable("--json", link)
        provenance.write_json(link, {"value": value})
        assert link.readlink() == target
        assert read_strict(target) == {"value": value}


HALF = """
import sys, time
from tpm_gym.learning import command_line, provenance
def evaluate(config):
    provenance.write_whole(config.json, lambda part: (part.write_text("half"), time.sleep(60)))
command_line.evaluate = evaluate
command_line.main(["evaluate", "--policy", "expert", "--json", sys.argv[1]])
"""


def test_a_command_that_is_terminated_leaves_no_part_of_a_file(tmp_path):
    command = [PYTHON, "-c", HALF, tmp_path / "out.json"]
    status, output = signalled(command, lambda: any(tmp_path.iterdir()), signal.SIGTERM)
    assert (status, output) == (143, "")
    assert not any(tmp_path.iterdir())


def test_command_keeps_no_folder_outside(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    installed = str(tmp_path.parent / "bin" / "tpm-gym")
    assert provenance.command_line([installed, "resume", "x"]) == "tpm-gym resume x"
    inside, outside = tmp_path / "runs" / "a b", tmp_path.parent / "elsewhere" / "x.json"
    words = ["train/train.py", "--run", str(inside), f"--json={outside}", "--seed", "3"]
    expected = "python train/train.py --run 'runs/a b' --json=x.json --seed 3"
    assert provenance.command_line(words) == expected


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_the_commit_of_a_checkout_that_only_surrounds_the_package_is_not_recorded(
    tmp_path, monkeypatch
):
    installed = tmp_path / ".venv" / "provenance.py"
    installed.parent.mkdir()
    installed.touch()
    (tmp_path / "theirs").touch()
    who = ["-c", "user.name=me", "-c", "user.email=me@example.com"]
    for words in (["init", "-q"], ["add", "theirs"], [*who, "commit", "-qm", "theirs"]):
        subprocess.run(["git", "-C", str(tmp_path), *words], check=True)
    monkeypatch.setattr(provenance, "__file__", str(installed))
    assert provenance.git_commit() is None
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "theirs"))
    assert len(provenance.git_commit() or "") == 40
