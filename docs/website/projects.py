"""Pages of the project's own files: CHANGELOG.md and CONTRIBUTING.md, with links from here."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
GENERATED = ROOT / "docs" / "generated"
FILES = ("CHANGELOG.md", "CONTRIBUTING.md")
_LINK = re.compile(r"\]\((?!https?:|#)(docs/)?([^)]+)\)")


def setup(app: Any) -> None:
    """Write the pages before any page is read."""
    app.connect("builder-inited", lambda app: write_pages())


def write_pages() -> None:
    """Copy the files to docs/generated/, with links that hold there."""
    for name in FILES:
        text = (ROOT / name).read_text(encoding="utf-8")
        write(GENERATED / name.lower(), _LINK.sub(_from_generated, text))


def _from_generated(link: re.Match[str]) -> str:
    in_docs, path = link.groups()
    return f"](../{path})" if in_docs else f"](../../{path})"


def write(path: Path, text: str) -> None:
    """Write a file unless it has this text, so that Sphinx reads only what changed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")
