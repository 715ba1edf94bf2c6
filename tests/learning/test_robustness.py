"""The bisection finds where success halves, whatever the attribute, and asks for no more tests."""

import json
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.report.figures import draw, robustness
from tpm_gym.learning.report.page import ROBUSTNESS
from tpm_gym.learning.report.page import page as page_of
from tpm_gym.learning.report.records import Collect, collect, condense_bisection
from tpm_gym.learning.robustness import ends, halving, nominal
from tpm_gym.learning.study import Bisection
from tpm_gym.simulation.randomisation import LIMITS, Randomisation

ENDS = [(attribute, end) for attribute in LIMITS for end in ends(attribute)]
GRADUAL = [(attribute, end) for attribute, end in ENDS if attribute != "latency"]


def bisected(attribute: str, end: float, success: Any) -> tuple[Any, dict[float, float]]:
    """A bisection that is given every success it asks for, and all that it was given."""
    found: dict[float, float] = {}
    while (result := halving(attribute, end, found)).missing is not None:
        assert result.missing not in found
        found[result.missing] = success(result.missing)
    return result, found


def test_attributes_and_their_ends_are_those_of_randomisation() -> None:
    assert set(LIMITS) == set(vars(Randomisation()))
    for attribute, end in ENDS:
        Randomisation(**{attribute: end})
    assert Randomisation(**{name: nominal(name) for name in LIMITS}) == Randomisation()


@given(which=st.sampled_from(GRADUAL), share=st.floats(0.001, 0.999), rate=st.floats(0.3, 1.0))
def test_success_halves_where_the_bisection_says(
    which: tuple[str, float], share: float, rate: float
) -> None:
    attribute, end = which
    start = nominal(attribute)
    edge = start + share * (end - start)

    def success(value: float) -> float:
        return rate if abs(value - start) < abs(edge - start) else 0.4 * rate

    result, found = bisected(attribute, end, success)
    assert success(result.before) > rate / 2 >= success(result.after)
    assert len(found) <= 2 + 6
    for value in found:
        Randomisation(**{attribute: value})
    way = np.abs([start, result.before, result.after, end])
    way = np.log(way) if start else way
    assert (way[2] - way[1]) / (way[3] - way[0]) == pytest.approx(1 / 64, rel=0.2)


@pytest.mark.parametrize(("attribute", "end"), ENDS)
def test_where_success_stays_two_tests_are_enough(attribute: str, end: float) -> None:
    result, found = bisected(attribute, end, lambda value: 0.9 if value != end else 0.5)
    assert (result.before, result.after) == (end, None)
    assert set(found) == {nominal(attribute), end}


def test_half_is_of_the_nominal_success() -> None:
    for limit, halved in ((0.31, False), (0.3, True)):
        result, _ = bisected("friction", 3.0, lambda value, least=limit: max(1.6 - value, least))
        assert (result.after is not None) == halved


@pytest.mark.parametrize("edge", range(1, 6))
def test_a_latency_is_a_whole_number_of_steps(edge: int) -> None:
    result, found = bisected("latency", 5.0, lambda steps: float(steps < edge))
    assert (result.before, result.after) == (edge - 1, edge)
    assert all(Randomisation(latency=steps).latency == steps for steps in found)


# -- in files -------------------------------------------------------------------------------------


def answer(bisection: Bisection, success: Any) -> int:
    """Write what the evaluations would that a bisection asks for; return how many there were."""
    count = 0
    while left := bisection.left():
        (command,) = left
        options = dict(zip(command[2::2], command[3::2], strict=True))
        name, _, text = options["--randomisation"].partition("=")
        assert name == bisection.attribute
        servo = name in ("servo_stiffness", "joint_friction")
        assert options.get("--drive", "ideal") == ("servo" if servo else "ideal")
        assert options["--engine"] == bisection.engine
        rate = success(float(text))
        test = {
            "env": bisection.env,
            "policy": options["--policy"],
            "episodes": bisection.episodes,
            "randomisation": {name: float(text)},
            "env_options": {"engine": bisection.engine},
            "success_at_end": {"mean": rate, "low": rate, "high": rate},
            "versions": {},
            "git_commit": "0" * 40,
            "machine": {},
            "command": shlex.join(command),
        }
        path = Path(options["--json"])
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(test))
        count += 1
    return count


def law(value: float) -> float:
    """Success that halves at 1.5 and, below 1, at 0.8."""
    return 1.0 if 0.8 < value < 1.5 else 0.1


@pytest.fixture
def records(tmp_path: Path) -> list[Any]:
    """Of two ids: one law for factors, and errors that nothing fails of."""
    runs = tmp_path / "runs"
    for env in ("TPMReach-v0", "TPMPickAndPlace-v0"):
        for attribute in LIMITS:
            bisection = Bisection(runs / f"{env}-{attribute}", env, attribute, 50)
            factor = nominal(attribute) == 1.0
            answer(bisection, law if factor else lambda value: 0.97)
    paths = collect(Collect(runs, tmp_path / "records"))
    assert len(paths) == 2 * len(LIMITS)
    return [json.loads(path.read_text()) for path in paths]


def test_what_was_tested_is_not_tested_again_unless_with_other_episodes(tmp_path: Path) -> None:
    bisection = Bisection(tmp_path / "b", "TPMReach-v0", "link_mass", 50)
    assert answer(bisection, law) == 1 + 7 + 7
    assert bisection.left() == []
    assert answer(replace(bisection, episodes=60), lambda value: 0.8) == 3
    kept = condense_bisection(tmp_path / "b")
    assert (kept["episodes"], set(kept["tests"])) == (60, {"0.5", "1", "16"})


def test_tests_of_no_bisection_are_refused(tmp_path: Path) -> None:
    bisection = Bisection(tmp_path / "b", "TPMReach-v0", "link_mass", 50)
    answer(bisection, law)
    (tmp_path / "b" / "tests" / "1.json").unlink()
    with pytest.raises(ConfigError, match="no bisection"):
        collect(Collect(tmp_path, tmp_path / "records"))


def test_the_page_says_where_success_halves(records: list[Any]) -> None:
    text = page_of(records, [ROBUSTNESS])
    assert f"images/{ROBUSTNESS}" in text
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    (row,) = [row for row in rows if row.startswith("| puck mass (factor) | 1 | 10 |")]
    cells = {cell.strip() for cell in row.strip("|").split("|")[3:]}
    (cell,) = cells
    low, high = map(float, cell.split(" to "))
    assert low < 1.5 <= high < 1.05 * low
    (row,) = [
        row for row in rows if row.startswith("| servo stiffness (factor, servo drives) | 1 | 0.01")
    ]
    low, high = map(float, row.strip("|").split("|")[3].split(" to "))
    assert high <= 0.8 < low < 1.1 * high
    (row,) = [row for row in rows if row.startswith("| encoder bias (rad) | 0 | 0.001 |")]
    assert row.count("97.0% at 0.001") == 2
    again = [record | {"engine": "analytic", "episodes": 70} for record in records]
    text = page_of([*records, *again], [])
    assert text.count("| puck mass") == 2 * page_of(records, []).count("| puck mass") > 0
    assert "In closed form, 70 episodes a test:" in text
    assert "In PyBullet, 50 episodes a test:" in text
    del records[0]["tests"][list(records[0]["tests"])[-1]]
    assert "not finished" in page_of(records, [])


def test_the_figure_has_a_panel_an_attribute_and_a_line_an_id(
    records: list[Any], tmp_path: Path
) -> None:
    figure = robustness(records)
    panels = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title() for axes in panels] == [name.replace("_", " ") for name in LIMITS]
    puck = panels[list(LIMITS).index("puck_mass")]
    lines = [line for line in puck.lines if len(line.get_xdata()) > 2]
    assert len(lines) == 2
    for line in lines:
        values, rates = line.get_xdata(), line.get_ydata()
        assert list(values) == sorted(values)
        assert list(rates) == [law(value) for value in values]
    (path,) = draw(records, tmp_path)
    assert path.name == ROBUSTNESS
    assert len(np.unique(imageio.imread(path)[::3, ::3])) > 10
