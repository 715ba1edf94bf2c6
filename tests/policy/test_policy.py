"""A loaded policy acts as its layers say, names what does not fit, and needs PyTorch alone."""

import os
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import safetensors.numpy
import safetensors.torch
import torch
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv
from policies_on_file import DATA, WEIGHTS, Weights, described, observations, some_weights, write
from processes import PYTHON, printed_by
from stable_baselines3.common.vec_env import DummyVecEnv

import tpm_gym
import tpm_gym.policy
from tpm_gym import TPMEnv
from tpm_gym.errors import ConfigurationError, InputError, PolicyFileError, PolicyMismatchError
from tpm_gym.policy import load_policy
from tpm_gym.resources import POLICIES as PUBLISHED


def reference(
    observation: dict[str, Any], weights: Weights, activation: Callable[[Any], Any]
) -> np.ndarray[Any, Any]:
    """The same network, before its output is bounded."""
    gap = (observation["desired_goal"] - observation["achieved_goal"]) / 0.05
    x = np.concatenate([observation["observation"], gap], axis=1)
    layers = len(weights) // 2
    for i in range(layers):
        x = x @ weights[f"layers.{i}.weight"].T.astype(float) + weights[f"layers.{i}.bias"]
        x = activation(x) if i < layers - 1 else x
    return np.asarray(x)


@pytest.fixture
def policy(tmp_path):
    return load_policy(write(tmp_path))


# -- acting ----------------------------------------------------------------------------------------


def test_the_action_is_what_the_layers_say(policy):
    batch = observations(50)
    expected = np.tanh(reference(batch, WEIGHTS, lambda x: np.maximum(x, 0)))
    np.testing.assert_allclose(policy.act(batch), expected, atol=1e-5)
    assert policy.act({key: values[:0] for key, values in batch.items()}).shape == (0, 2)
    action, state = policy.predict(batch, None, np.ones(3, bool), deterministic=True)
    np.testing.assert_array_equal(action, policy.act(batch))
    assert state is None
    with pytest.raises(ConfigurationError, match="no random actions"):
        policy.predict(batch, deterministic=False)


@pytest.mark.parametrize("name", sorted(path.stem for path in PUBLISHED.glob("*.safetensors")))
def test_actions_are_those_of_torch_and_the_same_bits_alone_and_in_a_batch(name):
    policy = load_policy(name)
    network, space = policy.description.network, policy.description.observation_space
    weights = safetensors.torch.load_file(PUBLISHED / f"{name}.safetensors")
    rng = np.random.default_rng(0)
    batch = {
        key: (0.3 * rng.uniform(box.low, box.high, (1001, *box.shape))).astype(np.float32)
        for key, box in space.items()
    }
    gap = torch.from_numpy(batch["desired_goal"] - batch["achieved_goal"]) / network.features.unit
    x = torch.cat([torch.from_numpy(batch["observation"]), gap], dim=1)
    for i in range(len(network.hidden) + 1):
        x = getattr(torch, network.activation)(x) if i else x
        x = torch.nn.functional.linear(
            x, weights[f"layers.{i}.weight"], weights[f"layers.{i}.bias"]
        )
    x = x.tanh() if network.output == "tanh" else x.clip(-1.0, 1.0)
    actions = policy.act(batch)
    np.testing.assert_allclose(actions, x.numpy(), rtol=0, atol=2e-5)
    for i in (0, 500, 1000):
        one = policy.act({key: values[i] for key, values in batch.items()})
        np.testing.assert_array_equal(one, actions[i])


def test_a_tanh_output_fills_uneven_bounds(tmp_path):
    content = described(DATA)
    content["action_space"] |= {"low": [-1.0, 2.0], "high": [3.0, 10.0], "dtype": "float64"}
    batch = observations(50)
    squashed = np.tanh(reference(batch, WEIGHTS, lambda x: np.maximum(x, 0)))
    actions = load_policy(write(tmp_path, content)).act(batch)
    np.testing.assert_allclose(actions, [1, 6] + squashed * [2, 4], atol=1e-4)
    assert actions.dtype == np.float64


@pytest.mark.filterwarnings("error")
def test_a_network_that_overflows_gives_no_action(tmp_path):
    sizes = (7, *[2] * 12, 2)
    weights = {name: np.full_like(values, 3e38) for name, values in some_weights(sizes).items()}
    weights["layers.0.weight"] *= 0.0
    weights["layers.12.weight"][:, 1] *= -1.0  # infinity minus infinity
    data = safetensors.numpy.save(weights)
    content = described(data)
    content["network"] |= {"hidden": list(sizes[1:-1]), "output": "clip"}
    policy = load_policy(write(tmp_path, content, data))
    with pytest.raises(InputError, match="the network stays finite"):
        policy.act(observations(4))


def test_joined_entries_come_in_the_order_on_file(tmp_path):
    weights = some_weights((10, 2))
    data = safetensors.numpy.save(weights)
    batch = observations(9)
    for keys in (
        ["observation", "achieved_goal", "desired_goal"],
        ["desired_goal", "observation", "achieved_goal"],
    ):
        content = described(data)
        content["network"] |= {"features": {"kind": "concatenate", "keys": keys}, "hidden": []}
        x = np.concatenate([batch[key] for key in keys], axis=1)
        expected = np.tanh(x @ weights["layers.0.weight"].T + weights["layers.0.bias"])
        actions = load_policy(write(tmp_path, content, data)).act(batch)
        np.testing.assert_allclose(actions, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observation": torch.zeros(4, requires_grad=True)}, "observation must be real numbers"),
        ({"observation": np.zeros(5)}, r"shape of observation must be \(4,\) or \(n, 4\), "),
        ({"observation": np.zeros((2, 2, 4))}, "shape of observation must be"),
        ({"observation": 1.0}, "shape of observation must be"),
        ({"observation": np.zeros((3, 4))}, "of one batch size in all"),
        ({"observation": ["a", "b", "c", "d"]}, "observation must be real numbers"),
        ({"observation": [0, 0, np.nan, 0]}, "observation must be finite in float32, got nan"),
        ({"desired_goal": [1e300, 0, 0]}, "desired_goal must be finite"),
        ({"extra": np.zeros(3)}, "keys achieved_goal, desired_goal, observation"),
    ],
)
def test_observations_that_do_not_fit_are_named(policy, changes, message):
    one: dict[str, Any] = {key: values[0] for key, values in observations(1).items()}
    with pytest.raises(InputError, match=message):
        policy.act(one | changes)
    with pytest.raises(InputError, match="a mapping"):
        policy.act(np.zeros(4))


# -- environments ----------------------------------------------------------------------------------


def test_an_environment_of_another_kind_is_refused(policy):
    fits = SimpleNamespace(
        observation_space=policy.description.observation_space,
        action_space=spaces.Box(-1.0, 1.0, (2,)),
    )
    policy.check(fits)
    other = SimpleNamespace(**vars(fits) | {"action_space": spaces.Box(-1.0, 1.0, (4,))})
    with pytest.raises(PolicyMismatchError, match=r"with action space .*\(2,\).*\(4,\)") as caught:
        policy.check(other)
    assert (caught.value.env_id, caught.value.given) == ("TPMReach-v0", other.action_space)
    other = SimpleNamespace(**vars(fits) | {"observation_space": spaces.Dict()})
    with pytest.raises(PolicyMismatchError, match="observation space"):
        policy.check(other)


def test_joint_increments_are_no_cartesian_ones():
    """Their spaces are equal."""
    policy = load_policy(PUBLISHED / "TPMPickAndPlaceJoints-v0.json")
    for env_id in ("TPMPickAndPlaceJoints-v0", "TPMPickAndPlaceJointsDense-v0"):
        with closing(gym.make(env_id)) as env:
            policy.check(env)
            policy.check(env.unwrapped)
    for env in (gym.make("TPMPickAndPlace-v0"), TPMEnv("pick_and_place")):
        with closing(env), pytest.raises(PolicyMismatchError, match="control joints,") as caught:
            policy.check(env)
        assert (caught.value.kind, caught.value.given) == ("control", "cartesian")
    for make in (lambda: gym.make("TPMPickAndPlaceDense-v0"), lambda: TPMEnv("pick_and_place")):
        for vector in (DummyVecEnv([make]), SyncVectorEnv([make])):
            with (
                closing(vector),
                pytest.raises(PolicyMismatchError, match="TPMPickAndPlaceJointsDense-v0"),
            ):
                policy.check(vector)


# -- names -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["v1.2.json", "v1.2.safetensors", "v1.2"])
def test_a_policy_is_named_by_either_file_or_by_both(tmp_path, name):
    path = write(tmp_path)
    path.rename(tmp_path / "v1.2.json")
    path.with_suffix(".safetensors").rename(tmp_path / "v1.2.safetensors")
    assert tpm_gym.load_policy(tmp_path / name).description.seed == 3
    assert tpm_gym.load_policy(str(tmp_path / name)).description.seed == 3


def test_what_is_no_policy_is_named(tmp_path):
    for name in (3, b"best.json", None, ""):
        with pytest.raises(InputError, match="path must be the str or Path of a policy, as in '"):
            tpm_gym.load_policy(name)
    path = write(tmp_path)
    os.mkfifo(tmp_path / "pipe.json")  # not waited for
    for name, message in {
        "none": "no such file",
        "pipe.json": "no such file",
        "x" * 5000: "name too long|no such file",  # the second from Python 3.14 on
        "\0": "no such file",
        "best.zip": "holds pickles.*tpm-gym export.*--trust-pickle",
    }.items():
        with pytest.raises(PolicyFileError, match=message):
            load_policy(tmp_path / name)
    (tmp_path / "other.json").write_text('{"algo": "sac"}')
    with pytest.raises(PolicyFileError, match="is not a policy file: format: Field"):
        load_policy(tmp_path / "other.json")
    path.with_suffix(".safetensors").unlink()
    with pytest.raises(PolicyFileError, match=r"p\.safetensors: there is no such file") as caught:
        load_policy(path)
    assert caught.value.path == str(tmp_path / "p.safetensors")
    assert caught.value.remedy


def test_a_published_policy_is_named_by_its_environment(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for path in PUBLISHED.glob("*.safetensors"):
        found, wanted = tpm_gym.load_policy(path.stem), tpm_gym.load_policy(path)
        assert found.description == wanted.description
    for wrong in ("TPMReach-v9", "TPMReach-v0.json", "./TPMReach-v0", Path("TPMReach-v0")):
        with pytest.raises(PolicyFileError, match=r"no such file; .*: TPMPickAndPlace-v0, .*Reach"):
            tpm_gym.load_policy(wrong)
    write(tmp_path).rename(tmp_path / "TPMReach-v0.json")  # files come first, though one is lost
    with pytest.raises(PolicyFileError, match=r"TPMReach-v0.safetensors: there is no such file"):
        tpm_gym.load_policy("TPMReach-v0")
    (tmp_path / "p.safetensors").rename(tmp_path / "TPMReach-v0.safetensors")
    assert tpm_gym.load_policy("TPMReach-v0").description.seed == 3


# -- what loading needs, and what it leaves alone --------------------------------------------------


def test_nothing_is_unpickled_or_evaluated(tmp_path):
    """In a process of its own, where every way to run what a file says raises."""
    code = (
        "import builtins, pickle, _pickle, marshal, numpy, tpm_gym.policy.policy\n"
        "def refuse(*args, **kwargs): raise SystemExit('unpickled or evaluated')\n"
        "for module in (pickle, _pickle, marshal):\n"
        "    module.load = module.loads = refuse\n"
        "pickle.Unpickler = pickle._Unpickler = _pickle.Unpickler = numpy.load = refuse\n"
        "builtins.eval = builtins.exec = builtins.compile = refuse\n"
        f"print(tpm_gym.policy.policy.load_policy({str(write(tmp_path))!r}).description.seed)"
    )
    assert printed_by(PYTHON, "-c", code) == "3\n"
