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

import pytest
from mutated import mutate
from paths import ROOT

TEXT = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")


POC, TOPOLOGY = "tpm_gym.analysis.poc", "tpm_gym.analysis.topology"
EQUATIONS, JACOBIAN = "tpm_gym.kinematics.equations", "tpm_gym.kinematics.jacobian"
POSITION, DELTA = "tpm_gym.kinematics.position", "delta"

# Begin of a row's first cell on the page, module, right expression, wrong one
MUTATIONS = [
    ("(1)", POC, "reduce(POCSet.__or__, sets)", "reduce(POCSet.__and__, sets)"),
    ("(1)", POC, "[_1 for unit in self.units]", "[_1 for unit in self.units[1:]]"),
    ("(2)", POC, "reduce(POCSet.__and__, sets)", "reduce(POCSet.__or__, sets)"),
    ("(3a)", POC, "loop.freedoms - loop.equations", "loop.freedoms - 6"),
    ("(3a)", POC, "self.loops[:loops]", "self.loops[:1]"),
    ("(3b)", POC, "(parallel(sets[:j]) | _1).dim", "(sets[j - 1] | _1).dim"),
    ("(3b)", POC, "parallel(sets[:j]) | _1", "parallel(sets[:j]) & _1"),
    (
        "(4), first",
        TOPOLOGY,
        "[_1 for chain in (first, second)]",
        "[_1 for chain in (second, third)]",
    ),
    ("(4), second", POC, "self.freedoms - self.actuated - _1", "self.freedoms - _1"),
    ("(5)", POC, "min(_1, key=_2, default=_3)", "max(_1, key=_2, default=_3)"),
    ("(5)", POC, "sum(abs(d) for d in run) / 2", "sum(abs(d) for d in run)"),
    ("(6)", EQUATIONS, "g.l1 + cos[0]", "g.l1 - cos[0]"),
    ("(7)", EQUATIONS, "cos[1] + (2.0 * g.l5 - g.l1)", "cos[1] + (g.l5 - g.l1)"),
    ("(8a)", EQUATIONS, "0.5 - _1", "0.5 + _1"),
    ("(8a)", EQUATIONS, "along * dx - across * dz", "along * dx + across * dz"),
    ("(8b)", EQUATIONS, "z1 + along * dz + across * dx", "z1 + along * dz - across * dx"),
    ("(9)", EQUATIONS, "cos[2] + (g.l1 - 2.0 * g.l2)", "cos[2] + (g.l1 - g.l2)"),
    ("(10)", EQUATIONS, "z_c - (sin[2] - g.l6)", "z_c - sin[2]"),
    ("(10)", EQUATIONS, "z_c + 2.0 * g.l6", "z_c + g.l6"),
    ("(11)", EQUATIONS, "z_c + 2.0 * g.l6", "z_c + g.l6"),
    ("(11)", EQUATIONS, "x_c + l7 * cos_beta + g.l2", "x_c + l7 * cos_beta + 2 * g.l2"),
    ("(11)", POSITION, "_1.position[..., branch.index, :]", "_1.position[..., 0, :]"),
    ("(12)", EQUATIONS, "z - 2.0 * g.l6", "z - g.l6"),
    ("(13)", EQUATIONS, "x_c + l1 - 2.0 * g.l5", "x_c + l1 - g.l5"),
    ("(13)", EQUATIONS, "_1(a1, z_c, x_c, *_2)", "_1(a1, z_c, 0.0, *_2)"),
    ("(14)", EQUATIONS, "_1(a3, b3, y, *_2)", "_1(a3, b3, x, *_2)"),
    ("(15)", EQUATIONS, "z - g.l6", "z - 2.0 * g.l6"),
    ("(16)", EQUATIONS, "r1x * r2z - r1z * r2x", "r1x * r2z"),
    ("(16)", JACOBIAN, "sin * r1x", "cos * r1x"),
    ("(17)", EQUATIONS, "r2z * cos[1] - r2x * sin[1]", "r2z * cos[1] - r1x * sin[1]"),
    ("(17)", JACOBIAN, "f.cos_beta * f.leg1", "f.leg1"),
    # What the text claims
    ("M_HSOC1", TOPOLOGY, "poc.parallel([hsoc_1, hsoc_2])", "hsoc_1"),
    ("xi_L1", POC, "chains[: j + 1]", "chains[:j]"),
    ("xi_L2", POC, "(parallel(sets[:j]) | _1).dim", "6"),
    ("v = m - n + 1", POC, "range(1, len(order))", "(1,)"),
    ("Delta_1", POC, "self.freedoms - self.actuated - _1", "self.freedoms - _1"),
    ("3 degrees", TOPOLOGY, "right[rank:]", "right[rank + 1 :]"),
    (
        "link 3'",
        EQUATIONS,
        "cos[1] + (2.0 * g.l5 - _1)",
        "cos[1] + 1e-3 * cos[2] + (2.0 * g.l5 - _1)",
    ),
    ('"complete', EQUATIONS, "cos_beta * turn3", "0 * turn3"),
    ("y_B1", EQUATIONS, "across2 >= _1", "across2 - 1e9 * (abs(y1) < 1e-9) >= _1"),
    ("16 inverse", POSITION, "leg[bend][side]", "leg[0][side]"),
    ("twice as", DELTA, "direction - fold", "direction"),
    ("the singularities", DELTA, "_1 * across - np.sin(q) * arm", "_1 * across + np.sin(q) * arm"),
    ("beta = pi/2", EQUATIONS, "found.sin_beta", "found.cos_beta"),
    ("the plane", EQUATIONS, "1e-6", "1e-12"),
    ("Eqs. (16)", POC, "np.stack([normal, np.cross(rod, normal)])", "np.eye(3)[1:]"),
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
each_mutation = pytest.mark.parametrize(("row", "module", "right", "wrong"), MUTATIONS)


def test_every_row_has_a_mutation_and_every_mutation_a_row():
    assert len(ROWS) > 30
    for row, *_ in MUTATIONS:
        assert len([label for label in ROWS if label.startswith(row)]) == 1, row
    for label in ROWS:
        assert any(label.startswith(row) for row, *_ in MUTATIONS), label


@each_mutation
def test_what_is_replaced_stands_there_once(row, module, right, wrong):
    source = inspect.getsource(importlib.import_module(module))
    broken, count = mutate(source, right, wrong)
    assert count == 1
    assert ast.dump(broken) != ast.dump(ast.parse(source))


@pytest.mark.slow
@each_mutation
def test_the_row_s_tests_see_the_mutation(row, module, right, wrong):
    tests = next(named for label, named in ROWS.items() if label.startswith(row))
    change = [module, right, wrong]
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
