"""Tables, whose intervals, shares and quantities stay on one line of a cell; long words of code."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes

_WHOLE = re.compile(
    r"[\[(](?:[-\d.,% x]|to|never)+[\])]|\d (?:N m|N|kg|g|mm|m|ms|s)\b|[\d.,]+%? of [\d,]+"
)
_LONG = 38  # characters, about as wide as the page of a telephone


def setup(app: Any) -> None:
    """Rewrite tables when a page is read, and mark what is long."""
    app.connect("source-read", lambda app, name, text: text.append(whole(text.pop())))
    app.connect("doctree-read", lambda app, page: mark(page))


def whole(text: str) -> str:
    """Replace spaces in tables, of ``[97.1, 99.2]``, ``(0.1 to 0.3)``, ``9 of 10``, ``37 N m``."""
    lines = text.split("\n")
    return "\n".join(_WHOLE.sub(_tied, line) if line[:1] == "|" else line for line in lines)


def mark(page: nodes.document) -> None:
    """Give cells with long text and code with a long word the class ``long``; ``short`` to code."""
    for cell in page.findall(nodes.entry):
        if len(cell.astext()) > _LONG:
            cell["classes"].append("long")
    for code in page.findall(nodes.literal):
        text = code.astext()
        if len(text) <= _LONG:
            code["classes"].append("short")
        elif any(len(word) > _LONG for word in text.split()):
            code["classes"].append("long")


def _tied(found: re.Match[str]) -> str:
    return found[0].replace(" ", "\N{NO-BREAK SPACE}")
