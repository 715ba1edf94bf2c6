"""Studies survive deaths and stops, and the page of results agrees with the records."""

import importlib
import json
import re
import signal
import sys
import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from paths import ROOT
from processes import PYTHON, signalled
from studies import benchmark
from studies.__main__ import main
from studies.bisection import ends, halving, nominal
from studies.figures import learning_curves, penalty, robustness
from studies.page import BENCHMARK, ENGINES, PAGE, RUNS, Write, every_run, page, split, write
from studies.plan import Bisection, Run, Study, plan_runs
from studies.records import RECORDS, Collect, collect, condense, read_records
from studies.reliability import interquartile_mean, profile
from studies.running import execute, run_all
from trainings import PPO_RECIPE

import tpm_gym
from tpm_gym.errors import ConfigurationError, MissingPackageError
from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.run_folder import claimed
from tpm_gym.simulation.randomisation import LIMITS, Randomisation

COMMAND = (PYTHON, "-m", "benchmarks.studies", "run")


def test_a_missing_package_is_named_with_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    monkeypatch.delitem(sys.modules, "studies.page")
    with pytest.raises(MissingPackageError, match=r"needs pandas, .*'tpm-gym\[studies\]'"):
        importlib.import_module("studies.page")


# -- the plan -------------------------------------------------------------------------------------


def test_plans_have_every_recipe_and_seed(tmp_path):
    planned = plan_runs(Study("results", folder=tmp_path))
    scratch = [run for run in planned if "--demonstrations 0" in " ".join(run.options)]
    assert len(scratch) == 3 * 5  # pick-and-place with SAC
    assert len(planned) == (5 + 2) * 5 + len(scratch)
    weighted = plan_runs(Study("penalty", folder=tmp_path, engine="analytic"))
    dense = [env for env in tpm_gym.ENV_IDS if "Dense" in env]
    assert {run.env for run in weighted} == {env for env in dense if re.search("Reach|Pick", env)}
    assert len(weighted) == 4 * 2 * 5
    assert all("--goals" in run.options for run in weighted)
    machines = plan_runs(Study("machines", folder=tmp_path, engine="analytic", seeds=2))
    assert [run.options[-1] for run in machines] == ["wide", "delta"] * 2
    longer = plan_runs(Study("penalty", folder=tmp_path, engine="analytic", steps=70_000))
    assert all("--steps 70000" in " ".join(run.left()[0]) for run in longer)
    bisections = plan_runs(Study("robustness", folder=tmp_path))
    assert len(bisections) == 10 + 10 + 8  # without a block there are no mass and friction of it
    elsewhere = plan_runs(Study("results", folder=tmp_path, engine="analytic"))
    runs = [*planned, *weighted, *machines, *longer, *bisections, *elsewhere]
    assert len({run.folder for run in runs}) == len(runs)


@pytest.mark.parametrize(
    ("message", "plan", "options"),
    [
        ("--envs Nope: leaves no recipe of the plan; the default", "results", {"envs": ("Nope",)}),
        ("--envs No: leaves no published", "robustness", {"envs": ["No"]}),
        ("--steps 0", "results", {"steps": 0}),
        ("engine = 'bullet'", "robustness", {"engine": "bullet"}),
    ],
)
def test_plans_that_cannot_be_are_refused(message, plan, options):
    with pytest.raises((ConfigError, ConfigurationError), match=message):
        plan_runs(Study(plan, **options))


def test_what_is_done_is_skipped_and_what_was_stopped_goes_on(tmp_path, capsys):
    words = ["--envs", "TPMReach-v0", "--algos", "sac", "--seeds", "1", "--episodes", "7"]
    words = ["run", "--plan", "results", *words, "--folder", str(tmp_path), "--dry-run"]

    def left():
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


def tiny(plan: Any, folder: Path, seeds: int = 1) -> list[Run]:
    """Execute the first runs of a plan for Reach, with a tiny recipe."""
    study = Study(plan, "analytic", ("TPMReachDense-v0",), seeds=seeds, episodes=4, folder=folder)
    recipe = folder / "ppo.yml"
    recipe.write_text(PPO_RECIPE.format(env="TPMReachDense-v0", envs=3), encoding="utf-8")
    words = ("--recipe", str(recipe), "--steps", "240", "--eval-episodes", "2")
    small = [
        replace(planned, options=(*planned.options, *words))
        for planned in plan_runs(replace(study, pybullet_episodes=3))[:seeds]
    ]
    for planned in small:
        assert execute(planned) is None, planned.folder.with_suffix(".log").read_text()
    return small


@pytest.fixture(scope="module")
def run(needs_pybullet, tmp_path_factory):
    """Execute a run of the penalty plan."""
    return tiny("penalty", tmp_path_factory.mktemp("study"))[0]


def test_a_run_is_tested_in_both_engines_and_its_record_says_what_its_files_say(run):
    assert run.left() == []
    kept = condense(run.folder)
    assert (kept["engine"], kept["penalty_weight"], kept["goals"]) == ("analytic", 0.0, "tempting")
    assert (kept["finished"], kept["reached"]) == (True, 240)
    lines = (run.folder / "evaluations.jsonl").read_text(encoding="utf-8").splitlines()
    returns = [json.loads(line)["return"]["mean"] for line in lines]
    assert kept["evaluations"]["return"] == pytest.approx(returns, abs=1e-6)
    for engine, episodes in (("analytic", 4), ("pybullet", 3)):
        test = json.loads((run.folder / "tests" / f"{engine}.json").read_text())
        assert (test["episodes"], test["goals"]) == (episodes, "tempting")
        # Whatever the weight in training, returns are comparable.
        assert test["penalty_weight"] == 1.0
        for name in ("success_at_end", "conditioning_min", "unsafe_share", "command"):
            assert kept["tests"][engine][name] == test[name]
        assert "records" not in kept["tests"][engine]
    assert str(run.folder.parent) not in json.dumps(kept)


@pytest.mark.parametrize("program", [list(sys.argv), ["another"]])
def test_a_training_that_fails_is_told(program, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", program)
    failing = Run(tmp_path / "runs" / "b", "TPMReach-v0", "sac", ("--steps", "0"), ())
    assert "failed with status 1" in (execute(failing) or "")
    assert "--steps 0" in (tmp_path / "runs" / "b.log").read_text()
    assert sys.argv == program


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such locks")
def test_a_training_that_outlives_its_node_is_waited_for(tmp_path):
    run = Run(tmp_path / "run", "TPMReach-v0", "sac", (), ())
    run.folder.mkdir()
    (run.folder / "config.json").write_text("{}")
    with ExitStack() as other:
        other.enter_context(claimed(run.folder))
        threading.Timer(0.5, other.close).start()
        assert "tpm-gym resume" in (execute(run) or "")
    assert "another process" not in run.folder.with_suffix(".log").read_text()


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nowhere"])
def test_an_address_without_a_cluster_is_refused(address, tmp_path):
    with pytest.raises(ConfigError, match=f"--address {address}: no cluster answers"):
        run_all([], Study("results", folder=tmp_path, address=address))
    assert list(tmp_path.iterdir()) == []


def temporary() -> set[Path]:
    return {*Path("/tmp").glob("tpm-*"), *Path("/tmp").glob("ray*"), *Path.home().glob(".ray/*")}


@pytest.mark.slow
def test_a_study_of_one_machine_runs_all_and_leaves_nothing_behind(tmp_path, capsys):
    before = temporary()
    bisection = Bisection(tmp_path / "bisection", "TPMReach-v0", "latency", 2)
    failing = Run(tmp_path / "failing", "TPMReach-v0", "sac", ("--steps", "0"), ())
    assert run_all([failing, bisection], Study("results", folder=tmp_path)) == 1
    printed = capsys.readouterr().out.splitlines()
    assert f"{bisection.folder}: done" in printed
    assert any(line.startswith(f"{failing.folder}: failed with status 1") for line in printed)
    assert bisection.left() == []
    names = ["bisection", "bisection.log", "failing.log"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert temporary() == before


@pytest.mark.slow
def test_nobody_else_can_reach_a_study_and_a_killed_one_leaves_nothing_behind(tmp_path):
    before = temporary()
    words = ["--plan", "robustness", "--envs", "TPMReach-v0", "--folder", tmp_path, "--jobs", "1"]
    driver = psutil.Popen([*COMMAND, *map(str, words)], cwd=ROOT)
    try:
        while not list(tmp_path.glob("*.log")):  # Ray works
            assert driver.is_running()
            time.sleep(0.1)
        (folder,) = temporary() - before
        processes = [driver, *driver.children(recursive=True)]
        listening = {
            connection.laddr.ip.removeprefix("::ffff:")
            for process in processes
            for connection in process.net_connections()
            if connection.status == psutil.CONN_LISTEN
        }
        assert listening == {"127.0.0.1"}
        assert folder.stat().st_mode & 0o777 == 0o700
    finally:
        driver.kill()
        driver.wait()
    latest = time.monotonic() + 60
    while folder.exists():
        assert time.monotonic() < latest
        time.sleep(0.1)


@pytest.mark.slow
def test_ctrl_c_stops_a_study_with_checkpoints_saved(tmp_path):
    """A terminal sends SIGINT to the whole process group; a second signal would kill trainings."""
    before = temporary()
    words = ["--plan", "results", "--envs", "TPMReach-v0", "--algos", "sac", "--seeds", "2"]
    words = [*COMMAND, *words, "--folder", str(tmp_path), "--jobs", "1"]
    run = tmp_path / "TPMReach-v0-sac-pybullet-s0"
    checkpoints = partial(run.glob, "checkpoints/0*")
    status, output = signalled(words, lambda: list(checkpoints()), signal.SIGINT, cwd=ROOT)
    assert status == 1, output
    assert f"{run}: stopped: tpm-gym train --env TPMReach-v0" in output
    assert "2 runs failed or were stopped" in output
    log = run.with_suffix(".log").read_text(encoding="utf-8")
    assert "stopped early by SIGINT, saved at step" in log
    assert (run / "last.zip").is_file()
    assert not (tmp_path / "TPMReach-v0-sac-pybullet-s1").exists()
    assert temporary() == before


# -- records --------------------------------------------------------------------------------------


def test_a_run_that_broke_off_is_collected_as_far_as_it_was_saved(run, tmp_path):
    config = json.loads((run.folder / "config.json").read_text())
    early, late = (tmp_path / "runs" / name for name in ("early", "late"))
    for folder in (early, late):
        folder.mkdir(parents=True)
        (folder / "config.json").write_text(json.dumps(config))
    (early / "checkpoints").mkdir()
    (early / "checkpoints" / "000000200.checkpoint").write_bytes(b"")
    # The disk was full.
    (late / "evaluations.jsonl").write_text('{"steps": 60, "wall_seconds": 1.0}\n{"steps": 70, "w')

    def collected():
        return [json.loads(p.read_text()) for p in collect(Collect(tmp_path / "runs", tmp_path))]

    records = collected()
    assert [record["run"] for record in records] == ["early", "late"]
    assert [record["finished"] for record in records] == [False, False]
    assert [record["reached"] for record in records] == [200, 60]
    assert records == collected()
    text = every_run([r | {"goals": "sampled", "penalty_weight": 1.0} for r in records])
    assert "stopped after 200 of 240 steps" in text
    assert "stopped after 60 of 240 steps" in text
    (late / "evaluations.jsonl").write_text("{\n")
    with pytest.raises(ConfigError, match="late: its evaluations are damaged"):
        collected()
    (early / "config.json").write_text(json.dumps({**config, "env_options": {"machine": "wide"}}))
    with pytest.raises(ConfigError, match=r"early: was made with .*wide"):
        collected()


def test_files_of_others_are_not_replaced(run, tmp_path):
    records, by_hand = tmp_path / "results", tmp_path / "results.md"
    main(["collect", "--runs", str(run.folder.parent), "--to", str(records)])
    by_hand.write_text("# Results\n\nMy own.\n")
    with pytest.raises(SystemExit, match="was written by hand"):
        main(["write", "--records", str(records), "--page", str(by_hand)])
    assert by_hand.read_text() == "# Results\n\nMy own.\n"
    assert not (tmp_path / "images").exists()
    by_hand.unlink()
    written = write(Write(records, by_hand))
    names = ["results.md", RUNS, BENCHMARK, "results_penalty.png"]
    assert [path.name for path in written] == names
    before = [path.read_bytes() for path in written]
    main(["write", "--records", str(records), "--page", str(by_hand)])
    assert [path.read_bytes() for path in written] == before
    (record,) = records.iterdir()
    record.write_text('{"mine": 1}')
    with pytest.raises(ConfigError, match=r"json is no record: it lacks engine, env"):
        collect(Collect(run.folder.parent, records))
    assert record.read_text() == '{"mine": 1}'


# -- the page -------------------------------------------------------------------------------------

EXAMPLE = json.loads((ROOT / RECORDS / "TPMReach-v0-sac-analytic-s0.json").read_text())
DEMONSTRATED = EXAMPLE["recipe"] | {"demonstrations": {"episodes": 3}}


def changed(seed: int, rate: float | None, **changes: Any) -> Any:
    """Return a record with three evaluations and a success rate; None: it was stopped."""
    new = json.loads(json.dumps(EXAMPLE)) | {"seed": seed, "run": f"run-s{seed}"}
    new["evaluations"] = {"steps": [0, 60, 120], "wall_seconds": [0.0, 30.0, 60.0]}
    new |= {"steps": 120, "engine": "pybullet"}
    if rate is None:
        return new | {"tests": {}, "finished": False} | changes
    for test in new["tests"].values():
        test["success_at_end"] = {"mean": rate, "low": rate - 0.01, "high": rate + 0.01}
    new["evaluations"]["success_at_end"] = [0.0, rate, rate]
    return new | changes


def tempting(seed: int, weight: float, **changes: Any) -> Any:
    record = changed(seed, 1.0, goals="tempting", penalty_weight=weight, **changes)
    record["tests"]["pybullet"]["unsafe_share"] = {"mean": 0.4 - 0.3 * weight + 0.02 * seed}
    return record


def rows(text: str, *words: str) -> list[str]:
    """Return the rows of tables that hold all words."""
    return [
        line for line in text.splitlines() if line[0:1] == "|" and all(w in line for w in words)
    ]


def test_the_page_is_what_its_records_say():
    text = (ROOT / PAGE).read_text(encoding="utf-8")
    figures = [name for name in ("results_penalty.png", "results_robustness.png") if name in text]
    assert page(read_records(ROOT / RECORDS), ["results_learning_curves.png", *figures]) == text
    texts = {RUNS: every_run, BENCHMARK: partial(benchmark.page, figures=[benchmark.PICTURE])}
    for name, written in texts.items():
        assert written(read_records(ROOT / RECORDS)) == (ROOT / PAGE).with_name(name).read_text()


@pytest.mark.parametrize(
    ("other", "labels"),
    [
        ({"steps": 999}, ["SAC + HER, 120 steps", "SAC + HER, 999 steps"]),
        ({"engine": "mujoco"}, ["SAC + HER, PyBullet", "SAC + HER, mujoco"]),
        ({"recipe": DEMONSTRATED}, ["SAC + HER", "SAC + HER, demonstrations"]),
    ],
)
def test_runs_that_differ_are_told_apart_everywhere(other, labels):
    runs = [changed(0, 0.5), changed(0, 0.6, **other)]
    weighted = [tempting(s, w, **o) for s in range(2) for w in (0.0, 1.0) for o in ({}, other)]
    records = [*runs, *weighted]
    text = page(records, []) + every_run(records)
    for label in labels:
        assert len(rows(text, f"| {label} | 0 |")) == 1  # of every run
        assert f"{label}, seed 0: success" in text
        assert f"{label}: 41.00% without the penalty, 11.000% with it: 4 times less." in text
    curves = learning_curves(split(runs)[0])
    assert [line.get_label() for line in curves.axes[0].lines[:2]] == labels
    ticks = [t.get_text() for t in penalty(split(weighted)[1]).axes[0].get_xticklabels()]
    assert len(set(ticks)) == 4


def test_where_success_halves_can_be_read_from_the_axes_of_robustness():
    records = [record for record in read_records(ROOT / RECORDS) if "attribute" in record]
    panels = [axes for axes in robustness(records).axes if axes.get_visible()]
    assert len(panels) == 10
    for axes in panels:
        low, high = axes.get_xlim()
        ticks = [tick for tick in axes.get_xticks() if low <= tick <= high]
        steady = {line.get_ydata().min() > 0.5 for line in axes.lines[:-1]} == {True}
        assert len(ticks) >= (3 if steady else 5), axes.get_title()


# -- the benchmark --------------------------------------------------------------------------------


def test_the_benchmark_trains_each_id_once_a_seed_and_its_page_shows_every_run(
    needs_pybullet, tmp_path
):
    planned = plan_runs(benchmark.PLAN)
    assert len({(run.env, run.options) for run in planned}) == len(planned)
    assert {run.env for run in planned} >= {"TPMReach-v0", "TPMReachDense-v0", "TPMPush-v0"}
    runs = tiny("benchmark", tmp_path, seeds=2)
    assert {run.folder.name for run in runs} <= {run.folder.name for run in planned}
    records = [condense(run.folder) for run in runs]
    text = benchmark.page(records, [])
    rates = [[100 * r["tests"][e]["success_at_end"]["mean"] for r in records] for e in ENGINES]
    shown = [f"{np.mean(both):.1f} [{min(both):.1f}, {max(both):.1f}]" for both in rates]
    ids = "| TPMReachDense-v0 | PPO | 2 |"
    assert rows(text, ids, *(f"| {cell} |" for cell in shown), "never [never, never]")
    assert f"{len(planned) - 2} of {len(planned)} runs are not there yet." in text
    (path,) = benchmark.draw(records, tmp_path)
    assert path.stat().st_size > 10_000


@settings(max_examples=20)
@given(st.lists(st.lists(st.floats(0, 1), min_size=5, max_size=5), min_size=1, max_size=6))
def test_the_interquartile_mean_is_that_of_scipy(scores):
    found = interquartile_mean(scores)
    expected = scipy.stats.trim_mean(np.ravel(scores), 0.25)
    assert found.mean == pytest.approx(expected, abs=1e-12)
    assert found.low <= found.mean <= found.high


def test_intervals_are_those_of_a_bootstrap_stratified_by_task():
    scores = np.random.default_rng(0).random((6, 5)) ** 2 + np.arange(6)[:, None]

    def middle(*tasks, axis):
        return scipy.stats.trim_mean(np.concatenate(tasks, axis), 0.25, axis)

    expected = scipy.stats.bootstrap(
        tuple(scores), middle, n_resamples=20_000, method="percentile", rng=0
    ).confidence_interval
    found = interquartile_mean(list(scores))
    assert (found.low, found.high) == pytest.approx(tuple(expected), abs=0.02)
    # Resampled over all tasks together, the interval would be several times as wide.
    assert found.high - found.low < 0.5
    never = interquartile_mean([[1.0, 2.0, 3.0, np.inf]])
    assert (never.mean, never.high) == (2.5, np.inf)


def test_profiles_count_the_runs_that_reach_a_limit():
    share, low, high = profile([[0.2, 0.9], [1.0, 1.0]], [0.0, 0.5, 1.0])
    assert share.tolist() == [1.0, 0.75, 0.5]
    assert low.tolist() == [1.0, 0.5, 0.5]
    assert high.tolist() == [1.0, 1.0, 0.5]


# -- bisections -----------------------------------------------------------------------------------

ENDS = [(attribute, end) for attribute in LIMITS for end in ends(attribute)]
GRADUAL = [(attribute, end) for attribute, end in ENDS if attribute != "latency"]


def bisected(attribute: str, end: float, success: Any) -> tuple[Any, dict[float, float]]:
    """Bisect with every success asked for; return the result and all that were."""
    found: dict[float, float] = {}
    while (result := halving(attribute, end, found)).missing is not None:
        assert result.missing not in found
        found[result.missing] = success(result.missing)
    return result, found


@given(which=st.sampled_from(GRADUAL), share=st.floats(0.001, 0.999), rate=st.floats(0.3, 1.0))
def test_success_halves_where_the_bisection_says(which, share, rate):
    attribute, end = which
    start = nominal(attribute)
    edge = start + share * (end - start)

    def success(value):
        return rate if abs(value - start) < abs(edge - start) else 0.4 * rate

    result, found = bisected(attribute, end, success)
    assert success(result.before) > rate / 2 >= success(result.after)
    assert len(found) <= 2 + 6
    for value in found:
        Randomisation(**{attribute: value})
    way = np.abs([start, result.before, result.after, end])
    way = np.log(way) if start else way
    assert (way[2] - way[1]) / (way[3] - way[0]) == pytest.approx(1 / 64, rel=0.2)
