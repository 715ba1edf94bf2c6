"""What a study has left to do, and that it does it whatever dies or stops on the way."""

import json
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest
from processes import PYTHON, TPM_GYM, printed_by, signalled
from trainings import PPO_RECIPE, SAC_RECIPE, assert_equal_runs, without_times

import tpm_gym
from tpm_gym.errors import ConfigurationError
from tpm_gym.learning.command_line import main
from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.report.records import condense
from tpm_gym.learning.run_folder import claimed
from tpm_gym.learning.study import (
    Bisection,
    Run,
    StudyConfig,
    execute,
    execute_there,
    plan_runs,
    run_all,
)

# -- the plan -------------------------------------------------------------------------------------


def test_plans_have_every_recipe_and_seed(tmp_path: Path) -> None:
    planned = plan_runs(StudyConfig("results", folder=tmp_path))
    scratch = [run for run in planned if "--demonstrations 0" in " ".join(run.options)]
    assert len(scratch) == 3 * 5  # pick-and-place with SAC
    assert len(planned) == (5 + 2) * 5 + len(scratch)
    assert len({run.folder for run in planned}) == len(planned)
    weighted = plan_runs(StudyConfig("penalty", folder=tmp_path, engine="analytic"))
    assert {run.env for run in weighted} == {env for env in tpm_gym.ENV_IDS if "Dense" in env}
    assert len(weighted) == 4 * 2 * 5
    assert all("--goals" in run.options for run in weighted)
    longer = plan_runs(StudyConfig("penalty", folder=tmp_path, engine="analytic", steps=70_000))
    assert not {run.folder for run in longer} & {run.folder for run in weighted}
    assert all("--steps 70000" in " ".join(run.left()[0]) for run in longer)
    bisections = plan_runs(StudyConfig("robustness", folder=tmp_path))
    assert len(bisections) == 10 + 10 + 8  # without a puck there are no mass and friction of it
    assert len({run.folder for run in bisections}) == len(bisections)


@pytest.mark.parametrize("plan", ["results", "penalty", "robustness"])
def test_what_differs_by_its_engine_alone_is_kept_apart(plan: Any, tmp_path: Path) -> None:
    one, other = (
        {run.folder for run in plan_runs(StudyConfig(plan, folder=tmp_path, engine=engine))}
        for engine in ("analytic", "pybullet")
    )
    assert not one & other


def test_what_is_learned_in_closed_form_is_tested_there_and_in_pybullet(tmp_path: Path) -> None:
    """In both as configured, with goals that tempt too; the record says which is which."""
    config = StudyConfig(
        "penalty", folder=tmp_path, engine="analytic", seeds=1, episodes=4, pybullet_episodes=3
    )
    (run, _) = plan_runs(replace(config, envs=("TPMReachDense-v0",)))
    recipe = tmp_path / "ppo.yml"
    recipe.write_text(PPO_RECIPE.format(env=run.env, envs=3), encoding="utf-8")
    words = ("--recipe", str(recipe), "--steps", "240", "--eval-episodes", "2")
    run = replace(run, options=(*run.options, *words))
    assert execute(run) is None, run.folder.with_suffix(".log").read_text()
    assert run.left() == []
    for engine, episodes in (("analytic", 4), ("pybullet", 3)):
        test = json.loads((run.folder / "tests" / f"{engine}.json").read_text())
        assert (test["episodes"], test["goals"]) == (episodes, "tempting")
        assert test["env_options"] == {"engine": engine}
        # Whatever the weight in training, returns are comparable.
        assert test["penalty_weight"] == 1.0
    kept = condense(run.folder)
    assert (kept["engine"], kept["penalty_weight"], kept["goals"]) == ("analytic", 0.0, "tempting")


@pytest.mark.parametrize(
    ("message", "plan", "options"),
    [
        ("--envs Nope: leaves no recipe of the plan; the default", "results", {"envs": ("Nope",)}),
        (
            "--envs TPMReachDense-v0: leaves no published",
            "robustness",
            {"envs": ["TPMReachDense-v0"]},
        ),
        ("--steps 0", "results", {"steps": 0}),
        ("--seeds 0", "results", {"seeds": 0}),
        ("engine = 'bullet'", "robustness", {"engine": "bullet"}),
    ],
)
def test_plans_that_cannot_be_are_refused(message: str, plan: Any, options: Any) -> None:
    with pytest.raises((ConfigError, ConfigurationError), match=message):
        plan_runs(StudyConfig(plan, **options))


def test_what_is_done_is_skipped_and_what_was_stopped_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--envs", "TPMReach-v0", "--algos", "sac", "--seeds", "1", "--episodes", "7"]
    words = ["study", "--plan", "results", *words, "--folder", str(tmp_path), "--dry-run"]

    def left() -> list[str]:
        main(words)
        return capsys.readouterr().out.split("\n")[:-1]

    run = tmp_path / "TPMReach-v0-sac-pybullet-s0"
    done = run / "tests" / "pybullet.json"
    test = f"tpm-gym evaluate --policy {run} --env TPMReach-v0 --episodes 7"
    test += f" --engine pybullet --json {done}"
    first = "tpm-gym train --env TPMReach-v0 --algo sac --engine pybullet --test-episodes 0"
    first += f" --seed 0 --run {run}"
    assert left() == [first, test]
    run.mkdir()
    (run / "config.json").write_text('{"steps": 100}')
    (run / "evaluations.jsonl").write_text('{"steps": 60}\n{"steps": 100, "wa')
    assert left() == [f"tpm-gym resume {run}", test]
    (run / "evaluations.jsonl").write_text('{"steps": 100}\n')
    (run / "last.zip").write_text("")
    assert left() == [test]
    done.parent.mkdir()
    done.write_text('{"episodes": 10}')
    assert left() == [test]
    done.write_text('{"episodes": 7}')
    assert left() == [""]


# -- running --------------------------------------------------------------------------------------


@pytest.mark.parametrize("program", [list(sys.argv), ["another"]])
def test_a_training_that_fails_is_told(
    program: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", program)
    failing = Run(tmp_path / "runs" / "b", "TPMReach-v0", "sac", ("--steps", "0"), ())
    assert "failed with status 1" in (execute(failing) or "")
    assert "--steps 0" in (tmp_path / "runs" / "b.log").read_text()
    assert sys.argv == program


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such locks")
def test_a_training_that_outlives_its_node_is_waited_for(tmp_path: Path) -> None:
    run = Run(tmp_path / "run", "TPMReach-v0", "sac", (), ())
    run.folder.mkdir()
    (run.folder / "config.json").write_text("{}")
    with ExitStack() as other:
        other.enter_context(claimed(run.folder))
        threading.Timer(0.5, other.close).start()
        assert "tpm-gym resume" in (execute(run) or "")
    said = run.folder.with_suffix(".log").read_text()
    assert "holds no run of tpm_gym" in said
    assert "another process" not in said


def test_without_ray_the_extra_is_named(tmp_path: Path) -> None:
    printed_by(
        PYTHON,
        "-c",
        "import sys; sys.modules['ray'] = None\n"
        "from tpm_gym.errors import MissingPackageError\n"
        "from tpm_gym.learning.study import StudyConfig, study\n"
        "try: study(StudyConfig('robustness'))\n"
        "except MissingPackageError as error: assert '[cluster]' in str(error)\n"
        "else: sys.exit('went on')\n",
        cwd=tmp_path,
    )


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nowhere"])
def test_an_address_without_a_cluster_is_refused(address: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"--address {address}: no cluster answers"):
        run_all([], StudyConfig("results", folder=tmp_path, address=address))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("missing", ["folder", "file"])
def test_a_node_that_does_not_share_the_disk_is_told(missing: str, tmp_path: Path) -> None:
    here = Path.cwd() if missing == "file" else tmp_path / "missing"
    run = Run(tmp_path / "run", "TPMReach-v0", "sac", (), ())
    assert "does not see" in (execute_there(run, here, tmp_path / "missing") or "")
    assert list(tmp_path.iterdir()) == []


def small(folder: Path, seed: int) -> Run:
    """A training of seconds, with a checkpoint every few moments."""
    recipe = folder / "sac.yml"
    recipe.write_text(SAC_RECIPE.format(env="TPMReach-v0", train_freq=20), encoding="utf-8")
    words = ["--recipe", str(recipe), "--seed", str(seed), "--steps", "2000"]
    words += ["--eval-every", "1000", "--eval-episodes", "2", "--checkpoint-every", "50"]
    test = ("pybullet", 2, ())
    return Run(folder / f"run-s{seed}", "TPMReach-v0", "sac", tuple(words), (test,))


def newest(run: Run) -> int:
    """Step of the last checkpoint of a run."""
    names = [path.name for path in run.folder.glob("checkpoints/*")]
    return max((int(name) for name in names if name.isdigit()), default=-1)


def temporary() -> set[Path]:
    return {*Path("/tmp").glob("tpm-*"), *Path("/tmp").glob("ray*"), *Path.home().glob(".ray/*")}


@pytest.mark.slow
def test_a_study_of_one_machine_runs_all_and_leaves_nothing_behind(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = temporary()
    bisection = Bisection(tmp_path / "bisection", "TPMReach-v0", "latency", 2)
    failing = Run(tmp_path / "failing", "TPMReach-v0", "sac", ("--steps", "0"), ())
    assert run_all([failing, bisection], StudyConfig("results", folder=tmp_path)) == 1
    printed = capsys.readouterr().out.splitlines()
    assert f"{bisection.folder}: done" in printed
    assert any(line.startswith(f"{failing.folder}: failed with status 1") for line in printed)
    assert {"0", "5"} <= {path.stem for path in bisection.folder.glob("tests/*")}
    assert bisection.left() == []
    names = ["bisection", "bisection.log", "failing.log"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert temporary() == before


@pytest.mark.slow
def test_ctrl_c_stops_a_study_with_checkpoints_saved(tmp_path: Path) -> None:
    """As a terminal sends it: to the whole process group; a second signal would kill trainings."""
    before = temporary()
    words = ["--plan", "results", "--envs", "TPMReach-v0", "--algos", "sac", "--seeds", "2"]
    words = [*TPM_GYM, "study", *words, "--folder", str(tmp_path), "--jobs", "1"]
    run = tmp_path / "TPMReach-v0-sac-pybullet-s0"
    status, output = signalled(words, lambda: list(run.glob("checkpoints/0*")), signal.SIGINT)
    assert status == 1, output
    assert f"{run}: stopped: tpm-gym train --env TPMReach-v0" in output
    assert "2 runs failed or were stopped" in output
    log = run.with_suffix(".log").read_text(encoding="utf-8")
    assert "stopped early by SIGINT, saved at step" in log
    assert (run / "last.zip").is_file()
    assert not (tmp_path / "TPMReach-v0-sac-pybullet-s1").exists()
    assert temporary() == before


# -- what dies ------------------------------------------------------------------------------------


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Two nodes of one CPU each."""
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    with tempfile.TemporaryDirectory(prefix="tpm-", dir="/tmp") as folder:
        monkeypatch.setenv("RAY_TMPDIR", folder)
        from ray.cluster_utils import Cluster

        options = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": 80 << 20}
        found = Cluster(True, head_node_args=options)
        found.add_node(**options)
        yield found
        found.shutdown()


def kill_worker(node: Any) -> None:
    """Kill the process of a node that trains."""
    (worker,) = [child for child in children(node) if child.name().startswith("ray::execute")]
    worker.kill()


def kill_node(node: Any) -> None:
    """Kill all processes of a node at once, as a power cut does."""
    for process in [*children(node), raylet(node)]:
        process.kill()


def raylet(node: Any) -> psutil.Process:
    return psutil.Process(node.all_processes["raylet"][0].process.pid)


def children(node: Any) -> list[psutil.Process]:
    return raylet(node).children(recursive=True)


def record(run: Run) -> Any:
    """What is kept of a run, without clocks, and without how often it went on."""
    kept = without_times(condense(run.folder))
    for test in kept["tests"].values():
        del test["steps_per_second"]
    return {name: value for name, value in kept.items() if name != "resumed"}


@pytest.mark.slow
@pytest.mark.parametrize("kill", [kill_worker, kill_node])
def test_a_death_midway_costs_what_came_after_the_last_checkpoint(
    kill: Callable[[Any], None], cluster: Any, tmp_path: Path
) -> None:
    (tmp_path / "undisturbed").mkdir()
    undisturbed = [small(tmp_path / "undisturbed", seed) for seed in range(2)]
    for run in undisturbed:
        assert execute(run) is None
    (tmp_path / "disturbed").mkdir()
    runs = [small(tmp_path / "disturbed", seed) for seed in range(2)]
    reached = []

    def kill_midway() -> None:
        while min(map(newest, runs)) < 100:
            time.sleep(0.01)
        (node,) = cluster.worker_nodes
        kill(node)
        reached.extend(map(newest, runs))

    killer = threading.Thread(target=kill_midway)
    killer.start()
    config = StudyConfig("results", folder=tmp_path, address=cluster.address)
    assert run_all(runs, config) == 0
    killer.join()
    assert max(reached) < 2000
    resumed = [condense(run.folder)["resumed"] for run in runs]
    assert sorted(resumed) == [0, 1]
    hit = runs[resumed.index(1)]
    from_step = json.loads((hit.folder / "config.json").read_text())["resumed"][0]["from_step"]
    assert from_step == reached[resumed.index(1)]
    for run, other in zip(runs, undisturbed, strict=True):
        assert record(run) == record(other)
        assert_equal_runs(run.folder, other.folder)
