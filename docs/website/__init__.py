"""Sphinx extension that writes the pages made from code: tasks, changelog, contributing."""

from __future__ import annotations

from typing import Any

from website import docstrings, projects, sources, tables, tasks


def setup(app: Any) -> dict[str, Any]:
    """Register the parts of the extension."""
    for part in (docstrings, projects, sources, tables, tasks):
        part.setup(app)
    return {"parallel_read_safe": True, "parallel_write_safe": False}
