"""Numbers are taken as users write them, and whatever is none is refused by a typed error."""

from datetime import date

import numpy as np
import pytest
import torch

from tpm_gym.arrays import finite, finite_points, numbers, points, rotate, vector
from tpm_gym.envs.vector import TPMVectorEnv
from tpm_gym.errors import ConfigurationError, InputError, ResetOptionError
from tpm_gym.simulation.engine import transform

NO_NUMBERS = {
    "beyond the range of floats": [10**400, 0, 0],
    "gradients": torch.zeros(3, requires_grad=True),
    "gradients in a list": [torch.tensor(0.0, requires_grad=True), 0.0, 0.0],
    "complex": [1j, 0, 0],
    "complex tensor": torch.zeros(3, dtype=torch.complex64),
    "text": "abc",
    "digits": ["1", "2", "3"],
    "mixed": (0.0, True, "1"),
    "bytes": b"abc",
    "dates": [date(2020, 1, 1)] * 3,
    "datetime64": np.array(["2020-01-01"] * 3, dtype="M8[D]"),
    "masked": np.ma.array([1.0, 2.0, 3.0], mask=[True, False, False]),
    "masked in a list": [np.ma.masked, 0.0, 0.0],
    "ragged": [[1.0], 2.0, 3.0],
    "objects": [object()] * 3,
    "sets": {1, 2, 3},
    "nothing": None,
}


@pytest.mark.parametrize("function", [numbers, points, finite_points, vector])
@pytest.mark.parametrize("value", NO_NUMBERS.values(), ids=NO_NUMBERS)
def test_what_is_no_number_is_refused(function, value):
    if value is NO_NUMBERS["gradients"] and function in (points, finite_points):
        assert function("theta", value).requires_grad
        return
    with pytest.raises(InputError) as caught:
        function("theta", value)
    assert caught.value.name == "theta"
    assert "theta must be" in str(caught.value)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize(
    "value",
    [
        (1, 2, 3),
        [1.0, np.float32(2), np.int8(3)],
        range(1, 4),
        np.array([1, 2, 3], dtype=np.uint8),
        np.array([1, 2, 3], dtype=np.longdouble),
        np.array([1, 2, 3], dtype=object),
        torch.tensor([1, 2, 3]),
        torch.tensor([1.0, 2.0, 3.0], dtype=torch.float16),
        list(torch.tensor([1.0, 2.0, 3.0])),
    ],
)
def test_three_numbers_become_plain_floats_whatever_holds_them(value):
    found = vector("goal", value)
    assert found == (1.0, 2.0, 3.0)
    assert {type(v) for v in found} == {float}
    np.testing.assert_array_equal(finite("goal", value, (3,)), found)


@pytest.mark.parametrize("bad", [[0, 0], [[0, 0, 0]], 1.0, [], [0, np.nan, 0], (0, 0, -np.inf)])
def test_other_shapes_and_numbers_without_end_are_refused_as_the_caller_wishes(bad):
    for call in (vector, lambda *args: finite(args[0], args[1], (3,), args[2])):
        with pytest.raises(ResetOptionError, match=r"finite numbers.*of shape \(3,\)") as caught:
            call("goal", bad, ResetOptionError)
        assert caught.value.name == "goal"


def test_numbers_that_only_floats_can_hold_are_numbers():
    assert vector("goal", [10**20, 1e308, 1e308]) == (1e20, 1e308, 1e308)


def test_points_keep_leading_shapes_and_may_be_infinite_unless_they_must_not():
    given = np.zeros((4, 5, 3))
    assert points("theta", given) is given
    given[2, 3, 1] = np.inf
    assert points("theta", given).shape == (4, 5, 3)
    for some in (given, torch.tensor(given)):
        with pytest.raises(InputError, match="finite") as caught:
            finite_points("theta", some)
        assert caught.value.value == [0.0, np.inf, 0.0]
    for shape in ((), (5,), (3, 2)):
        with pytest.raises(InputError, match="shape"):
            points("theta", np.zeros(shape))


@pytest.mark.parametrize(
    "tensor", [torch.ones(3).to_sparse(), torch.ones(3) * 1j], ids=["sparse", "complex"]
)
def test_tensors_without_real_numbers_are_refused(tensor):
    with pytest.raises(InputError, match="in a dense tensor"):
        points("theta", tensor)


def test_points_in_tensors_stay_tensors_in_double_precision():
    single = torch.ones(2, 3, requires_grad=True)
    found = points("theta", single)
    assert found.dtype == torch.float64
    found.sum().backward()
    assert single.grad is not None
    double = torch.ones(2, 3, dtype=torch.float64)
    assert points("theta", double) is double


@pytest.mark.parametrize("count", [True, np.True_, 1.0, np.float64(2.0), "3", None, 0, np.int64(0)])
def test_what_is_no_whole_number_of_one_or_more_makes_no_vector_environment(count):
    with pytest.raises(ConfigurationError, match="num_envs"):
        TPMVectorEnv("reach", num_envs=count)


def test_numpys_whole_numbers_are_whole_numbers():
    envs = TPMVectorEnv("reach", num_envs=np.int64(2), max_episode_steps=np.int32(5))
    assert envs.num_envs == 2
    assert type(envs.num_envs) is int
    envs.close()


@pytest.mark.parametrize("seed", range(5))
def test_rotations_are_those_of_the_quaternions_matrix(seed):
    rng = np.random.default_rng(seed)
    quaternion = rng.normal(size=4)
    x, y, z, w = quaternion = quaternion / np.linalg.norm(quaternion)
    axis = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(3) + 2 * w * axis + 2 * axis @ axis
    given = rng.normal(size=3)
    np.testing.assert_allclose(rotate(tuple(quaternion), tuple(given)), matrix @ given, atol=1e-14)
    moved = transform((1.0, 2.0, 3.0), tuple(quaternion), tuple(given))
    np.testing.assert_allclose(moved, [1, 2, 3] + matrix @ given, atol=1e-14)
