"""A pytest plugin that breaks one line of the package in memory; see test_paper_mutations.py.

MUTATION in the environment is JSON: [module, right, wrong]. The package is imported whole first,
since a machine that is checked as it is imported would not come up with broken kinematics.
"""

import importlib
import inspect
import json
import os
from types import FunctionType
from typing import Any

import tpm_gym  # noqa: F401


def _functions(value: Any) -> dict[str, FunctionType]:
    """A function, or those that a class defines, its properties among them."""
    found = {"": value} if inspect.isfunction(value) else {}
    if inspect.isclass(value):
        for name, member in vars(value).items():
            function = getattr(member, "fget", getattr(member, "__func__", member))
            if inspect.isfunction(function):
                found[name] = function
    return found


def mutate(name: str, right: str, wrong: str) -> None:
    """Give functions of a module, whoever holds them, the code that they have with another line."""
    module = importlib.import_module(name)
    source = inspect.getsource(module)
    assert source.count(right) == 1
    broken = {**vars(module)}
    exec(compile(source.replace(right, wrong), f"mutated {name}", "exec"), broken)
    for key, new in broken.items():
        if getattr(new, "__module__", name) != name:
            continue
        old = getattr(module, key)
        for path, function in _functions(old).items():
            function.__code__ = _functions(new)[path].__code__
        if not (inspect.isfunction(old) or inspect.isclass(old)):
            setattr(module, key, new)


mutate(*json.loads(os.environ["MUTATION"]))
