import numpy as np
import pytest

from tpm_gym.envs import checks
from tpm_gym.errors import ActionError, ConfigurationError, ResetOptionError


def test_actions_are_copied_and_clipped():
    given = np.array([0.5, -3.0, 2.0])
    checked = checks.action(given, 3)
    assert np.array_equal(checked, [0.5, -1.0, 1.0])
    assert np.array_equal(given, [0.5, -3.0, 2.0])
    assert np.array_equal(checks.action([0, 1, -1], 3), [0.0, 1.0, -1.0])


def test_actions_of_any_finite_size_are_clipped():
    largest = np.finfo(np.float64).max
    assert np.array_equal(checks.action([largest, largest, -largest], 3), [1, 1, -1])


def test_a_bad_action_is_named_with_what_would_be_valid():
    with pytest.raises(ActionError, match=r"shape \(3,\)") as caught:
        checks.action(np.zeros(4), 3)
    assert caught.value.value == (4,)
    with pytest.raises(ActionError, match="finite"):
        checks.action([0.0, np.nan, 0.0], 3)
    with pytest.raises(ActionError, match="numbers"):
        checks.action("north", 3)


@pytest.mark.parametrize("value", [-1, np.inf, np.nan, "1", None, [1.0]])
def test_bad_weights_are_refused(value):
    with pytest.raises(ConfigurationError):
        checks.weight(value)


def test_weights_of_any_number_type_are_taken():
    assert checks.weight(np.float32(0.5)) == checks.weight(0.5) == 0.5
    assert checks.weight(0) == 0.0


@pytest.mark.parametrize("size", [(0, 10), (10, 100), (100, 5000), (64.0, 64)])
def test_bad_picture_sizes_are_refused(size):
    with pytest.raises(ConfigurationError):
        checks.picture_size(*size)


def test_reset_options_are_checked_by_key():
    assert checks.reset_options(None) == {}
    assert checks.reset_options({"goal": 1}) == {"goal": 1}
    with pytest.raises(ResetOptionError, match="'object' and 'goal'"):
        checks.reset_options({"gaol": 1})
    with pytest.raises(ResetOptionError):
        checks.reset_options([("goal", 1)])
