"""One step stays short: few files and few functions, in PyBullet and in a vector environment."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import tpm_gym

SOURCES = str(Path(tpm_gym.__file__).parent)
FILES, FUNCTIONS = 14, 55
Crossed = set[tuple[str, str, int]]


@contextmanager
def noted() -> Iterator[Crossed]:
    """Collect file, name and line of the functions of tpm_gym that are called.

    Compiled functions count too. Comprehensions belong to their function.
    """
    crossed: Crossed = set()

    def note(frame, event, _):
        code = frame.f_code
        ours = code.co_filename.startswith(SOURCES) and not code.co_name.startswith("<")
        if event == "call" and ours:
            crossed.add((code.co_filename, code.co_name, code.co_firstlineno))

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        yield crossed
    finally:
        sys.setprofile(before)


@pytest.mark.parametrize(
    "make",
    [
        lambda: gym.make("TPMPickAndPlace-v0"),
        lambda: gym.make_vec("TPMPickAndPlace-v0", num_envs=4, engine="analytic"),
    ],
    ids=["pybullet", "vector"],
)
def test_a_step_crosses_few_files_and_functions(make):
    env = make()
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    env.step(action)  # what is imported at the first use does not count
    with noted() as crossed:
        env.step(action)
    env.close()
    files = {file for file, _, _ in crossed}
    assert 5 < len(files) <= FILES, sorted(files)
    assert 20 < len(crossed) <= FUNCTIONS, sorted(crossed)
