"""JSON from strangers: parsed more strictly than Python does, and checked entry by entry."""

from __future__ import annotations

import json
import math
import re
from typing import Any, Final

__all__ = ["MAX_DEPTH", "Entry", "EntryError", "parse", "shown"]

MAX_DEPTH: Final = 16
"""How many objects and lists may stand inside each other."""


def parse(data: bytes) -> Any:
    """Parse JSON in UTF-8.

    Raises:
        ValueError: It is no JSON, holds NaN, an infinity, a number beyond float64 or an integer of
            more than 20 digits, names a key twice in one object, or is nested beyond ``MAX_DEPTH``.
    """
    try:
        content = json.loads(
            data.decode("utf-8"),
            object_pairs_hook=_mapping,
            parse_float=_finite,
            parse_int=_short,
            parse_constant=_refuse,
        )
    except RecursionError:
        raise ValueError("nested too deeply") from None
    level = [content]
    for _ in range(MAX_DEPTH + 1):
        level = [value for parent in level for value in _children(parent)]
    if level:
        raise ValueError("nested too deeply")
    return content


def _children(value: Any) -> list[Any]:
    if isinstance(value, dict):
        return list(value.values())
    return value if isinstance(value, list) else []


def _mapping(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key stands twice in one object")
    return found


def _finite(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise ValueError(f"{shown(text)} is too large")
    return value


def _short(text: str) -> int:
    if len(text) > 20:  # the time to convert one grows with the square of its digits
        raise ValueError(f"{shown(text)} is too large")
    return int(text)


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not JSON")


def shown(value: object) -> str:
    """A value as a message can hold it: short, and without control characters."""
    text = ascii(value)
    return text if len(text) <= 60 else f"{text[:60]}..."


class EntryError(ValueError):
    """An entry is not what it has to be; the message names both."""


class Entry:
    """A value out of a JSON file, and the place where it stands.

    Every method checks one form, and returns the value in it or raises an EntryError. Values are
    of exactly the type that is asked for: true is no integer, and 1.0 is none either.

    Args:
        place: Where the value stands, dotted; empty for the whole file.
        value: The value, as ``parse`` returns it.
    """

    def __init__(self, place: str, value: Any) -> None:
        """Store both."""
        self.place, self.value = place, value

    def wrong(self, wanted: str) -> EntryError:
        """The error to raise where the value is not what was wanted."""
        return EntryError(
            f"entry {self.place or '(all)'} must be {wanted}, not {shown(self.value)}"
        )

    def members(self, pattern: str, most: int) -> dict[str, Entry]:
        """The entries of an object of at most so many keys, all of which match a pattern."""
        fits = isinstance(self.value, dict) and len(self.value) <= most
        if not fits or not all(re.fullmatch(pattern, key, re.ASCII) for key in self.value):
            raise self.wrong(f"an object of at most {most} keys that match {pattern}")
        before = f"{self.place}." if self.place else ""
        return {key: Entry(before + key, value) for key, value in self.value.items()}

    def record(self, *keys: str) -> dict[str, Entry]:
        """The entries of an object that has exactly these keys."""
        if not isinstance(self.value, dict) or set(self.value) != set(keys):
            raise self.wrong(f"an object with the keys {', '.join(keys)}")
        return self.members(".*", len(keys))

    def items(self, most: int) -> list[Entry]:
        """The entries of a list of at most so many."""
        if not isinstance(self.value, list) or len(self.value) > most:
            raise self.wrong(f"a list of at most {most} entries")
        return [Entry(f"{self.place}[{i}]", value) for i, value in enumerate(self.value)]

    def integer(self, least: int, most: int) -> int:
        """An integer, bounds included."""
        if type(self.value) is not int or not least <= self.value <= most:
            raise self.wrong(f"an integer from {least} to {most}")
        return self.value

    def number(self, least: float, most: float) -> float:
        """A number, bounds included."""
        if type(self.value) not in (int, float) or not least <= self.value <= most:
            raise self.wrong(f"a number from {least:g} to {most:g}")
        return float(self.value)

    def choice(self, *choices: str) -> str:
        """One of some texts."""
        if not isinstance(self.value, str) or self.value not in choices:
            raise self.wrong(f"one of {', '.join(choices)}")
        return self.value

    def text(self, pattern: str) -> str:
        """Text that matches a pattern."""
        if not isinstance(self.value, str) or not re.fullmatch(pattern, self.value, re.ASCII):
            raise self.wrong(f"text that matches {pattern}")
        return self.value
