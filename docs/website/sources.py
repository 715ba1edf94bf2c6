"""Pages of the files outside docs/ that pages link to.

A page says ``[name](../src/tpm_gym/envs/core.py)``, which GitHub follows. Here such a link leads to
a page that shows the file, or lists the folder.
"""

from __future__ import annotations

import functools
import html
import importlib
import os
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from docutils import nodes
from pygments.lexers import get_lexer_for_filename
from pygments.util import ClassNotFound

import tpm_gym

ROOT = Path(__file__).resolve().parents[2]
LINK = re.compile(r"\]\((?P<path>[^)#:]+)(?P<heading>#[^)]*)?\)")
SCHEME = "source:"
_linked: set[str] = set()
"""Files and folders that the pages of this build link to, from the root of the repository."""


def setup(app: Any) -> None:
    """Rewrite links when a page is read, and add the pages of their targets at the end."""
    app.connect("source-read", lambda app, name, text: text.append(mark(text.pop(), name)))
    app.connect("doctree-resolved", resolve)
    app.connect("missing-reference", find_code)
    app.connect("html-collect-pages", collect)


def mark(text: str, page: str) -> str:
    """Give links that lead outside docs/ the scheme ``source:``, with the path from the root."""
    folder = posixpath.dirname(f"docs/{page}")

    def replace(link: re.Match[str]) -> str:
        path = posixpath.normpath(posixpath.join(folder, link["path"]))
        if path.startswith("docs/") and path.endswith((".md", ".png", ".gif", ".webp")):
            return link[0]
        if not (ROOT / path).exists():
            return link[0]  # Sphinx reports it
        return f"]({SCHEME}{path})"

    return LINK.sub(replace, text)


def resolve(app: Any, document: nodes.document, page: str) -> None:
    """Replace the scheme by the address of the target's page."""
    for node in document.findall(nodes.reference):
        if node.get("refuri", "").startswith(SCHEME):
            node["refuri"] = _address(app, page, node["refuri"].removeprefix(SCHEME))


def find_code(app: Any, env: Any, node: Any, content: nodes.Element) -> nodes.reference | None:
    """Link a name of this package that has no entry in the API to the file that defines it.

    Names that do not exist keep their warning.
    """
    parts = node.get("reftarget", "").split(".")
    if node.get("refdomain") != "py" or parts[0] != "tpm_gym":
        return None
    for length in range(len(parts), 0, -1):
        try:
            module = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        try:
            functools.reduce(getattr, parts[length:], module)
        except AttributeError:
            return None
        path = Path(module.__file__ or "").relative_to(Path(tpm_gym.__file__).parents[2])
        return nodes.reference(
            "", "", content, internal=True, refuri=_address(app, node["refdoc"], path.as_posix())
        )
    return None


def _address(app: Any, page: str, path: str) -> str:
    """Return the address, relative to a page, of the page of a file; that page is written later."""
    _linked.add(path)
    address: str = app.builder.get_relative_uri(page, f"source/{path}")
    return address


def collect(app: Any) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Yield a page for each target, and for each file of a target that is a folder."""
    linked = set(_linked)
    for path in sorted(linked):
        if (ROOT / path).is_dir():
            linked.update(f"{path}/{name}" for name in _names(ROOT / path))
    for path in sorted(linked):
        body = _listing(path) if (ROOT / path).is_dir() else _code(app, path)
        title = html.escape(path)
        yield f"source/{path}", {"title": title, "body": f"<h1>{title}</h1>\n{body}"}, "page.html"


def _names(folder: Path) -> list[str]:
    return sorted(
        entry.name for entry in folder.iterdir() if entry.is_file() and entry.name[0] not in "._"
    )


def _listing(path: str) -> str:
    base = os.path.basename(path)
    items = (f'<li><a href="{base}/{n}.html">{n}</a></li>' for n in _names(ROOT / path))
    return f"<ul>{''.join(items)}</ul>"


def _code(app: Any, path: str) -> str:
    try:
        text = (ROOT / path).read_text(encoding="utf-8")
    except UnicodeDecodeError:
        return "<p>This file is not text.</p>"
    try:
        lexer = get_lexer_for_filename(path).aliases[0]
    except ClassNotFound:
        lexer = "text"
    if len(text) > 200_000:
        return f"<p>{len(text):,} characters, too many for a page.</p>"
    highlighted: str = app.builder.highlighter.highlight_block(text, lexer, force=True)
    return highlighted
