"""A pytest plugin that breaks one expression of the package in memory.

It serves test_paper_mutations.py. MUTATION in the environment is JSON: [module, right, wrong]. The
package is imported whole first, because machines check their kinematics when they are imported.
"""

import ast
import importlib
import inspect
import json
import os
import re
from types import FunctionType
from typing import Any

import tpm_gym  # noqa: F401


def mutate(source: str, right: str, wrong: str) -> tuple[ast.Module, int]:
    """Replace an expression wherever it stands; return the module and the number of replacements.

    Expressions are compared by their syntax trees, so that neither layout nor comments matter. In
    ``right``, the names _1, _2, ... stand for any expression, and *_1, *_2, ... for any further
    arguments. In ``wrong`` they stand for the same.
    """
    pattern, count = ast.parse(right, mode="eval").body, 0

    class Replace(ast.NodeTransformer):
        def generic_visit(self, node):
            nonlocal count
            found: dict[str, Any] = {}
            if not _equal(pattern, node, found):
                return super().generic_visit(node)
            count += 1
            new = _Fill(found).visit(ast.parse(wrong, mode="eval").body)
            return ast.copy_location(new, node)

    return ast.fix_missing_locations(Replace().visit(ast.parse(source))), count


class _Fill(ast.NodeTransformer):
    def __init__(self, found: dict[str, Any]) -> None:
        self._found = found

    def visit_Name(self, node: ast.Name) -> ast.AST:
        return self._found.get(node.id, node)

    def visit_Starred(self, node: ast.Starred) -> Any:
        return self._found[ast.unparse(node)]


def _equal(pattern: Any, node: Any, found: dict[str, Any]) -> bool:
    if isinstance(pattern, ast.Name) and re.fullmatch(r"_\d", pattern.id):
        found[pattern.id] = node
        return isinstance(node, ast.expr)
    if isinstance(pattern, list):
        if pattern and isinstance(pattern[-1], ast.Starred):
            *pattern, rest = pattern
            found[ast.unparse(rest)] = node[len(pattern) :]
            node = node[: len(pattern)]
        pairs = zip(pattern, node, strict=False)
        return len(pattern) == len(node) and all(_equal(*pair, found) for pair in pairs)
    if type(pattern) is not type(node):
        return False
    if not isinstance(pattern, ast.AST):
        return bool(pattern == node)
    fields = (name for name in pattern._fields if name not in ("ctx", "kind"))
    return all(_equal(getattr(pattern, f), getattr(node, f), found) for f in fields)


def functions_of(value: Any) -> dict[str, FunctionType]:
    """Return a function, or the functions and properties that a class defines."""
    found = {"": value} if inspect.isfunction(value) else {}
    if inspect.isclass(value):
        for name, member in vars(value).items():
            function = getattr(member, "fget", getattr(member, "__func__", member))
            if inspect.isfunction(function):
                found[name] = function
    return found


def install(name: str, right: str, wrong: str) -> None:
    """Give the functions of a module their mutated code, so that whoever holds them has it."""
    module = importlib.import_module(name)
    tree, count = mutate(inspect.getsource(module), right, wrong)
    assert count == 1
    broken = {**vars(module)}
    exec(compile(tree, f"mutated {name}", "exec"), broken)
    for key, new in broken.items():
        if getattr(new, "__module__", name) != name:
            continue
        old = getattr(module, key)
        for path, function in functions_of(old).items():
            function.__code__ = functions_of(new)[path].__code__
        if not (inspect.isfunction(old) or inspect.isclass(old)):
            setattr(module, key, new)


if "MUTATION" in os.environ:
    install(*json.loads(os.environ["MUTATION"]))
