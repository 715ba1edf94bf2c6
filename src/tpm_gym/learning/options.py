"""How the command lines describe their options."""

from __future__ import annotations

from typing import Any

import tyro


def default(value: object, metavar: str) -> Any:
    """Describe an option whose default the code cannot show: None, or empty, for "work it out".

    Args:
        value: What the help says that the default is.
        metavar: What the help calls the value.
    """
    return tyro.conf.arg(help_behavior_hint=f"(default: {value})", metavar=metavar)
