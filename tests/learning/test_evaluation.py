"""An evaluation writes what it promises: a table, strict JSON and a video, without torch."""

from __future__ import annotations

import json
import pickle
import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v3 as imageio
import numpy as np
import pytest
from trainings import python, quiet, tpm_gym_command

from tpm_gym.errors import ConfigurationError
from tpm_gym.learning import EvaluationConfig, evaluate, evaluation, film, provenance
from tpm_gym.learning.errors import ConfigError, PolicyError
from tpm_gym.learning.policies import load_policy

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
STRAYS = 3
"""Seed of an episode in which random actions stray into the unsafe region."""


def read_strict(path: Path) -> dict[str, Any]:
    """Read JSON as a strict reader does: NaN and infinities are errors."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    content = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    assert isinstance(content, dict)
    return content


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], str]:
    """Return the JSON and the output of the command line, run on one policy."""
    path = tmp_path_factory.mktemp("evaluate") / "deep" / "er" / "expert.json"
    options = f"--policy expert --env TPMReach-v0 --episodes 4 --seed 7 --json {path}".split()
    done = tpm_gym_command("evaluate", *options)
    assert done.returncode == 0, done.stderr
    return read_strict(path), done.stdout


def test_one_policy_has_its_metrics_at_the_top(written: tuple[dict[str, Any], str]) -> None:
    content, _ = written
    for name in METRICS:
        estimate = content[name]
        assert estimate["low"] <= estimate["mean"] <= estimate["high"], name
    assert content["policy"] == "expert"
    assert (content["env"], content["episodes"], content["seed"]) == ("TPMReach-v0", 4, 7)
    assert content["wall_seconds"] > 0
    assert content["closure_error_max"]["worst"] >= content["closure_error_max"]["mean"]


def test_records_agree_with_the_metrics(written: tuple[dict[str, Any], str]) -> None:
    content, _ = written
    records = content["records"]
    assert [record["seed"] for record in records] == [7, 8, 9, 10]
    for name in METRICS:
        mean = sum(record[name] for record in records) / 4
        assert content[name]["mean"] == pytest.approx(mean), name
    steps = sum(record["length"] for record in records)
    assert content["steps_per_second"] == pytest.approx(steps / content["wall_seconds"])


def test_json_says_how_to_repeat_it(written: tuple[dict[str, Any], str]) -> None:
    content, _ = written
    assert content["versions"] == provenance.versions()
    assert {"numpy", "torch", "pybullet", "stable-baselines3"} <= set(content["versions"])
    assert "git_commit" in content
    words = "tpm-gym evaluate --policy expert --env TPMReach-v0 --episodes 4 --seed 7"
    assert content["command"].startswith(words)
    for folder in (Path.home(), Path(evaluation.__file__).parent):
        assert str(folder) not in json.dumps(content)


def test_table_shows_means_and_intervals(written: tuple[dict[str, Any], str]) -> None:
    _, output = written
    for shown in ("success at end", "expert", "[51.0, 100.0]"):  # Wilson interval of 4 of 4
        assert shown in output


def test_scripted_policies_do_not_load_torch(tmp_path: Path) -> None:
    program = (
        "import sys; from tpm_gym.learning import EvaluationConfig, evaluate\n"
        "config = EvaluationConfig(policy=('expert', 'random'), env='TPMReach-v0', episodes=1)\n"
        "evaluate(config)\n"
        "loaded = {'torch', 'stable_baselines3'} & set(sys.modules)\n"
        "sys.exit(f'loaded {loaded}' if loaded else 0)\n"
    )
    done = python("-c", program)
    assert done.returncode == 0, done.stderr


def test_several_policies_share_a_table_and_a_file(tmp_path: Path) -> None:
    path = tmp_path / "both.json"
    config = EvaluationConfig(
        policy=("random", "expert"), env="TPMReach-v0", episodes=2, json=path, seed=3
    )
    console = quiet()
    results = evaluate(config, console)
    content = read_strict(path)
    assert [entry["policy"] for entry in content["policies"]] == ["random", "expert"]
    assert content["policies"][1]["return"]["mean"] == results[1].metrics["return"].mean
    assert "return" not in content
    assert content["seed"] == 3
    header = console.file.getvalue().splitlines()[2]  # type: ignore[attr-defined]
    assert "random" in header
    assert "expert" in header


# imageio-ffmpeg leaves a pipe to the collector where ffmpeg ends before its reader is closed.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_video_shows_the_first_episodes(tmp_path: Path) -> None:
    path = tmp_path / "films" / "expert.mp4"
    config = EvaluationConfig(
        policy=("expert",), env="TPMReach-v0", episodes=2, video=path, video_episodes=1
    )
    (result,) = evaluate(config, quiet())
    frames = imageio.imread(path, plugin="FFMPEG")  # (frames, height, width, 3)
    assert len(frames) == result.records[0].length + 1
    assert frames[0].std() > 5  # something is to be seen
    assert (frames[0] != frames[-1]).any()  # and it moves
    assert imageio.immeta(path, plugin="FFMPEG")["fps"] == 25
    assert [entry.name for entry in path.parent.iterdir()] == ["expert.mp4"]


@pytest.mark.parametrize(
    ("policies", "names"),
    [
        (("expert",), ["v.mp4"]),
        (("expert", "random"), ["v-expert.mp4", "v-random.mp4"]),
        (("a/best.zip", "b/best.zip"), ["v-1-best.mp4", "v-2-best.mp4"]),
    ],
)
def test_every_policy_gets_its_own_video(policies: tuple[str, ...], names: list[str]) -> None:
    paths = evaluation.paths_per_policy(Path("films", "v.mp4"), policies)
    assert [path.name for path in paths] == names
    assert all(path.parent == Path("films") for path in paths)


def test_picture_shows_six_moments_of_the_first_episode(tmp_path: Path) -> None:
    path = tmp_path / "new" / "expert.png"
    config = EvaluationConfig(policy=("expert",), env="TPMReach-v0", episodes=1, picture=path)
    evaluate(config, quiet())
    env = gym.make("TPMReach-v0", render_mode="rgb_array")
    env.reset(seed=config.seed)
    first = env.render()
    env.close()
    picture = imageio.imread(path)
    height, width = first.shape[:2]
    assert picture.shape == (2 * height, 3 * width, 3)
    np.testing.assert_array_equal(picture[:height, :width], first)


@pytest.mark.parametrize(
    ("still", "sheet"),
    [(50, [[0, 10, 20], [30, 40, 50]]), (10, [[0, 2, 4], [6, 8, 10]]), (0, [[0, 0, 0]] * 2)],
)
def test_contact_sheet_runs_until_nothing_moves(still: int, sheet: list[list[int]]) -> None:
    frames = [np.full((1, 1, 3), min(value, still), np.uint8) for value in range(51)]
    assert film.contact_sheet(frames)[..., 0].tolist() == sheet
    assert film.contact_sheet(frames[:1]).shape == (2, 3, 3)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"episodes": 0}, ConfigError, "at least 1"),
        ({"video_episodes": 0}, ConfigError, "at least 1"),
        ({"seed": -1}, ConfigError, "at least 0"),
        ({"env": None}, ConfigError, "name one with --env"),
        ({"env": "TPMRech-v0"}, ConfigError, "TPMReach-v0"),
        ({"policy": ("expert", "gone.zip")}, PolicyError, "no file gone.zip"),
        ({"video": Path("film.xyz")}, ConfigError, "--video"),
        ({"picture": Path("still")}, ConfigError, "--picture"),
        ({"randomisation": ("puck_mass",)}, ConfigError, "--randomisation"),
        ({"randomisation": ("puck_mass=heavy",)}, ConfigError, "--randomisation"),
        ({"randomisation": ("=1",)}, ConfigError, "--randomisation"),
        ({"randomisation": ("a=1:2:3",)}, ConfigError, "--randomisation"),
        ({"randomisation": ("a=1", "a=2")}, ConfigError, "--randomisation"),
        ({"randomisation": ("puk_mass=2",)}, ConfigurationError, "puck_mass"),
        ({"penalty_weight": -1.0}, ConfigurationError, "penalty_weight"),
    ],
)
def test_mistakes_are_named(options: dict[str, Any], error: type[Exception], message: str) -> None:
    usual = {"policy": ("expert",), "env": "TPMReach-v0"}
    with pytest.raises(error, match=message):
        evaluate(EvaluationConfig(**{**usual, **options}), quiet())


def records_of(spec: str = "random", **options: Any) -> list[Any]:
    """Return the records of a few episodes, by default the random policy's on Reach."""
    config = EvaluationConfig(policy=(spec,), **{"env": "TPMReach-v0", "episodes": 2} | options)
    return evaluate(config, quiet())[0].records


def test_conditions_are_recorded_and_the_defaults_are_the_nominal_machine(
    written: tuple[dict[str, Any], str], tmp_path: Path
) -> None:
    content, _ = written
    assert (content["goals"], content["penalty_weight"]) == ("sampled", 1.0)
    assert content["randomisation"] == {}
    path = tmp_path / "other.json"
    words = ["--policy", "random", "--env", "TPMReach-v0", "--episodes", "1", "--json", str(path)]
    words += ["--randomisation", "encoder_noise=1e-4", "friction=0.5:1", "latency=1"]
    words += ["--penalty-weight", "0.5", "--goals", "tempting"]
    done = tpm_gym_command("evaluate", *words)
    assert done.returncode == 0, done.stderr
    content = read_strict(path)
    assert content["randomisation"] == {
        "encoder_noise": 1e-4,
        "friction": [0.5, 1.0],
        "latency": 1,
    }
    assert (content["goals"], content["penalty_weight"]) == ("tempting", 0.5)
    assert "--randomisation encoder_noise=1e-4 friction=0.5:1" in content["command"]


def test_the_environment_is_the_one_that_was_asked_for() -> None:
    config = EvaluationConfig(
        policy=("random",), goals="tempting", penalty_weight=0.25, randomisation=("puck_mass=2",)
    )
    env: Any = evaluation._make_env("TPMPickAndPlace-v0", config)
    assert env.unwrapped.task.penalty_weight == 0.25
    assert env.unwrapped.randomisation.puck_mass == (2.0, 2.0)
    plain = gym.make("TPMPickAndPlace-v0")
    goals = [made.reset(seed=3)[0]["desired_goal"] for made in (env, plain)]
    assert not np.array_equal(*goals)
    env.close()
    plain.close()


def test_encoder_noise_shows_in_the_observed_position() -> None:
    nominal, noisy = records_of(), records_of(randomisation=("encoder_noise=5e-4",))
    assert max(record.fk_error_max for record in nominal) < 1e-3
    assert all(
        noise.fk_error_max > 2 * none.fk_error_max
        for noise, none in zip(noisy, nominal, strict=True)
    )


def test_the_return_has_the_penalty_in_it_with_its_weight() -> None:
    once, twice, free = (
        records_of(penalty_weight=weight, seed=STRAYS, episodes=1)[0] for weight in (1.0, 2.0, 0.0)
    )
    assert once.unsafe_share == free.unsafe_share > 0
    penalty = free.total_reward - once.total_reward
    assert penalty > 0
    assert free.total_reward - twice.total_reward == pytest.approx(2 * penalty)


def test_per_step_figures_are_those_of_the_steps() -> None:
    env: Any = gym.make("TPMReach-v0")
    policy = load_policy("random", env)
    observation, _ = env.reset(seed=STRAYS)
    policy.reset(observation, STRAYS)
    unsafe, gaps, done = [], [], False
    while not done:
        observation, _, _, done, info = env.step(policy.act(observation))
        unsafe.append(info["conditioning"] < 0.08)
        state = env.unwrapped.state
        gaps.append(np.linalg.norm(state.fk_position - state.platform_position))
    env.close()
    (record,) = records_of(episodes=1, seed=STRAYS)
    assert 0 < record.unsafe_share == np.mean(unsafe) < 1
    assert record.fk_error_max == pytest.approx(max(gaps), rel=1e-12)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
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
    config = {"algo": "ppo", "env": "TPMReach-v0", "seed": 0, "recipe": {}}
    (folder / "config.json").write_text(json.dumps(config))
    return folder


def returns(policy: Path | str, **options: Any) -> list[float]:
    config = EvaluationConfig(policy=(str(policy),), episodes=1, **options)
    return [record.total_reward for record in evaluate(config, quiet())[0].records]


def test_an_exported_policy_goes_by_any_of_its_names(run: Path) -> None:
    """Its environment is the one it was trained on; it acts as the archive does."""
    trusted = returns(run / "best.zip", trust_pickle=True)
    for name in ("best.json", "best.safetensors", "best", "."):
        assert returns(run / name) == pytest.approx(trusted, abs=1e-3), name


def test_an_archive_is_not_unpickled_unless_it_is_trusted(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    def refuse(*args: Any, **kwargs: Any) -> None:
        raise AssertionError("unpickled")

    for name in ("best.zip", "config.json"):
        (tmp_path / name).write_bytes((run / name).read_bytes())
    with monkeypatch.context() as patched:
        for owner, name in ((pickle, "load"), (pickle, "loads"), (torch, "load")):
            patched.setattr(owner, name, refuse)
        assert returns(run / "best.json")
        for archive in (run / "best.zip", tmp_path):
            with pytest.raises(PolicyError, match=r"--trust-pickle.*tpm-gym export"):
                returns(archive)
    assert returns(tmp_path, trust_pickle=True)


def test_an_exported_policy_of_another_task_is_refused(run: Path) -> None:
    with pytest.raises(PolicyError, match=r"was trained with observation space .*TPMReach-v0"):
        returns(run / "best.json", env="TPMPickAndPlace-v0")


def test_a_damaged_policy_is_one_line(run: Path, tmp_path: Path) -> None:
    (tmp_path / "best.json").write_bytes((run / "best.json").read_bytes())
    (tmp_path / "best.safetensors").write_bytes((run / "best.safetensors").read_bytes()[:-1])
    done = tpm_gym_command("evaluate", "--policy", tmp_path / "best")
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    last = done.stderr.splitlines()[-1]  # the engine has introduced itself before
    assert last.startswith("error: policy ")
    assert re.search(r"damaged: \d+ of \d+ bytes", last)
    env = gym.make("TPMReach-v0")
    with pytest.raises(PolicyError, match="describes no policy"):
        load_policy(str(run / "config.json"), env)
    env.close()


def test_an_exported_policy_needs_no_stable_baselines(run: Path) -> None:
    program = (
        "import sys\n"
        "sys.modules['stable_baselines3'] = sys.modules['sb3_contrib'] = None\n"
        "from tpm_gym.learning import EvaluationConfig, evaluate\n"
        f"evaluate(EvaluationConfig(policy=({str(run / 'best')!r},), episodes=1))\n"
    )
    done = python("-c", program)
    assert done.returncode == 0, done.stderr


def test_command_line_errors_are_one_line() -> None:
    done = tpm_gym_command("evaluate", "--policy", "expert", "--env", "Nope-v0")
    assert done.returncode == 1
    assert done.stderr.startswith("error: unknown environment 'Nope-v0'")
    assert len(done.stderr.splitlines()) == 1


def test_files_are_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    provenance.write_json(path, {"value": 1})
    with pytest.raises(ValueError, match="not JSON compliant"):
        provenance.write_json(path, {"value": float("nan")})

    def fail(part: Path) -> None:
        part.write_text("half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        provenance.write_whole(path, fail)
    assert read_strict(path) == {"value": 1}
    assert [entry.name for entry in tmp_path.iterdir()] == ["result.json"]


def test_command_keeps_no_folder_outside(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    installed = str(tmp_path.parent / "bin" / "tpm-gym")
    assert provenance.command_line([installed, "resume", "x"]) == "tpm-gym resume x"
    inside, outside = tmp_path / "runs" / "a b", tmp_path.parent / "elsewhere" / "x.json"
    words = ["train/train.py", "--run", str(inside), f"--json={outside}", "--seed", "3"]
    expected = "python train/train.py --run 'runs/a b' --json=x.json --seed 3"
    assert provenance.command_line(words) == expected
