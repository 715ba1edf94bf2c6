"""The page of results says what the runs did: statistics by hand, and failures are kept."""

import itertools
import json
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest
from paths import ROOT
from trainings import SAC_RECIPE

from tpm_gym.learning.command_line import main
from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.estimates import median_time, settled
from tpm_gym.learning.report.figures import draw, learning_curves, penalty
from tpm_gym.learning.report.page import LEARNING_CURVES, PENALTY, ROBUSTNESS, STUDIES, command
from tpm_gym.learning.report.page import page as page_of
from tpm_gym.learning.report.records import (
    PAGE,
    RECORDS,
    Collect,
    Write,
    collect,
    condense,
    write,
)
from tpm_gym.learning.study import Run, execute, plan_runs

# -- statistics -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("successes", "index"),
    [
        ([0.0, 0.5, 0.95, 1.0], 2),
        ([0.0, 1.0, 0.9, 0.95], 3),  # what does not last does not count
        ([1.0, 1.0], 0),
        ([0.0, 1.0, 0.9], None),
        ([], None),
    ],
)
def test_success_has_settled_once_it_stays(successes: list[float], index: int | None) -> None:
    assert settled(successes) == index


def test_a_run_that_never_learned_is_later_than_any_other() -> None:
    assert median_time([300.0, 100.0, None, 200.0, None]) == 300.0
    assert median_time([None, 100.0, None]) is None


# -- from runs to the page ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny real run, trained and tested as a study does."""
    folder = tmp_path_factory.mktemp("study")
    recipe = folder / "sac.yml"
    recipe.write_text(SAC_RECIPE.format(env="TPMReach-v0", train_freq=20), encoding="utf-8")
    words = ("--recipe", str(recipe), "--steps", "120", "--eval-every", "60", "--eval-episodes")
    tests = (("pybullet", 2, ()),)
    run = Run(folder / "TPMReach-v0-sac-s0", "TPMReach-v0", "sac", (*words, "2"), tests)
    assert execute(run) is None, run.folder.with_suffix(".log").read_text()
    assert run.left() == []
    return folder


@pytest.fixture(scope="module")
def real(runs: Path) -> dict[str, Any]:
    return condense(runs / "TPMReach-v0-sac-s0")


def test_the_learning_curve_of_a_run_is_a_picture(runs: Path, real: dict[str, Any]) -> None:
    picture = imageio.imread(runs / real["run"] / "learning_curve.png")
    assert picture.shape[:2] == (768, 1152)
    colours = np.unique(picture[::7, ::7].reshape(-1, picture.shape[2]), axis=0)
    assert len(colours) > 50


def changed(record: dict[str, Any], seed: int, rate: float | None, **changes: Any) -> Any:
    """Return the record of another seed with a success rate, or of one that broke off."""
    new = json.loads(json.dumps(record)) | {"seed": seed, "run": f"run-s{seed}"} | changes
    if rate is None:
        return new | {"tests": {}, "finished": False}
    for test in new["tests"].values():
        test["success_at_end"] = {"mean": rate, "low": rate - 0.01, "high": rate + 0.01}
    new["evaluations"]["success_at_end"] = [0.0, rate, rate]
    return new


def rows(text: str, *words: str) -> list[str]:
    """Table rows that hold all words."""
    return [
        line for line in text.splitlines() if line[0:1] == "|" and all(w in line for w in words)
    ]


def test_a_record_is_compact_and_says_what_the_files_say(runs: Path, real: dict[str, Any]) -> None:
    run = runs / real["run"]
    lines = (run / "evaluations.jsonl").read_text(encoding="utf-8").splitlines()
    evaluations = [json.loads(line) for line in lines]
    assert real["finished"]
    assert (real["env"], real["algo"], real["seed"]) == ("TPMReach-v0", "sac", 0)
    assert (real["goals"], real["penalty_weight"]) == ("sampled", 1.0)
    assert real["evaluations"]["steps"] == [0, 60, 120]
    curve = real["evaluations"]["return"]
    assert curve == pytest.approx([entry["return"]["mean"] for entry in evaluations], abs=1e-6)
    test = json.loads((run / "tests" / "pybullet.json").read_text(encoding="utf-8"))
    for name in ("success_at_end", "conditioning_min", "unsafe_share", "fk_error_max", "command"):
        assert real["tests"]["pybullet"][name] == test[name]
    assert "records" not in real["tests"]["pybullet"]
    assert len(json.dumps(real)) < 10_000
    assert str(runs) not in json.dumps(real)


def test_a_run_that_broke_off_is_collected_too(runs: Path, tmp_path: Path) -> None:
    config = json.loads((runs / "TPMReach-v0-sac-s0" / "config.json").read_text())
    for name, lines in {"early": "", "late": '{"steps": 60, "wall_seconds": 1.0}\n'}.items():
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "config.json").write_text(json.dumps(config))
        (tmp_path / "runs" / name / "evaluations.jsonl").write_text(lines)
    (tmp_path / "runs" / "early" / "evaluations.jsonl").unlink()
    paths = collect(Collect(tmp_path / "runs", tmp_path / "records"))
    assert [path.name for path in paths] == ["early.json", "late.json"]
    for path in paths:
        assert json.loads(path.read_text())["finished"] is False
    late = tmp_path / "runs" / "late" / "evaluations.jsonl"
    late.write_text('{"steps": 60, "wall_seconds": 1.0}\n{"steps": 70, "wa')
    collect(Collect(tmp_path / "runs", tmp_path / "records"))
    record = json.loads((tmp_path / "records" / "late.json").read_text())
    assert record["evaluations"]["steps"] == [60]  # the disk was full
    late.write_text("{\n")
    with pytest.raises(ConfigError, match="late: its evaluations are damaged"):
        collect(Collect(tmp_path / "runs", tmp_path / "records"))
    other = json.dumps({**config, "env_options": {"machine": "wide"}})
    (tmp_path / "runs" / "early" / "config.json").write_text(other)
    with pytest.raises(ConfigError, match=r"early: was made with .*wide"):
        collect(Collect(tmp_path / "runs", tmp_path / "records"))


def test_the_command_line_goes_from_runs_to_page(runs: Path, tmp_path: Path) -> None:
    records, page = tmp_path / "results", tmp_path / "results.md"
    main(["report", "collect", "--runs", str(runs), "--to", str(records)])
    main(["report", "write", "--records", str(records), "--page", str(page)])
    assert sorted(path.name for path in records.iterdir()) == ["TPMReach-v0-sac-s0.json"]
    assert rows(page.read_text(), "TPMReach-v0", "SAC + HER")
    figure = tmp_path / "images" / LEARNING_CURVES
    picture = imageio.imread(figure)
    assert len(np.unique(picture[::3, ::3].reshape(-1, picture.shape[2]), axis=0)) > 10
    before = [page.read_bytes(), figure.read_bytes()]
    write(Write(records, page))
    assert [page.read_bytes(), figure.read_bytes()] == before


def test_failures_are_counted_and_named(real: dict[str, Any]) -> None:
    rates = [1.0, 0.99, 0.98, 0.2, None]
    records = [changed(real, seed, rate) for seed, rate in enumerate(rates)]
    text = page_of(records, [])
    (row,) = rows(text, "100.0, 99.0")
    assert "| 98.0% (100.0, 99.0, 98.0, 20.0, 0.0) |" in row
    assert "| 60 |" in row  # steps: 60, 60, 60, never, never
    assert len(rows(text, "not finished")) == 1
    failures = text.split("### Failures")[1].split("##")[0]
    assert "seed 3: success 20.0%" in failures
    assert "seed 4: stopped after 120 of 120 steps" in failures
    assert "seed 2" not in failures
    most = [changed(real, seed, rate) for seed, rate in enumerate([1.0, 0.5, 0.4, 0.2, None])]
    (row,) = rows(page_of(most, []), "100.0, 50.0")
    assert row.count("never") == 2


def test_penalty_weights_get_a_table_of_their_own(real: dict[str, Any]) -> None:
    tested = real["tests"]["pybullet"]
    records = [changed(real, 0, 0.97)]
    for seed, weight in itertools.product(range(2), (0.0, 1.0)):
        share = {"mean": 0.4 - 0.3 * weight + 0.02 * seed, "low": 0, "high": 1}
        tests = {"pybullet": tested | {"unsafe_share": share}}
        records.append(
            changed(real, seed, 1.0, goals="tempting", penalty_weight=weight, tests=tests)
        )
    text = page_of(records, [])
    table = text.split("## Does the penalty work?")[1]
    assert rows(table, "| 0 |", "41.0% (40.0% to 42.0%)")
    assert rows(table, "| 1 |", "11.0% (10.0% to 12.0%)")
    assert (
        f"{real['env']}, SAC + HER: 41.00% without the penalty, 11.000% with it: 4 times less."
    ) in table
    assert "tempting" not in text.split("## Does the penalty work?")[0].split("##")[1]


def test_the_penalty_figure_has_a_dot_a_seed(real: dict[str, Any], tmp_path: Path) -> None:
    records = [
        changed(real, seed, 1.0, goals="tempting", penalty_weight=weight)
        for seed in range(3)
        for weight in (0.0, 1.0)
    ]
    figure = penalty(records)
    dots = [line for line in figure.axes[0].lines if len(line.get_xdata()) == 3]
    assert len(dots) == 4  # two metrics at two weights
    assert [label.get_text() for label in figure.axes[0].get_xticklabels()] == ["0", "1"]
    longer = penalty([*records, *(r | {"steps": 999} for r in records)])
    labels = [label.get_text() for label in longer.axes[0].get_xticklabels()]
    assert labels == ["0\n120\nsteps", "1\n120\nsteps", "0\n999\nsteps", "1\n999\nsteps"]
    (path,) = draw(records, tmp_path)
    assert path.name == PENALTY


def test_the_learning_curve_is_the_median_with_a_band(real: dict[str, Any]) -> None:
    records = [changed(real, seed, rate) for seed, rate in enumerate([0.2, 0.9, 1.0])]
    figure = learning_curves(records)
    curve = figure.axes[0].lines[0]
    assert list(curve.get_xdata()) == [0, 60, 120]
    assert list(curve.get_ydata()) == [0.0, 0.9, 0.9]
    band = figure.axes[0].collections[0].get_paths()[0].vertices
    assert (band[:, 1].min(), band[band[:, 0] == 120, 1].max()) == (0.0, 1.0)
    assert band[band[:, 0] == 120, 1].min() == 0.2


def test_the_page_is_what_its_records_say() -> None:
    records = [json.loads(path.read_text()) for path in sorted((ROOT / RECORDS).glob("*.json"))]
    text = (ROOT / PAGE).read_text(encoding="utf-8")
    figures = [name for name in (LEARNING_CURVES, PENALTY, ROBUSTNESS) if name in text]
    assert page_of(records, figures) == text


def test_what_was_not_run_is_named(real: dict[str, Any]) -> None:
    text = page_of([], [])
    assert text.count(": all of it.") == len(STUDIES)
    planned = [run.folder.name for run in plan_runs(STUDIES[0])]
    records = [changed(real, 0, 1.0, run=name) for name in planned[2:]]
    missing = page_of(records, []).split("## Not run yet")[1].split("##")[0]
    assert f"`{command(STUDIES[0])}`: {planned[0].removesuffix('-s0')} (2).\n" in missing
    every = [changed(real, 0, 1.0, run=run.folder.name) for s in STUDIES for run in plan_runs(s)]
    assert "Not run yet" not in page_of(every, [])


def test_success_in_both_engines_and_what_was_demonstrated_are_told(real: dict[str, Any]) -> None:
    tests = {"analytic": changed(real, 0, 1.0)["tests"]["pybullet"] | {"episodes": 9}}
    recipe = real["recipe"] | {"demonstrations": {"episodes": 3}}
    record = changed(real, 0, 0.9, engine="analytic", recipe=recipe)
    text = page_of([record | {"tests": record["tests"] | tests}, changed(real, 1, 0.8)], [])
    (row,) = rows(text, "SAC + HER, demonstrations | closed form | 120 |")
    assert "| 100.0% (100.0) | 90.0% (90.0) |" in row
    (row,) = rows(text, "SAC + HER | PyBullet | 120 |")
    assert "| \N{EM DASH} | 80.0% (80.0) |" in row
    assert "Held-out episodes a seed: 9 in closed form, 2 in PyBullet." in text
