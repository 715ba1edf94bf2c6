"""Errors carry their values, say what is valid, and are caught as a caller would expect."""

from __future__ import annotations

import copy
import inspect
import pickle
from typing import Any

import pytest

from tpm_gym import errors
from tpm_gym.errors import (
    ActionError,
    ClosureError,
    ConfigurationError,
    EpisodeError,
    GeometryError,
    InputError,
    MissingPackageError,
    ModeChangeError,
    PolicyFileError,
    PolicyMismatchError,
    ResetOptionError,
    SingularityError,
    TPMError,
    UnreachableError,
)

# One of each: the error, the built-in it stands for, its values, what its message must hold.
CASES: list[tuple[TPMError, type[Exception], dict[str, object], list[str]]] = [
    (
        GeometryError("l4", -1.0, "it must be positive"),
        ValueError,
        {"name": "l4", "value": -1.0, "requirement": "it must be positive"},
        ["l4", "-1.0", "it must be positive"],
    ),
    (
        InputError("theta", (2,), "of shape (..., 3)"),
        ValueError,
        {"name": "theta", "value": (2,), "requirement": "of shape (..., 3)"},
        ["theta", "(2,)", "of shape (..., 3)"],
    ),
    (
        ActionError("action", "x", "finite"),
        ValueError,
        {"name": "action", "value": "x", "requirement": "finite"},
        ["action", "'x'", "finite"],
    ),
    (
        ConfigurationError("task", "fly", "'reach'"),
        ValueError,
        {"name": "task", "value": "fly", "valid": "'reach'"},
        ["task", "'fly'", "'reach'"],
    ),
    (
        ResetOptionError("goal", 3, "a point"),
        ValueError,
        {"name": "goal", "value": 3, "valid": "a point"},
        ["goal", "3", "a point"],
    ),
    (EpisodeError("call reset() first"), RuntimeError, {}, ["call reset() first"]),
    (
        UnreachableError([0, 1, 2], "leg 3", -0.25, "go elsewhere"),
        ValueError,
        {"point": (0.0, 1.0, 2.0), "leg": "leg 3", "margin": -0.25},
        ["(0, 1, 2)", "leg 3", "0.25 m", "go elsewhere"],
    ),
    (
        SingularityError("sin(beta)", 1e-15),
        ValueError,
        {"factor": "sin(beta)", "value": 1e-15},
        ["sin(beta)", "1e-15", "conditioning"],
    ),
    (
        ClosureError(0.0123, 0.005),
        RuntimeError,
        {"gap": 0.0123, "limit": 0.005},
        ["0.0123 m", "0.005 m", "reset()"],
    ),
    (
        ModeChangeError("assembly"),
        RuntimeError,
        {"mode": "assembly"},
        ["singularity", "another assembly mode", "reset()"],
    ),
    (
        PolicyFileError("best.json", "holds no JSON", "export it again"),
        ValueError,
        {"path": "best.json", "reason": "holds no JSON", "remedy": "export it again"},
        ["best.json", "holds no JSON", "export it again"],
    ),
    (
        PolicyMismatchError("action space", "Box(3)", "Box(4)", "TPMReach-v0"),
        ValueError,
        {"kind": "action space", "trained": "Box(3)", "given": "Box(4)", "env_id": "TPMReach-v0"},
        ["action space", "Box(3)", "Box(4)", "TPMReach-v0"],
    ),
    (
        MissingPackageError("torch", "policy"),
        ImportError,
        {"package": "torch", "extra": "policy"},
        ["torch", "pip install 'tpm-gym[policy]'"],
    ),
]
LEAVES = [getattr(errors, name) for name in errors.__all__ if name != "TPMError"]


@pytest.mark.parametrize(("error", "builtin", "values", "shown"), CASES)
def test_errors_carry_their_values_and_show_them(
    error: TPMError, builtin: type[Exception], values: dict[str, object], shown: list[str]
) -> None:
    assert isinstance(error, TPMError)
    assert isinstance(error, builtin)
    for name, value in values.items():
        assert getattr(error, name) == value
    for text in shown:
        assert text in str(error)


@pytest.mark.parametrize("leaf", LEAVES)
def test_every_public_error_is_a_tpm_error_and_a_case_above(leaf: type[TPMError]) -> None:
    assert issubclass(leaf, TPMError)
    assert issubclass(leaf, (ValueError, RuntimeError, ImportError))
    assert any(type(case[0]) is leaf for case in CASES)


def test_all_names_every_error() -> None:
    defined = {
        name
        for name, value in vars(errors).items()
        if inspect.isclass(value) and issubclass(value, TPMError)
    }
    assert defined == set(errors.__all__)


@pytest.mark.parametrize(
    "copied", [copy.copy, copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))]
)
@pytest.mark.parametrize("error", [case[0] for case in CASES])
def test_errors_survive_the_way_between_processes(error: Any, copied: Any) -> None:
    again = copied(error)
    assert type(again) is type(error)
    assert str(again) == str(error)
    assert vars(again) == vars(error)
