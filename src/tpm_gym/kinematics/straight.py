"""The equations of one configuration as straight-line code, generated from their one text.

An engine asks for postures at every time step. In plain floats, a text over a namespace spends half
of its time on calls, attributes and what it computes twice. So :func:`straight_line` runs the text
once, on unknown numbers, takes down what follows from what, and compiles that: the same operations
on the same numbers, so the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

from tpm_gym.kinematics.geometry import Lengths
from tpm_gym.kinematics.namespaces import PLAIN, Namespace

__all__ = ["straight_line"]

_FUNCTIONS = vars(replace(PLAIN, root=math.sqrt, arccos=math.acos))
"""Without the corrections of PLAIN that cost most."""


def straight_line(text: Callable[..., Any], *inputs: str) -> Callable[..., Any]:
    """A function that computes ``text(*tuples, lengths, PLAIN)``, to the last bit.

    Args:
        text: Pure, over any namespace; returns numbers in nested tuples, which may be named.
        inputs: For each tuple the names of its components, with spaces between them.

    Returns:
        A function of the tuples and a :class:`Geometry`. Where rounding has pushed a number out of
        the domain of a root or an arccosine, which PLAIN corrects, it raises ValueError.

    Raises:
        TypeError: If the text asks whether something holds: there are no numbers yet to tell.
    """
    script = _Script()
    tuples = [tuple(map(script.given, names.split())) for names in inputs]
    lengths = Lengths(*(script.number(f"g.{field.name}") for field in fields(Lengths)))
    result = script.write(script.packed(text(*tuples, lengths, script.namespace())))
    heads = [f"_{index}" for index in range(len(inputs))]
    unpacked = [
        f"{', '.join(names.split())}, = {head}" for head, names in zip(heads, inputs, strict=True)
    ]
    define = f"def straight({', '.join((*heads, 'g'))}):"
    scope = {**_FUNCTIONS, **script.types}
    source = "\n    ".join((define, *unpacked, *script.lines, f"return {result}"))
    exec(compile(source, f"<straight_line({text.__qualname__})>", "exec"), scope)
    function: Callable[..., Any] = scope["straight"]
    return function


class _Number:
    """A number that is not known yet: the source of how it follows from others."""

    def __init__(self, script: _Script, form: str, parts: tuple[Any, ...]) -> None:
        self.script, self.form, self.parts = script, form, parts
        self.uses = 0
        self.name: str | None = None  # once it has one

    def __bool__(self) -> bool:
        raise TypeError("straight-line code cannot depend on a number that is not known yet")


class _Script:
    """All that a text computes."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.types: dict[str, Any] = {}
        self._numbers: dict[str, _Number] = {}

    def given(self, name: str) -> _Number:
        """An input of that name."""
        number = self.number(name)
        number.name = name
        return number

    def number(self, form: str, *parts: Any) -> _Number:
        """What follows from ``parts``; the same from the same."""
        key = repr((form, parts))
        if key not in self._numbers:
            self._numbers[key] = _Number(self, form, parts)
            for part in parts:
                if isinstance(part, _Number):
                    part.uses += 1
        return self._numbers[key]

    def packed(self, value: Any) -> Any:
        """Numbers in nested tuples, as what follows from the numbers."""
        if not isinstance(value, tuple):
            return value
        kind = type(value)
        if kind is not tuple:
            self.types[kind.__name__] = kind
        name = "" if kind is tuple else kind.__name__
        form = f"{name}({'{}, ' * len(value)})"
        return self.number(form, *map(self.packed, value))

    def namespace(self) -> Namespace:
        """Functions that take down their calls; of quotients, operators do."""

        def call(name: str) -> Callable[..., _Number]:
            return lambda *parts: self.number(f"{name}({', '.join(['{}'] * len(parts))})", *parts)

        names = (field.name for field in fields(Namespace) if field.name != "over")
        return replace(PLAIN, **{name: call(name) for name in names})

    def write(self, value: Any) -> str:
        """Its source; what is used again gets a line before it, and a name."""
        if not isinstance(value, _Number):
            return repr(value)
        if value.name is None:
            source = value.form.format(*map(self.write, value.parts))
            if value.uses < 2:
                return f"({source})"
            value.name = f"v{len(self.lines)}"
            self.lines.append(f"{value.name} = {source}")
        return value.name


def _operator(form: str) -> Callable[..., _Number]:
    return lambda *parts: parts[0].script.number(form, *parts)


for _name, _sign in {"add": "+", "sub": "-", "mul": "*", "truediv": "/", "and": "&"}.items():
    setattr(_Number, f"__{_name}__", _operator(f"{{0}} {_sign} {{1}}"))
    setattr(_Number, f"__r{_name}__", _operator(f"{{1}} {_sign} {{0}}"))
for _name, _sign in {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}.items():
    setattr(_Number, f"__{_name}__", _operator(f"{{0}} {_sign} {{1}}"))
for _name, _form in {"neg": "-{0}", "abs": "abs({0})"}.items():
    setattr(_Number, f"__{_name}__", _operator(_form))
