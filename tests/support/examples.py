"""Properties of whatever hypothesis draws: the same draws in every process, however slow."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from hypothesis import given, settings

Test = Callable[..., None]


def examples(count: int, *drawn: Any, **named: Any) -> Callable[[Test], Test]:
    """Run a test with ``count`` draws from these strategies."""
    always = settings(derandomize=True, max_examples=count, deadline=None)
    return lambda test: always(given(*drawn, **named)(test))
