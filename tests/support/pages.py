"""The pages of the documentation, and the code in them."""

import re
import textwrap
from pathlib import Path

from paths import ROOT

DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
PAGES = [page for page in PAGES if page.parent.name not in ("generated", "tasks")]


def name_of(page: Path) -> str:
    """Return the path of a page from the root, for the names of tests."""
    return page.relative_to(ROOT).as_posix()


def read(page: Path) -> str:
    """Return the text of a page."""
    return page.read_text(encoding="utf-8")


def blocks(page: Path, language: str) -> list[str]:
    """Return the code blocks of a page in a language, in order."""
    pattern = rf"^( *)```{language}\n(.*?)^ *```"
    found = re.finditer(pattern, read(page), flags=re.MULTILINE | re.DOTALL)
    return [textwrap.dedent(match.group(2)) for match in found]
