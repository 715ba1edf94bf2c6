"""Errors carry their values, say what is valid, and are caught as a caller would expect."""

import copy
import inspect
import pickle
import re
from typing import Any

import pytest

from tpm_gym import TPMEnv, errors
from tpm_gym.errors import (
    ActionError,
    ClosureError,
    ConfigurationError,
    ConformanceError,
    EpisodeError,
    GeometryError,
    InputError,
    JointLimitError,
    MissingPackageError,
    ModeChangeError,
    PolicyFileError,
    PolicyMismatchError,
    ResetOptionError,
    SingularityError,
    TPMError,
    UnreachableError,
)

# One of each: what it is made of, the built-in it stands for, and what its message must hold.
CASES: list[tuple[type[TPMError], tuple[Any, ...], type[Exception], str]] = [
    (GeometryError, ("l4", -1.0, "it must be positive"), ValueError, "l4 = -1.0 m, but it must"),
    (InputError, ("theta", (2,), "of shape (..., 3)"), ValueError, "of shape (..., 3), got (2,)"),
    (ActionError, ("action", "x", "finite"), ValueError, "action must be finite, got 'x'"),
    (
        ConfigurationError,
        ("task", "fly", "'reach'"),
        ValueError,
        "'fly' is not possible; valid: 'r",
    ),
    (ResetOptionError, ("goal", 3, "a point"), ValueError, "goal = 3 is not possible; valid: a p"),
    (ConformanceError, ("2 is 2", "it is 3"), AssertionError, "that 2 is 2; here, it is 3"),
    (EpisodeError, ("call reset() first",), RuntimeError, "call reset() first"),
    (
        UnreachableError,
        ((0.0, 1.0, 2.0), "leg 3", -0.25, "go elsewhere"),
        ValueError,
        "(0, 1, 2) cannot be reached: leg 3 fails by 0.25 m; go elsewhere",
    ),
    (
        UnreachableError,
        ((0.0, 1.0, 2.0), "box", -0.25, "go elsewhere"),
        ValueError,
        "(0, 1, 2) cannot be reached: it is 0.25 m outside; go elsewhere",
    ),
    (
        UnreachableError,
        ((0.0, 1.0, 2.0), "leg 3", -0.25, "go elsewhere", (4, 1)),
        ValueError,
        "(0, 1, 2) at index 4, 1 cannot be reached: leg 3 fails by 0.25 m; go elsewhere",
    ),
    (
        JointLimitError,
        ("R11", 2.5, -1.309, 2.0071286, "rad"),
        ValueError,
        "joint R11 cannot be at 2.5 rad: its stops are at -1.309 and 2.00713 rad; choose a posture",
    ),
    (SingularityError, ("sin(beta)", 1e-15), ValueError, "sin(beta) = 1e-15; stay where"),
    (ClosureError, (0.0123, 0.005), RuntimeError, "open by 0.0123 m, more than 0.005 m; call"),
    (ModeChangeError, ("assembly",), RuntimeError, "a singularity into another assembly mode"),
    (ModeChangeError, ("working",), RuntimeError, "a singularity into another working mode"),
    (
        PolicyFileError,
        ("best.json", "holds no JSON", "export it again"),
        ValueError,
        "best.json: holds no JSON; export it again",
    ),
    (
        PolicyMismatchError,
        ("action space", "Box(3)", "Box(4)", "TPMReach-v0"),
        ValueError,
        "action space Box(3), the environment has Box(4); use it in TPMReach-v0",
    ),
    (
        MissingPackageError,
        ("torch", "policy"),
        ImportError,
        "be imported; pip install 'tpm-gym[policy]'",
    ),
]


@pytest.mark.parametrize(("kind", "values", "builtin", "shown"), CASES)
def test_errors_carry_their_values_show_them_and_survive_the_way_between_processes(
    kind, values, builtin, shown
):
    error = kind(*values)
    assert isinstance(error, TPMError)
    assert isinstance(error, builtin)
    assert shown in str(error)
    _, _, documented = (inspect.getdoc(kind) or "").partition("Attributes:")
    for name in re.findall(r"^ {4}(\w+):", documented, flags=re.MULTILINE):
        assert getattr(error, name) == inspect.signature(kind).bind(*values).arguments[name]
    for again in (copy.copy(error), copy.deepcopy(error), pickle.loads(pickle.dumps(error))):
        assert type(again) is kind
        assert (str(again), vars(again)) == (str(error), vars(error))


def test_values_that_have_no_text_do_not_spoil_the_message():
    with pytest.raises(ConfigurationError, match=r"width = .*int.* is not possible") as caught:
        TPMEnv(width=10**5000)
    assert caught.value.value == 10**5000


def test_every_error_is_a_case_above():
    defined = {
        name
        for name, value in vars(errors).items()
        if inspect.isclass(value) and issubclass(value, TPMError)
    }
    assert defined == {kind.__name__ for kind, *_ in CASES} | {"TPMError"}
