"""Each row of docs/paper.md names tests that fail if its statement is computed wrongly.

Each of MUTATIONS breaks one expression of the package in memory, and the tests of its row must fail
then. That takes minutes, so it is a slow test. The fast tests check that the table is complete.
"""

import ast
import importlib
import inspect
import json
import os
import re
import subprocess
import sys
from typing import NamedTuple

import pytest
from mutated import mutate
from paths import ROOT

TEXT = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")


class Mutation(NamedTuple):
    """Wrong expression for a row of the page, named by the begin of its first cell."""

    row: str
    module: str
    right: str
    wrong: str


POC, TOPOLOGY = "tpm_gym.analysis.poc", "tpm_gym.analysis.topology"
EQUATIONS, JACOBIAN = "tpm_gym.kinematics.equations", "tpm_gym.kinematics.jacobian"
POSITION, DELTA = "tpm_gym.kinematics.position", "delta"

MUTATIONS = [
    Mutation("(1)", POC, "reduce(POCSet.__or__, sets)", "reduce(POCSet.__and__, sets)"),
    Mutation("(1)", POC, "[_1 for unit in self.units]", "[_1 for unit in self.units[1:]]"),
    Mutation("(2)", POC, "reduce(POCSet.__and__, sets)", "reduce(POCSet.__or__, sets)"),
    Mutation("(3a)", POC, "loop.freedoms - loop.equations", "loop.freedoms - 6"),
    Mutation("(3a)", POC, "self.loops[:loops]", "self.loops[:1]"),
    Mutation("(3b)", POC, "(parallel(sets[:j]) | _1).dim", "(sets[j - 1] | _1).dim"),
    Mutation("(3b)", POC, "parallel(sets[:j]) | _1", "parallel(sets[:j]) & _1"),
    Mutation(
        "(4), first",
        TOPOLOGY,
        "[_1 for chain in (first, second)]",
        "[_1 for chain in (second, third)]",
    ),
    Mutation("(4), second", POC, "self.freedoms - self.actuated - _1", "self.freedoms - _1"),
    Mutation("(5)", POC, "min(_1, key=_2, default=_3)", "max(_1, key=_2, default=_3)"),
    Mutation("(5)", POC, "sum(abs(d) for d in run) / 2", "sum(abs(d) for d in run)"),
    Mutation("(6)", EQUATIONS, "g.l1 + cos[0]", "g.l1 - cos[0]"),
    Mutation("(7)", EQUATIONS, "cos[1] + (2.0 * g.l5 - g.l1)", "cos[1] + (g.l5 - g.l1)"),
    Mutation("(8a)", EQUATIONS, "0.5 - _1", "0.5 + _1"),
    Mutation("(8a)", EQUATIONS, "along * dx - across * dz", "along * dx + across * dz"),
    Mutation("(8b)", EQUATIONS, "z1 + along * dz + across * dx", "z1 + along * dz - across * dx"),
    Mutation("(9)", EQUATIONS, "cos[2] + (g.l1 - 2.0 * g.l2)", "cos[2] + (g.l1 - g.l2)"),
    Mutation("(10)", EQUATIONS, "z_c - (sin[2] - g.l6)", "z_c - sin[2]"),
    Mutation("(10)", EQUATIONS, "z_c + 2.0 * g.l6", "z_c + g.l6"),
    Mutation("(11)", EQUATIONS, "z_c + 2.0 * g.l6", "z_c + g.l6"),
    Mutation("(11)", EQUATIONS, "x_c + l7 * cos_beta + g.l2", "x_c + l7 * cos_beta + 2 * g.l2"),
    Mutation("(11)", POSITION, "_1.position[..., branch.index, :]", "_1.position[..., 0, :]"),
    Mutation("(12)", EQUATIONS, "z - 2.0 * g.l6", "z - g.l6"),
    Mutation("(13)", EQUATIONS, "x_c + l1 - 2.0 * g.l5", "x_c + l1 - g.l5"),
    Mutation("(13)", EQUATIONS, "_1(a1, z_c, x_c, *_2)", "_1(a1, z_c, 0.0, *_2)"),
    Mutation("(14)", EQUATIONS, "_1(a3, b3, y, *_2)", "_1(a3, b3, x, *_2)"),
    Mutation("(15)", EQUATIONS, "z - g.l6", "z - 2.0 * g.l6"),
    Mutation("(16)", EQUATIONS, "r1x * r2z - r1z * r2x", "r1x * r2z"),
    Mutation("(16)", JACOBIAN, "sin * r1x", "cos * r1x"),
    Mutation("(17)", EQUATIONS, "r2z * cos[1] - r2x * sin[1]", "r2z * cos[1] - r1x * sin[1]"),
    Mutation("(17)", JACOBIAN, "f.cos_beta * f.leg1", "f.leg1"),
    # What the text claims
    Mutation("M_HSOC1", TOPOLOGY, "poc.parallel([hsoc_1, hsoc_2])", "hsoc_1"),
    Mutation("xi_L1", POC, "chains[: j + 1]", "chains[:j]"),
    Mutation("xi_L2", POC, "(parallel(sets[:j]) | _1).dim", "6"),
    Mutation("v = m - n + 1", POC, "range(1, len(order))", "(1,)"),
    Mutation("Delta_1", POC, "self.freedoms - self.actuated - _1", "self.freedoms - _1"),
    Mutation("3 degrees", TOPOLOGY, "right[rank:]", "right[rank + 1 :]"),
    Mutation(
        "link 3'",
        EQUATIONS,
        "cos[1] + (2.0 * g.l5 - _1)",
        "cos[1] + 1e-3 * cos[2] + (2.0 * g.l5 - _1)",
    ),
    Mutation('"complete', EQUATIONS, "cos_beta * turn3", "0 * turn3"),
    Mutation("y_B1", EQUATIONS, "across2 >= _1", "across2 - 1e9 * (abs(y1) < 1e-9) >= _1"),
    Mutation("16 inverse", POSITION, "leg[bend][side]", "leg[0][side]"),
    Mutation("twice as", DELTA, "direction - fold", "direction"),
    Mutation(
        "the singularities", DELTA, "_1 * across - np.sin(q) * arm", "_1 * across + np.sin(q) * arm"
    ),
    Mutation("beta = pi/2", EQUATIONS, "found.sin_beta", "found.cos_beta"),
    Mutation("the plane", EQUATIONS, "1e-6", "1e-12"),
    Mutation("Eqs. (16)", POC, "np.stack([normal, np.cross(rod, normal)])", "np.eye(3)[1:]"),
]


def rows() -> dict[str, list[str]]:
    """Return the tests that each row of the page names, by the first cell of the row."""
    found = {}
    for line in TEXT.splitlines():
        named = re.findall(r"`(test_\w+\.py)::(\w+)`", line)
        if line.startswith("| ") and named:
            paths = [next((ROOT / "tests").rglob(file)).relative_to(ROOT) for file, _ in named]
            label = line.split(" | ")[0].removeprefix("| ")
            found[label] = [f"{p}::{name}" for p, (_, name) in zip(paths, named, strict=True)]
    return found


ROWS = rows()


def test_every_row_has_a_mutation_and_every_mutation_a_row():
    assert len(ROWS) > 30
    for mutation in MUTATIONS:
        assert len([label for label in ROWS if label.startswith(mutation.row)]) == 1, mutation.row
    for label in ROWS:
        assert any(label.startswith(mutation.row) for mutation in MUTATIONS), label


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda m: f"{m.row}: {m.wrong}")
def test_what_is_replaced_stands_there_once(mutation):
    source = inspect.getsource(importlib.import_module(mutation.module))
    broken, count = mutate(source, mutation.right, mutation.wrong)
    assert count == 1
    assert ast.dump(broken) != ast.dump(ast.parse(source))


@pytest.mark.slow
@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda m: f"{m.row}: {m.wrong}")
def test_the_row_s_tests_see_the_mutation(mutation):
    tests = next(named for label, named in ROWS.items() if label.startswith(mutation.row))
    change = [mutation.module, mutation.right, mutation.wrong]
    path = os.pathsep.join(str(ROOT / part) for part in ("tests/support", "src", "docs"))
    result = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-x", "-p", "mutated", *tests],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": path, "MUTATION": json.dumps(change)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 1, result.stdout  # 1: tests ran and failed; 2: they did not run
