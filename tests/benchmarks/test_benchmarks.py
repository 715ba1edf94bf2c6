"""The benchmarks of speed and endurance run, and find failures."""

import re
from pathlib import Path
from typing import Any

import bench_conveyor
import bench_cycle
import bench_shield
import engine_limits
import gymnasium as gym
import pytest
import shared
import soak
from paths import ROOT, read_strict
from processes import PYTHON, printed_by

PICK = "TPMPickAndPlace-v0"


# -- speed ----------------------------------------------------------------------------------------


@pytest.mark.usefixtures("needs_pybullet")
def test_bench_speed_from_the_command_line(tmp_path):
    numbers, plot = tmp_path / "deep" / "speed.json", tmp_path / "speed.png"
    command = f"""--contestants TPMReach-v0 {PICK} --rounds 2 --steps 60 --scaling-steps 10
        --json {numbers} --plot {plot}""".split()
    output = printed_by(PYTHON, ROOT / "benchmarks" / "bench_speed.py", *command)
    content = read_strict(numbers)
    assert list(content["contestants"]) == ["TPMReach-v0", PICK]
    for entry in content["contestants"].values():
        for name in ("steps_per_second", "reset_milliseconds", "step_over_physics"):
            low, middle, high = entry[name]
            assert 0 < low <= middle <= high
    assert min(content["scaling"]["async_over_sync"]) > 0
    assert str(tmp_path) not in numbers.read_text(encoding="utf-8")
    assert f"not measured: {PICK} over PandaPickAndPlace-v3" in output
    assert plot.read_bytes().startswith(b"\x89PNG")


# -- endurance ------------------------------------------------------------------------------------


SHORT = ["--steps", "1200", "--every", "100", "--warm-up", "300"]


def soaked(folder: Path, *options: str, **hooks: Any) -> tuple[int, dict[str, Any]]:
    """Return status and file of a short soak."""
    numbers = folder / "soak.json"
    return soak.main([*SHORT, "--json", str(numbers), *options], **hooks), read_strict(numbers)


@pytest.mark.usefixtures("needs_pybullet")
def test_soak_goes_through_everything_and_passes(tmp_path, capsys, monkeypatch):
    for share in ("REOPEN", "RENDER", "SAVE"):
        monkeypatch.setattr(soak, share, 0.6)  # so that a short one sees all of it
    monkeypatch.setattr(soak, "ENV_IDS", ["TPMReach-v0", PICK, "TPMPickAndPlaceJoints-v0"])
    plot = tmp_path / "soak.png"
    status, content = soaked(tmp_path, "--plot", str(plot))
    output = capsys.readouterr().out
    assert status == 0, output
    assert content["failures"] == []
    assert 0 < content["verdict"]["closure_drift"]["largest"] < 1e-3
    for event in ("openings", "closes", "pictures", "resets options", "resets plain", "restores"):
        assert content["events"][event] > 0, event
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert output.rstrip().endswith("PASSED")


class Raising(gym.Wrapper):
    """Raises at its 30th step."""

    taken = 0

    def step(self, action):
        self.taken += 1
        if self.taken == 30:
            raise ValueError("injected")
        return super().step(action)


@pytest.mark.usefixtures("needs_pybullet")
def test_a_step_that_raises_is_reported_outlived_and_can_be_repeated(tmp_path, capsys):
    def make(env_id, **options):
        env = gym.make(env_id, **options)
        return Raising(env) if env_id == soak.ENV_IDS[1] else env

    status, content = soaked(tmp_path, "--steps", "600", make=make)
    assert status == 1
    assert content["finished"]  # it went on
    first = content["failures"][0]
    assert (first["env_id"], first["error"]) == (soak.ENV_IDS[1], "ValueError: injected")
    assert f"--seed 0 --replay {first['visit']}" in capsys.readouterr().out


# -- records --------------------------------------------------------------------------------------


@pytest.mark.parametrize("times", [1, 2])
def test_a_run_without_policies_keeps_their_rows(times):
    def about(command):
        return {"command": command, "versions": {"tpm_gym": "0"}}

    def row(blocks, picks):
        numbers = dict.fromkeys(("headway", "complete", "streams", "supply", "bound"), 1.0)
        words = {"player": "expert", "engine": "analytic"}
        return words | numbers | {"blocks": blocks, "picks_a_minute": picks}

    record = bench_conveyor.merged({}, about("all"), [row(9, 11.0), row(3, 22.0)])
    for _ in range(times):
        record = bench_conveyor.merged(record, about("experts"), [row(9, 33.0)])
    page = "\n".join(bench_conveyor.lines(record))
    assert [cell["picks_a_minute"] for cell in record["cells"]] == [33.0, 22.0]
    assert "`experts`" in page
    assert "three blocks by `all`" in page
    again = bench_conveyor.merged(record, about("new"), [row(9, 44.0), row(3, 55.0)])
    assert [cell["picks_a_minute"] for cell in again["cells"]] == [44.0, 55.0]
    assert "`all`" not in "\n".join(bench_conveyor.lines(again))


def test_a_run_of_the_cycle_without_a_policy_keeps_its_rows(tmp_path, monkeypatch):
    seconds = {"expert": 0.25, "policy": 0.3}
    for name in ("planned", "success", "lines"):
        monkeypatch.setattr(bench_cycle, name, lambda *_: {})
    monkeypatch.setattr(shared, "fill", lambda *_: None)
    monkeypatch.setattr(bench_cycle, "load_policy", lambda path: path)
    monkeypatch.setattr(bench_cycle, "RECORD", tmp_path / "cycle.json")

    def cycle(engine, payload, make):
        return {"seconds": seconds["expert" if make is bench_cycle._expert else "policy"]}

    monkeypatch.setattr(bench_cycle, "cycle", cycle)
    for words in ([], ["--policy", "best.json"], []):
        bench_cycle.main([*words, "--write"])
        seconds["expert"] -= 0.05
    rows = read_strict(tmp_path / "cycle.json")["policy"]
    assert rows == [{"seconds": 0.3, "slower": 1.0}] * 3  # the expert has 0.15 s now


# -- records and pages ----------------------------------------------------------------------------

PAGE = "before <!-- shield: begin -->\nold\n<!-- shield: end --> after"


@pytest.mark.parametrize("write", [False, True])
def test_a_benchmark_replaces_record_and_page_only_if_told(write, tmp_path, monkeypatch, capsys):
    record, page = tmp_path / "shield.json", tmp_path / "shield.md"
    record.write_text('{"cost": {}}')
    page.write_text(PAGE)
    for module in (bench_shield, shared):
        monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(bench_shield, "RECORD", record)
    monkeypatch.setattr(bench_shield, "PAGE", page)
    bench_shield.main(["--part", "soak", "--steps", "8000", *["--write"] * write])
    table = capsys.readouterr().out
    assert "`python benchmarks/bench_shield.py --part soak --steps 8000`" in table
    assert "| TPMReachJoints-v0, wide | 2,000 |" in table
    assert (page.read_text() != PAGE) == write
    assert read_strict(record).keys() == ({"cost", "soak", "soak made by"} if write else {"cost"})


SCRIPTS = [
    file.name
    for file in sorted((ROOT / "benchmarks").glob("*.py"))
    if re.search(r"(?m)^def main", text := file.read_text(encoding="utf-8"))
    and re.search(r"\bpublish\(|\bfill\(|docs/records", text)
    and file.name not in ("shared.py", "bench_speed.py")
]


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_target_of_make_gives_write(script):
    assert "make_parser(" in (ROOT / "benchmarks" / script).read_text(encoding="utf-8")
    assert re.search(rf"{script}.* --write\n", (ROOT / "Makefile").read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    "refuse",
    [
        lambda: shared.make_parser("", quick="a minute").parse_args(["--quick", "--write"]),
        lambda: engine_limits.parse(["--policy", "other", "--write"]),
    ],
)
def test_records_are_replaced_neither_by_quick_runs_nor_by_other_policies(refuse, capsys):
    with pytest.raises(SystemExit):
        refuse()
    assert "--write" in capsys.readouterr().err
