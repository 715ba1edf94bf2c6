"""The documentation site: pages made from code, links to code, and the build."""

import pytest
from paths import ROOT
from processes import PYTHON, printed_by
from registries import registries_put_back

from tpm_gym.tasks.registry import TASKS

pytest.importorskip("sphinx")
from docutils import nodes
from docutils.utils import new_document
from website import docstrings, projects, sources, tables, tasks


@pytest.fixture(scope="module")
def stack():
    """Return the page of a task that is registered outside the package."""
    with registries_put_back("sorting"):
        import sorting  # registers TPMSort

        assert sorting
        return "\n".join(tasks.page("sort"))


def test_a_new_task_has_a_page(stack):
    assert stack.startswith("# Sort\n")
    assert "\nPut the red block and the blue block on their places.\n" in stack
    for row in (
        "| `TPMSortJointsDense-v0` | joint increments | dense |",
        "| `red` | 36 mm | 30 mm | 50 g |",
        "| 3 | above 0: vacuum on |",
        "| `red_position` | 3 | m | centre of the red, from a camera |",
        "| `singularity` | all |",
        "No training of this task is on record.",
    ):
        assert row in stack


def test_the_page_tells_how_often_the_expert_succeeds(stack):
    rates = [line for line in stack.splitlines() if "--policy expert" in line]
    assert len(rates) == 4
    assert all("% [" in line for line in rates)


def test_links_out_of_docs_lead_to_pages_of_files():
    text = "[a](../src/tpm_gym/arrays.py) [b](paper.md) [c](../train/recipes) [d](#here)"
    marked = "[a](source:src/tpm_gym/arrays.py) [b](paper.md) [c](source:train/recipes) [d](#here)"
    assert sources.mark(text, "extending") == marked
    assert sources.mark("[a](../../LICENSE)", "generated/x") == "[a](source:LICENSE)"
    assert sources.mark("[a](../nowhere.py)", "extending") == "[a](../nowhere.py)"


def test_links_of_the_projects_files_hold_in_their_copies(tmp_path, monkeypatch):
    monkeypatch.setattr(projects, "GENERATED", tmp_path)
    projects.write_pages()
    text = (tmp_path / "contributing.md").read_text(encoding="utf-8")
    assert "](../extending.md#a-task)" in text
    assert "](../../src/tpm_gym/tasks/task.py)" in text


def test_tables_and_headings_in_docstrings_become_those_of_sphinx():
    lines = ["Text |y|.", "", "## Head", "", "| a | b |", "| --- | --- |", "| `x|y` | 2 |"]
    docstrings.convert(None, "class", "x", None, None, lines)
    assert lines[0] == r"Text \|y\|."
    assert ".. rubric:: Head" in lines
    assert lines[lines.index("   * - a") + 1 :][:3] == ["     - b", "   * - `x|y`", "     - 2"]


def test_intervals_and_quantities_in_tables_keep_to_one_line():
    cell = "| 100.0% [99.1, 100.0] (1.5 to never) at 37 N m of [a, b], 99.5% of 1,000 |"
    tied = "| 100.0% [99.1,~100.0] (1.5~to~never) at 37~N~m of [a, b], 99.5%~of~1,000 |"
    text = f"In [1, 2]\n{cell}"
    assert tables.whole(text).replace("\N{NO-BREAK SPACE}", "~") == f"In [1, 2]\n{tied}"


def test_long_cells_and_long_words_of_code_are_marked():
    page = new_document("page")
    texts = "word " * 9, "word", "word " * 9, "w" * 45, "make demo"
    kinds = nodes.entry, nodes.entry, nodes.literal, nodes.literal, nodes.literal
    page += [kind("", nodes.Text(text)) for kind, text in zip(kinds, texts, strict=True)]
    tables.mark(page)
    assert [node["classes"] for node in page] == [["long"], [], [], ["long"], ["short"]]


def test_the_page_of_sheets_is_what_the_tasks_say():
    page = "\n".join(tasks.sheets())
    assert tasks.SHEETS.read_text(encoding="utf-8") == page, "run make docs"
    own = [task for task in TASKS.values() if task.__module__.startswith("tpm_gym.")]
    assert page.count("\n## ") == len(own)
    for line in (
        "Bring point P of the platform to a point in the workspace.",
        "| `object_turn` | 2 | - | cosine and sine of 4 times the yaw of the object | 0 | 1 |",
        "| `gate` | all | -(d - tolerance) / 5 mm, at most 0; d is the depth of P below the path |",
        "| `toppled` | whether the block lies on a side |",
    ):
        assert f"\n{line}\n" in page


@pytest.mark.slow
def test_the_site_builds_without_warnings(tmp_path):
    options = ("-E", "-W", "--keep-going", "--nitpicky")
    printed_by(PYTHON, "-m", "sphinx", *options, "docs", tmp_path, cwd=ROOT)
    for page in ("index", "api/tpm_gym", "generated/tasks/reach"):
        assert (tmp_path / f"{page}.html").exists()
