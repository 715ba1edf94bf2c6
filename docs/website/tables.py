"""Tables in Markdown, whose intervals and quantities stay on one line of a cell."""

from __future__ import annotations

import re
from typing import Any

_WHOLE = re.compile(r"[\[(](?:[-\d.,% x]|to|never)+[\])]|\d (?:N m|N|kg|g|mm|m|ms|s)\b")


def setup(app: Any) -> None:
    """Rewrite tables when a page is read."""
    app.connect("source-read", lambda app, name, text: text.append(whole(text.pop())))


def whole(text: str) -> str:
    """Replace the spaces of ``[97.1, 99.2]``, ``(0.1 to 0.3)`` and ``37 N m`` in tables."""
    lines = text.split("\n")
    return "\n".join(_WHOLE.sub(_tied, line) if line[:1] == "|" else line for line in lines)


def _tied(found: re.Match[str]) -> str:
    return found[0].replace(" ", "\N{NO-BREAK SPACE}")
