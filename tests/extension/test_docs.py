"""The code of docs/extending.md runs, and what it and CONTRIBUTING.md point at is there."""

import pkgutil
import re

import pytest
from episodes import expert_episode
from pages import PAGES, name_of
from paths import ROOT
from registries import registries_put_back

import tpm_gym
from tpm_gym.learning.recipes import read_recipe

PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.parametrize("code", BLOCKS, ids=["task", "machine", "engine", "checks"])
def test_a_block_makes_an_environment_that_its_expert_solves(code):
    with registries_put_back():
        names = {"__name__": "extending"}
        exec(code, names)
        env = names.get("env")
        for seed in range(3 if env else 0):
            *_, (_, reward, info) = expert_episode(env, seed)
            assert info["is_success"]
            assert sum(info["reward_terms"].values()) == pytest.approx(reward)


def test_the_recipes_are_for_the_task_of_the_page(tmp_path):
    file, page = tmp_path / "hover.yml", (ROOT / "docs" / "training.md").read_text("utf-8")
    file.write_text("".join(re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)), encoding="utf-8")
    assert 'register_task("Hover"' in PAGE
    recipe = read_recipe(file, "sac", "hover:TPMHover-v0")
    assert recipe.hindsight
    assert recipe.arguments["learning_starts"] >= 100  # steps of an episode
    assert read_recipe(file, "ppo", "hover:TPMHoverDense-v0").n_envs == 256


def test_the_table_counts_lines_as_they_are():
    page = (ROOT / "docs/one-core.md").read_text("utf-8")
    rows = re.findall(r"`(\w+\.py)`, (\d+) lines", page)
    assert len(rows) == 3
    for name, lines in rows:
        found = len((ROOT / "tests" / "extension" / name).read_text("utf-8").splitlines())
        assert int(lines) == pytest.approx(found, abs=5), name


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_to_files_and_headings(page):
    text = page.read_text(encoding="utf-8")
    for path, heading in re.findall(r"\]\((?!http)([^)#]*)#?([^)]*)", text):
        place = page.parent / path if path else page
        assert place.exists(), path
        if heading:
            titles = re.findall(r"^##+ (.*)$", place.read_text(encoding="utf-8"), re.MULTILINE)
            slugs = [re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles]
            assert heading in slugs


def test_the_table_of_rooms_has_all_rooms():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rooms = re.findall(r"`(\w+)`", " ".join(re.findall(r"^\| (`.*?) \|", text, re.MULTILINE)))
    there = {module.name for module in pkgutil.iter_modules(tpm_gym.__path__)}
    assert set(rooms) == there
