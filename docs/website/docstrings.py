"""Docstrings with headings and tables in Markdown, as Gymnasium's environments have them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Any


def setup(app: Any) -> None:
    """Convert docstrings before napoleon reads them."""
    app.connect("autodoc-process-docstring", convert, priority=100)
    app.connect("autodoc-skip-member", skip)


def skip(app: Any, what: str, name: str, obj: Any, skipped: bool, options: Any) -> bool | None:
    """Leave out methods that only repeat those of a base class."""
    return True if (getattr(obj, "__doc__", "") or "").startswith("See ") else None


def convert(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Replace headings and tables in Markdown by those of reStructuredText, in place."""
    lines[:] = list(_converted(lines))


def _converted(lines: Sequence[str]) -> Iterator[str]:
    for in_table, block in groupby(lines, key=lambda line: line.startswith("| ")):
        if in_table:
            yield from ["", *_table(list(block)), ""]
            continue
        for line in block:
            if line.startswith("## "):
                yield f".. rubric:: {line[3:]}"
            else:  # |y| is no substitution
                yield re.sub(r"(``.*?``)|\|", lambda found: found[1] or r"\|", line)


def _table(rows: Sequence[str]) -> Iterator[str]:
    yield from (".. list-table::", "   :header-rows: 1", "")
    for row in rows:
        cells = [cell.strip() for cell in row.strip("|").split(" | ")]
        if set(cells[0]) <= {"-", " "}:
            continue
        for column, cell in enumerate(cells):
            yield f"   {'* -' if column == 0 else '  -'} {cell}"
