"""The code of docs/extending.md runs."""

import re
from unittest.mock import patch

import gymnasium as gym
import pytest
from episodes import expert_episode
from paths import ROOT

from tpm_gym.tasks.registry import TASKS

PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.parametrize("code", BLOCKS, ids=["task", "machine", "engine"])
def test_a_block_makes_an_environment_that_its_expert_solves(code):
    with patch.dict(gym.registry), patch.dict(TASKS):
        names = {"__name__": "extending"}
        exec(code, names)
        env = names["env"]
        for seed in range(3):
            *_, (_, reward, info) = expert_episode(env, seed)
            assert info["is_success"]
            assert sum(info["reward_terms"].values()) == pytest.approx(reward)
        env.close()


def test_the_table_counts_lines_as_they_are():
    for name, lines in re.findall(r"`(\w+\.py)`, (\d+) lines", PAGE):
        found = len((ROOT / "tests" / "extension" / name).read_text("utf-8").splitlines())
        assert int(lines) == pytest.approx(found, abs=5), name


def test_the_links_lead_somewhere():
    for path in re.findall(r"\]\((?!http)([^)#]+)", PAGE):
        assert (ROOT / "docs" / path).is_file(), path
